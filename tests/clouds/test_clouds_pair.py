"""``tofuse.register``: two clouds or views, without options."""

from __future__ import annotations

import numpy as np
import pytest

import tofuse
from pose_errors import assert_near
from registration_scenes import box_walls, error, relief, rng, stone, turn, view
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.icp.coarse_to_fine import CoarseToFine, averaged
from tofuse.engine.icp.icp import Remapping
from tofuse.lab.methods.variants import Tricp


def source_of(points, T):
    return se3.transform(se3.inverse(T), points)


@pytest.mark.parametrize("scale", [0.01, 1.0, 50.0])
@pytest.mark.parametrize("degrees", [3, 20])
def test_clouds_of_any_size_are_registered(scale, degrees):
    T = turn([1, 2, 0.5], degrees, centre=np.array([0, 0, 2.0]))
    to = np.diag([scale, scale, scale, 1.0])
    T = to @ T @ np.linalg.inv(to)
    found = tofuse.register(source_of(stone(3000, 1) * scale, T), stone(3000, 0) * scale)
    assert_near(found.T_target_source, T, 0.01 * scale, 0.2)
    assert found.converged
    assert found.inlier_ratio > 0.9
    assert found.rms_m < 0.05 * scale
    assert np.linalg.eigvalsh(found.information).min() > 0
    assert len(found.unobservable) == 0


@pytest.mark.nightly
def test_half_of_each_view_may_be_outside_overlap():
    for k in range(3):
        T = turn(rng(k).normal(size=3), 6)
        source = source_of(relief(4000, 2 * k + 1, 0.0, 1.0, outliers=100), T)
        found = tofuse.register(source, relief(4000, 2 * k, -0.5, 0.5))
        assert error(found, T)[0] < 0.005
        assert error(found, T)[1] < 0.5
        assert 0.4 < found.inlier_ratio < 0.65


def test_large_clouds_are_downsampled():
    T = turn([1, 2, 0.5], 5)
    found = tofuse.register(source_of(relief(100_000, 1), T), relief(100_000, 0))
    assert found.points <= 20_000
    assert error(found, T)[0] < 5e-4
    assert error(found, T)[1] < 0.05


def test_map_coordinates_keep_precision():
    far = np.array([[500_000.0, 5_000_000, 300]])
    shift = se3.translation(far)
    T = turn([1, 2, 0.5], 2)
    near = tofuse.register(source_of(relief(3000, 1), T), relief(3000, 0))
    guess = shift @ np.linalg.inv(shift)
    found = tofuse.register(source_of(relief(3000, 1), T) + far, relief(3000, 0) + far, guess=guess)
    here = np.linalg.inv(shift) @ found.T_target_source @ shift
    np.testing.assert_allclose(here, near.T_target_source, atol=1e-4)
    assert np.linalg.norm(found.reference_point - far) < 1000
    assert found.sigma[0] < 1e-3


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("walls", "count", "noise"),
    [("z", 3, 0.01), ("x", 3, 0.001), ("xy", 1, 0.01), ("xyz", 0, 0.001)],
    ids=str,
)
def test_unobservable_directions_are_reported_and_stay_as_guessed(walls, count, noise):
    T = se3.exp([0.03, -0.02, 0.02, 0.01, 0.015, -0.01])
    target, source = (box_walls(4000, s, noise, walls) for s in (0, 1))
    guess = T @ se3.exp([0.01, 0.02, -0.01, 0.01, -0.01, 0.01])
    found = tofuse.register(source_of(source, T), target, guess=guess)
    assert found.unobservable.shape == (count, 6)
    np.testing.assert_allclose(np.linalg.norm(found.unobservable, axis=1), 1)
    # Constrained directions are found, the rest is that of the guess.
    remapping = Remapping.of(found.unobservable, source_of(source, T)) if count else None
    missed = se3.inverse(T) @ found.T_target_source
    moved = se3.inverse(guess) @ found.T_target_source
    if remapping:
        missed, slid = remapping.across(missed), remapping.along(moved)
        np.testing.assert_allclose(slid, np.eye(4), atol=1e-3)
    # An error of the rotation about the wall, 5 m away, shows as one of the position.
    assert np.linalg.norm(se3.log(missed)) < 0.8 * noise + 2e-3


