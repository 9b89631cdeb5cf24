"""A repeated structure fits as well one repetition further: no pose is certain."""

from __future__ import annotations

import numpy as np

import tofuse
from registration_scenes import rng
from tofuse.engine.clouds.cloud_agreement import CloudMap
from tofuse.engine.clouds.repetition import shifts
from tofuse.engine.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp import averaged

STEP_M, SIZE_M = 5.0, 0.2


def hall():
    """Points of a floor, and of 8 by 4 square columns that stand on a grid."""
    floor = rng(1).uniform(0, 1, (24_000, 3)) * [8 * STEP_M, 4 * STEP_M, 0]
    column = rng(2).uniform(-0.25, 0.25, (1500, 3))
    column[:, 2] = rng(3).uniform(0, 4, 1500)
    side = rng(4).integers(0, 4, 1500)
    column[np.arange(1500), side // 2] = 0.25 * (-1.0) ** side
    feet = STEP_M * (np.indices((8, 4)).reshape(2, -1).T + 0.5)
    columns = (column + np.pad(feet, ((0, 0), (0, 1)))[:, None]).reshape(-1, 3)
    return rng(5).permutation(np.concatenate([floor, columns]))


def seen(points, first_m, last_m, seed):
    """The part of the points between two positions along the hall, with noise."""
    part = points[(points[:, 0] > first_m) & (points[:, 0] < last_m)]
    return part + rng(seed).normal(0, 0.003, part.shape)


def pair():
    """Two parts of the hall, of which the second begins two columns later, in other frames."""
    points, T = hall(), se3.exp([2.0, -1.0, 0.5, 0.4, -0.9, 1.3])
    return seen(points[::2], 2, 22, 6), se3.transform(T, seen(points[1::2], 12, 32, 7)), T


def as_map(points):
    view = CloudFrame.of(points)
    return CloudMap.of(averaged(view, SIZE_M), SIZE_M, view)


def test_columns_coincide_after_a_shift_by_one_of_them():
    points = hall()
    clouds = [as_map(seen(points[k::2], 3, 22, k)) for k in range(2)]
    found = shifts(*clouds, np.eye(4), 4 * SIZE_M)
    assert len(found)
    assert np.all(np.abs(np.linalg.norm(found, axis=1) - STEP_M) < 2 * SIZE_M)


def test_no_shift_of_a_single_column():
    points = hall()
    one = points[np.abs(points[:, :2] - STEP_M / 2).max(1) < STEP_M / 2]
    assert not len(shifts(as_map(one[::2]), as_map(one[1::2]), np.eye(4), 4 * SIZE_M))


def test_a_part_of_a_hall_of_alike_columns_is_ambiguous():
    source, target, _ = pair()
    found = tofuse.register(source, target)
    assert not found.believed
    assert found.runner_up is not None
    assert "another pose" in found.reason
