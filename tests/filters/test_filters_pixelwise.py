"""Filters of single points: confidence, distance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.filters.base import Removal, apply_filters
from tofuse.engine.filters.thresholds import Confidence, Distance
from tofuse.engine.frames.frames import CloudFrame, RangeFrame


def frame(z: Any, **images: Any) -> RangeFrame:
    z = np.asarray(z, np.float32)
    camera = Pinhole(z.shape[1], z.shape[0], 100.0, 100.0, 0.0, 0.0)
    return RangeFrame(0, 0.0, camera, z, **images)


def test_confidence_keeps_minimum_and_above() -> None:
    levels = np.array([[0, 3, 6], [7, 7, 255]], np.uint8)
    f = frame(np.ones((2, 3)), confidence_image=levels)
    assert np.array_equal(Confidence(7).mask(f, ()), levels >= 7)
    assert np.array_equal(Confidence(3).mask(f, ()), levels >= 3)
    assert Confidence(0).mask(f, ()).all()


@pytest.mark.parametrize(("highest", "level"), [(7, 5), (2, 2), (255, 183), (1, 1)])
def test_confidence_level_is_rescaled(highest: int, level: int) -> None:
    assert Confidence(5).on_scale(highest) == Confidence(level, highest)
    assert Confidence(7).on_scale(highest).minimum == highest
    assert Confidence(0).on_scale(highest).minimum == 0


def test_distance_distinguishes_z_and_range() -> None:
    # 3-4-5: the second pixel looks along (0.75, 0, 1), so z = 4 lies at a range of 5.
    f = RangeFrame(0, 0.0, Pinhole(2, 2, 1 / 0.75, 1.0, 0.0, 0.0), np.float32([[4, 4], [0, 9]]))
    assert Distance(3.9, 4.1).mask(f, ()).tolist() == [[True, True], [False, False]]
    assert Distance(3.9, 4.1, "range").mask(f, ()).tolist() == [[True, False], [False, False]]
    assert Distance(4.9, 5.1, "range").mask(f, ()).tolist() == [[False, True], [False, False]]
    assert Distance(5.0).mask(f, ())[1, 1]


def test_cloud_distance_is_from_origin() -> None:
    cloud = CloudFrame(0, 0.0, np.float32([[0, 0, -5], [10, 0, 0]]), origin=np.array([9.0, 0, 0]))
    assert Distance(0.0, 2.0).mask(cloud, ()).tolist() == [False, True]


def test_filters_are_applied_in_sequence() -> None:
    z = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 0.0]])
    left, removals = apply_filters([Distance(2.0), Distance(0.0, 4.0)], frame(z))
    assert removals == [Removal("distance", 5, 1), Removal("distance", 4, 1)]
    assert np.array_equal(left.z, [[0, 2, 3], [4, 0, 0]])
