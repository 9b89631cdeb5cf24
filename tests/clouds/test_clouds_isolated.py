"""Points on no surface."""

import gc
import weakref

import numpy as np
import pytest

import tofuse
from tofuse.engine.clouds.isolated import without_isolated
from tofuse.engine.frames import CloudFrame
from tofuse.engine.geometry import se3


def corner(seed, count=4000):
    """Three walls of a room, and boxes before them."""
    generator, parts = np.random.default_rng(seed), []
    for axis in range(3):
        wall = generator.uniform(0, 1, (count, 3)) * [6, 5, 3]
        wall[:, axis] = 0
        parts.append(wall)
    places = np.random.default_rng(5)
    for _ in range(6):
        box = generator.uniform(0, 1, (count // 4, 3))
        side = generator.integers(0, 3, len(box))
        box[np.arange(len(box)), side] = generator.integers(0, 2, len(box))
        parts.append(places.uniform(0.5, 4, 3) * [1, 1, 0.3] + box * places.uniform(0.2, 0.9, 3))
    return generator.permutation(np.concatenate(parts))


def spoilt(points, share, seed):
    """Points with random ones in and around their box."""
    low, high = points.min(0) - 1, points.max(0) + 1
    count = int(share * len(points))
    return np.vstack([points, np.random.default_rng(seed).uniform(low, high, (count, 3))])


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_clouds_with_random_points_are_registered(share) -> None:
    T_target_source = se3.exp([2.0, -1.0, 0.5, 0.4, -0.9, 1.3])
    source, target = corner(1), corner(11)
    source, target = source[source[:, 0] < 4.5], target[target[:, 0] > 1]
    source = se3.transform(se3.inverse(T_target_source), source)
    found = tofuse.register(spoilt(source, share, 2), spoilt(target, share, 3))
    error = se3.log(se3.inverse(T_target_source) @ found.T_target_source)
    assert found.believed
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.linalg.norm(error[3:]) < np.radians(0.1)


def test_random_points_are_left_out_and_surfaces_stay() -> None:
    points = corner(1)
    spoiled = spoilt(points, 0.2, 4)
    amplitude = np.r_[np.zeros(len(points)), np.ones(len(spoiled) - len(points))]
    view = CloudFrame(0, 0.0, spoiled.astype(np.float32), amplitude=amplitude.astype(np.float32))
    kept = without_isolated(view).amplitude
    assert kept.sum() < 0.25 * amplitude.sum()
    assert len(kept) - kept.sum() > 0.99 * len(points)


def test_clean_clouds_stay_as_they_are() -> None:
    generator = np.random.default_rng(0)
    near = corner(1)
    # What a scanner sees of a distant wall is sparse.
    far = generator.uniform(0, 1, (3000, 3)) * [0, 90, 30] + [60, -40, 0]
    repeated = np.vstack([near, np.zeros((len(near), 3))])
    for points in (near, np.vstack([near, far]), repeated, near[:5], np.zeros((50, 3))):
        view = CloudFrame.of(points)
        assert without_isolated(view) is view


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_registered_clouds_are_not_kept_in_memory(share) -> None:
    views = [CloudFrame.of(spoilt(corner(seed), share, seed)) for seed in (1, 2)]
    known = [weakref.ref(view) for view in views]
    tofuse.register(*views, guess=np.eye(4))
    del views
    gc.collect()
    assert [ref() for ref in known] == [None, None]
