"""What moved has an outline in one of two views; errors of the depth do not."""

from __future__ import annotations

import numpy as np
import pytest

import tofuse
from tofuse.engine.cameras import Pinhole
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.tracking.outlines import moved_fraction
from tofuse.engine.views import SurfaceOptions, prepare_view

SHAPE, WALL_M, BOX_M = (96, 128), 2.0, 1.4
CAMERA = Pinhole(SHAPE[1], SHAPE[0], 110.0, 110.0, 63.5, 47.5)
ROWS, COLUMNS = np.indices(SHAPE)
BOX = (abs(ROWS - 50) < 16) & (abs(COLUMNS - 60) < 14)
# The floor rises towards the camera at the lower end of the image.
WALL = np.minimum(WALL_M, 0.9 / np.maximum(CAMERA.rays()[..., 1], 1e-6))


def view(depth, index=0):
    rng = np.random.default_rng(index)
    depth = (depth * (1 + 0.002 * rng.standard_normal(SHAPE))).astype(np.float32)
    return prepare_view(RangeFrame(index, 0.0, CAMERA, depth, depth_kind="z"), SurfaceOptions())


def with_box(shift=0, box_m=BOX_M):
    return np.where(np.roll(BOX, shift, 1), box_m, WALL)


def moved(mask, first, second, T=None):
    T = np.eye(4) if T is None else T
    return moved_fraction(mask, view(first, 1), T, view(second, 2), np.eye(4))


@pytest.mark.parametrize(
    ("mask", "first", "second"),
    [
        (BOX, with_box(), WALL),  # appears
        (BOX, WALL, with_box()),  # has left
        (BOX & ~np.roll(BOX, 12, 1), with_box(), with_box(12)),  # moves by less than its size
        (BOX, with_box(), with_box(40)),
    ],
)
def test_object_that_moves_has_one_outline(mask, first, second):
    assert moved(mask, first, second) == pytest.approx(mask.mean(), rel=0.1)


def bump(percent):
    distance = np.hypot((ROWS - 48) / 30, (COLUMNS - 64) / 40)
    return 1 - percent / 100 * np.clip(2 - 2 * distance, 0, 1)


@pytest.mark.parametrize(
    ("mask", "first", "second"),
    [
        (BOX, with_box(), with_box(box_m=1.06 * BOX_M)),  # another depth of the same object
        (bump(8) < 0.97, WALL, WALL * bump(8)),  # a wall that bulges
        (bump(8) < 0.97, WALL * bump(8), WALL),
        (ROWS > 80, WALL, np.where(ROWS > 80, 1.01 * WALL, WALL)),  # a floor of other depth
    ],
)
def test_depth_that_varies_does_not_move(mask, first, second):
    assert moved(mask, first, second) == 0


def test_object_that_moves_is_told_from_another_direction():
    """The camera moves as well: the outline is sought at the other view's pixels."""
    T_first_second = se3.exp([0.08, 0, 0, 0, 0, 0])  # the second camera stands to the right
    behind = np.roll(WALL, -4, 1)
    assert moved(BOX, with_box(), behind, se3.inverse(T_first_second)) > 0.9 * BOX.mean()


def test_static_phone_scan_has_no_moving_objects(shared_data):
    result = tofuse.reconstruct(tofuse.open(shared_data / "iphone_record3d"))
    codes = {reason.code for reason in result.diagnostics.reasons}
    assert "unstable_depth" in codes
    assert "moving_objects" not in codes
