"""Measures of trajectories and models, on known shapes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tofuse.engine.geometry import triangles
from tofuse.lab.experiments import measures


def box_points(rng, widths, turn_deg=0.0, shift=(0.0, 0.0)) -> np.ndarray:
    """Upright walls and the top of a box whose lower rim is at 0.9 m."""
    a, b, height = widths
    walls = rng.uniform(-0.5, 0.5, (6000, 3)) * [a, b, height]
    side = rng.integers(4, size=6000)
    for k, (axis, sign) in enumerate(((0, 1), (0, -1), (1, 1), (1, -1))):
        walls[side == k, axis] = sign * (a, b)[axis] / 2
    top = rng.uniform(-0.5, 0.5, (1500, 3)) * [a, b, 0] + np.array([0, 0, height / 2])
    points = np.vstack([walls, top]) + np.array([0, 0, 0.9 + height / 2])
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    points[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]]) + shift
    return points + rng.normal(0, 0.002, points.shape)


@pytest.mark.parametrize(
    ("widths", "turn"),
    [((0.30, 0.30, 0.40), 0.0), ((0.33, 0.31, 0.42), 0.0), ((0.30, 0.34, 0.40), 25.0)],
)
def test_box_fit_recovers_size_and_rotation(widths, turn):
    points = box_points(np.random.default_rng(0), widths, turn, shift=(0.04, -0.03))
    fit = measures.fit_box(points, 0.9, 0.4, 0.3)
    np.testing.assert_allclose(np.sort(fit.widths_m), np.sort(widths[:2]), atol=0.003)
    np.testing.assert_allclose(fit.angles_deg, 90, atol=0.6)
    assert fit.height_m == pytest.approx(widths[2], abs=0.006)
    np.testing.assert_allclose(fit.corners.mean(0), [0.04, -0.03], atol=0.003)


def test_path_score_localizes_errors():
    truth = np.tile(np.eye(4), (11, 1, 1))
    truth[:, 0, 3] = 0.1 * np.arange(11)
    path = truth.copy()
    path[:, 1, 3] = 0.01 * np.arange(11)  # drifts in y
    path[4] = np.nan
    score = measures.score_path(path, truth)
    assert score.end_m == pytest.approx(0.1)
    assert score.end_deg == pytest.approx(0)
    assert score.axes_rms_m[0] == score.axes_rms_m[2] == 0
    assert score.axes_rms_m[1] == pytest.approx(0.01 * np.sqrt(36.9))
    assert np.isnan(score.step_m[[0, 4, 5]]).all()
    np.testing.assert_allclose(score.step_m[[1, 2, 3, 6, 10]], 0.01)
    # Only alignment removes the tilt of the straight path.
    assert score.ate_m < 0.02


def test_surface_error_is_distance_to_model():
    square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float)
    surface = triangles.random_points(square, 60_000, np.random.default_rng(1))
    assert (np.histogram2d(*surface[:, :2].T, bins=4)[0] > 60_000 / 16 * 0.9).all()
    above = np.random.default_rng(3).uniform(0, 1, (5000, 3)) * [1, 1, 0] + [0, 0, 0.05]
    assert measures.surface_error_m(above, cKDTree(surface)) == pytest.approx(0.05, abs=1e-3)
