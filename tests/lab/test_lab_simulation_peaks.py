"""The synthetic case of the thesis: its geometry, and results of the noise sweep."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry import se3
from tofuse.lab.experiments.peaks import run_peaks, sweep_peaks
from tofuse.lab.simulation.peaks import peaks, peaks_cameras, peaks_points, peaks_views


def test_peaks_matches_matlab():
    # At the origin two of the three terms are left; the extremes are those on MATLAB's plots.
    assert peaks(0, 0) == pytest.approx((3 - 1 / 3) / np.e)
    side = np.linspace(-3, 3, 601)
    z = peaks(*np.meshgrid(side, side))
    assert z.max() == pytest.approx(8.1062, abs=1e-3)
    assert z.min() == pytest.approx(-6.5511, abs=1e-3)


def test_points_are_first_5000_of_grid():
    points = peaks_points()
    assert points.shape == (5000, 3)
    np.testing.assert_allclose(points[0, [0, 2]], [-3, -3])
    np.testing.assert_allclose(points[1, [0, 2]], [-3 + 6 / 70, -3])
    np.testing.assert_allclose(points[71, [0, 2]], [-3, -3 + 6 / 70])
    np.testing.assert_allclose(points[-1, 2], 3)
    np.testing.assert_allclose(points[:, 1], peaks(points[:, 0], points[:, 2]))


def test_cameras_are_on_circle_facing_origin():
    T = peaks_cameras()
    a = np.radians(18 * np.arange(20))
    expected = 10 * np.stack([np.sin(a), 0 * a, -np.cos(a)], 1)
    np.testing.assert_allclose(T[:, :3, 3], expected, atol=1e-12)
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    # The origin lies 10 m along the optical axis, and up in the object is -y in the camera.
    np.testing.assert_allclose(se3.transform(se3.inverse(T), np.zeros((1, 3)))[:, 0, 2], 10)
    np.testing.assert_allclose(R[:, :, 1], np.tile([0, -1, 0], (20, 1)), atol=1e-12)
    np.testing.assert_allclose(np.degrees(se3.angle(se3.inverse(T[:-1]) @ T[1:])), 18)


def test_views_hold_nearest_half_in_camera_frame():
    views, truth = peaks_views(0.0, 0)
    assert len(views) == 20
    np.testing.assert_allclose(truth[0], np.eye(4), atol=1e-12)
    points = peaks_points()
    T_object_world = peaks_cameras()[0]
    for view, T in zip(views, truth, strict=True):
        assert len(view) == 2500
        back = se3.transform(T_object_world @ T, view.points)
        eye = (T_object_world @ T)[:3, 3]
        distance = np.sort(np.linalg.norm(points - eye, axis=1))
        np.testing.assert_allclose(
            np.sort(np.linalg.norm(back - eye, axis=1)), distance[:2500], atol=1e-5
        )
        assert (view.points[:, 2] > 0).all()


def test_noise_is_independent_per_view_with_given_sigma():
    clean, _ = peaks_views(0.0, 3)
    noisy, _ = peaks_views(0.05, 3)
    noise = np.array([n.points - c.points for n, c in zip(noisy, clean, strict=True)])
    np.testing.assert_allclose(noise.std(axis=(0, 1)), 0.05, rtol=0.02)
    np.testing.assert_allclose(noise.mean(axis=(0, 1)), 0, atol=1e-3)
    assert np.abs(np.corrcoef(noise.reshape(20, -1)) - np.eye(20)).max() < 0.06
    again, _ = peaks_views(0.05, 3)
    other, _ = peaks_views(0.05, 4)
    np.testing.assert_array_equal(again[7].points, noisy[7].points)
    assert not np.array_equal(other[7].points, noisy[7].points)


def test_method_is_nearly_exact_without_noise():
    run = run_peaks(0.0, 0)
    assert run.sequential.position.max() < 1e-3
    assert run.optimised.position.max() < 1e-3


@pytest.mark.nightly
def test_noise_sweep_reproduces_thesis():
    """Figure 5.12, and the level that an independent implementation of the method reaches."""
    sweep = sweep_peaks(range(3), (0.02, 0.06, 0.10))
    sequential, optimised = sweep.position.T
    # Factors of two around its means, as three seeds scatter by a third.
    for mean, expected in zip(sequential, (0.018, 0.973, 2.86), strict=True):
        assert expected / 2 < mean < 2 * expected
    for mean, expected in zip(optimised, (0.010, 0.410, 1.15), strict=True):
        assert expected / 2 < mean < 2 * expected
    assert (np.diff(sequential) > 0).all()
    assert (optimised < 0.75 * sequential).all()
    assert (sweep.rotation[:, 1] < sweep.rotation[:, 0]).all()
    # Yaw gains most, height changes little (section 5.6).
    gain = sweep.axes[-1, 0] - sweep.axes[-1, 1]
    assert gain[3] > 3 * max(gain[4], gain[5])
    assert gain[1] < 0.2 * min(gain[0], gain[2])
    for run in sweep.runs:
        assert run.sequential.position[0] == run.optimised.position[0] == 0
        assert (np.diff(run.objective) <= 0).all()