def test_ball_does_not_constrain_rotation():
    d = rng(0).normal(size=(8000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    d = d[d[:, 2] < 0] * 0.3 + np.array([0, 0, 2])
    found = tofuse.register(d[::2] + np.array([0.01, 0, 0]), d[1::2])
    assert len(found.unobservable) == 3
    ball = np.array([[0.01, 0, 2.0]])
    np.testing.assert_allclose(se3.transform(found.T_target_source, ball), [[0, 0, 2]], atol=2e-3)


def test_other_method_may_be_given():
    T = turn([1, 2, 0.5], 3)
    source, target = source_of(relief(3000, 1), T), relief(3000, 0)
    found = tofuse.register(source, target, method=Tricp(0.02, points=300, overlap=0.9))
    assert found.points == 300
    again = tofuse.register(source, target, method=Tricp(0.02, points=300, overlap=0.9))
    assert found.T_target_source.tobytes() == again.T_target_source.tobytes()
    other = tofuse.register(source, target, method=Tricp(0.02, points=300, overlap=0.9), seed=1)
    assert found.T_target_source.tobytes() != other.T_target_source.tobytes()


def test_averaged_is_mean_of_each_cube():
    points = rng(2).uniform(-1, 1, (1000, 3))
    reduced = averaged(view(points), 0.5)
    low = points.astype(np.float32).astype(float).min(0)
    cells = {}
    for p in points.astype(np.float32).astype(float):
        cells.setdefault(tuple(np.floor((p - low) / 0.5)), []).append(p)
    wanted = np.array([np.mean(cells[cell], 0) for cell in sorted(cells)])
    np.testing.assert_allclose(reduced.points, wanted, atol=1e-6)
    assert len(averaged(view(np.zeros((0, 3))), 0.5)) == 0


GOOD = np.random.default_rng(0).normal(size=(200, 3))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.zeros((0, 3)), "has 0 finite points"),
        (GOOD[:2], "has 2 finite points"),
        (np.zeros((10, 2)), r"shape \(10, 2\)"),
        ([[1, 2, 3], [1, 2]], "is not an array"),
        ({"points": GOOD}, "is a dict"),
        (GOOD + 1j, "complex"),
        (GOOD * 1e12, "coordinates up to"),
    ],
)
def test_invalid_arrays_are_refused(bad, message):
    with pytest.raises(tofuse.InputError, match=message) as raised:
        tofuse.register(bad, GOOD)
    assert str(raised.value).startswith("source: ")
    with pytest.raises(tofuse.InputError, match=message) as raised:
        tofuse.register(GOOD, bad)
    assert str(raised.value).startswith("target: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("source", "target"),
    [
        (np.ones((100, 3)), GOOD),
        (GOOD, np.ones((100, 3))),
        (np.outer(np.arange(100.0), [1, 1, 1]),) * 2,
        (GOOD, GOOD + 1e6),
        (np.repeat(GOOD[:4], 30, 0), GOOD),
    ],
    ids=["one place", "one place as target", "line", "far apart", "four places"],
)
def test_degenerate_clouds_are_refused(source, target):
    with pytest.raises(tofuse.RegistrationError):
        tofuse.register(source, target, guess=np.eye(4))


def test_invalid_guess_is_refused():
    for guess in (np.zeros((4, 4)), np.eye(3), 2 * np.eye(4), np.full((4, 4), np.nan)):
        with pytest.raises(tofuse.InputError, match="guess"):
            tofuse.register(GOOD, GOOD, guess=guess)


def test_non_finite_points_are_dropped():
    T = turn([1, 2, 0.5], 3)
    source, target = source_of(relief(3000, 1), T), relief(3000, 0)
    source[::7] = np.nan
    target[5] = np.inf
    assert error(tofuse.register(source, target), T)[0] < 0.003


def test_method_is_a_part_or_its_name() -> None:
    T = turn([0, 0, 1], 2)
    source, target = source_of(stone(1500, 1), T), stone(1500, 0)
    by_name = tofuse.register(source, target, method="coarse-to-fine")
    by_part = tofuse.register(source, target, method=CoarseToFine())
    np.testing.assert_array_equal(by_name.T_target_source, by_part.T_target_source)
    for wrong in ("ecp", CoarseToFine, 3):
        with pytest.raises(InputError, match=r"method: is .*; use one of any-pair, .*icp"):
            tofuse.register(source, target, method=wrong)
