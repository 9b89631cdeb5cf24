"""Rooms whose halves look alike: views that are placed as if they showed one half are found."""

from __future__ import annotations

import numpy as np

from made_rooms import BOXES, at, seen, surface
from tofuse.engine.geometry import se3
from tofuse.engine.quality.rival_places import ambiguous_places
from tofuse.engine.stored_views.view_store import PosedView
from tofuse.engine.tracking.motion import FrameTime

TURN = [at(0.1 * np.sin(a), 0.1 * np.cos(a), a) for a in np.arange(16) * np.pi / 8]
HALF_OF_BOXES = BOXES[:3]
# The same room after half a turn.
SYMMETRIC = (
    *HALF_OF_BOXES,
    *(((-x, y, -z), half, turn) for (x, y, z), half, turn in HALF_OF_BOXES),
)


def found(poses, components, times=(), turn=TURN, **scene) -> tuple[int, ...]:
    """The ambiguous frames among views of a turn that were placed at these poses."""
    views = [
        PosedView(surface(seen(T, k, **scene)), np.eye(4), c)
        for k, (T, c) in enumerate(zip(turn, components, strict=True))
    ]
    moments = [FrameTime(k, t) for k, t in enumerate(times)]
    return ambiguous_places(views, dict(enumerate(poses)), moments)


def test_views_of_a_symmetric_room_fit_at_two_places() -> None:
    folded = [TURN[4 + (k - 4) % 8] for k in range(16)]
    assert found(folded, range(16), boxes=SYMMETRIC, spots=0)


def test_motion_tells_the_halves_apart() -> None:
    assert found(TURN, [0] * 16, boxes=SYMMETRIC, spots=0) == ()


def test_pattern_tells_the_halves_apart() -> None:
    assert found(TURN, range(16), boxes=SYMMETRIC, spots=400) == ()


def after_gap(seconds: float) -> np.ndarray:
    return 0.1 * np.arange(16) + np.where(np.arange(16) < 8, 0, seconds) + 0.05


def test_camera_may_have_turned_otherwise_in_a_gap() -> None:
    def of_turn(times, **scene):
        return found(TURN, [0] * 16, times, **scene)

    assert len(of_turn(after_gap(3), boxes=SYMMETRIC, spots=0)) == 8
    assert of_turn(after_gap(0), boxes=SYMMETRIC, spots=0) == ()
    assert of_turn(30 * after_gap(0), boxes=SYMMETRIC, spots=0) == ()
    assert of_turn(after_gap(3), boxes=SYMMETRIC, spots=400) == ()
    assert of_turn(after_gap(3), spots=0) == ()


def test_camera_does_not_go_too_far_in_a_gap() -> None:
    # It goes to the other side before the gap, and what it sees after it is as at the first side.
    shifts = [se3.translation((1.1 if k < 4 else -1.1, 0, 0)) for k in range(16)]
    walk = [shift @ T for shift, T in zip(shifts, TURN, strict=True)]

    def of_turn(seconds):
        times = after_gap(seconds)
        return found(walk, [0] * 16, times, walk, boxes=SYMMETRIC, spots=0)

    assert len(of_turn(2)) == 8
    assert of_turn(0.55) == ()
