"""Views from other times confirm frames in which much moves, or show that it was followed."""

from __future__ import annotations

import numpy as np
import pytest

from made_rooms import CAMERA, at, seen
from tofuse.engine.geometry import se3
from tofuse.engine.quality.background import Limits, Movement, confirmed
from tofuse.engine.quality.cross_view_agreement import prepare_for_comparison

FRAMES = range(24)
WALK = np.stack([at(-0.4 + 0.03 * k, 0.0, 0.015 * k) for k in FRAMES])
OPEN = frozenset(range(9, 14))
COVERED = 0.35  # of the image, by what passes and was excluded
LIMITS = Limits(max_share=0.25, delay=4)
PASSES = dict.fromkeys(OPEN, Movement(COVERED, 0.0))


def view(k: int):
    frame = seen(WALK[k], k)
    covered = np.arange(CAMERA.width) >= (1 - COVERED) * CAMERA.width
    return prepare_for_comparison(frame.keep(~covered) if k in OPEN else frame)


@pytest.fixture(scope="module")
def views():
    return [view(k) for k in FRAMES]


def found(views, poses=WALK, frames=FRAMES, open_frames=OPEN, movements=PASSES):
    return confirmed(views, poses, frames, open_frames, movements, LIMITS)


def dragged(frames, metres: float = 0.3):
    """Poses that follow what moves in some frames."""
    poses = WALK.copy()
    poses[list(frames)] = poses[list(frames)] @ se3.exp([metres, 0, 0, 0, 0, 0])
    return poses


def test_true_poses_are_confirmed(views) -> None:
    assert found(views) == OPEN


def test_poses_that_followed_what_moves_are_not(views) -> None:
    assert not found(views, dragged(OPEN))
    assert found(views, dragged({11})) == OPEN - {11}


def test_parts_apart_do_not_confirm_each_other(views) -> None:
    """What was followed has carried all later poses along."""
    later = set(range(12, 24))
    assert found(views, dragged(later, 1.0)) <= OPEN - later


def test_nothing_is_confirmed_without_views_from_other_times(views) -> None:
    most = frozenset(range(13))
    assert not found(views, open_frames=most, movements=dict.fromkeys(most, Movement(0.3, 0.0)))
    assert not found(views, open_frames=frozenset(FRAMES))
    # Some of it moves in all other frames.
    always = {k: Movement(COVERED if k in OPEN else 0.1, 0.0) for k in FRAMES}
    assert not found(views, movements=always)


def test_background_must_be_larger_than_what_moves(views) -> None:
    assert not found(views, movements=dict.fromkeys(OPEN, Movement(0.55, 0.0)))
    assert found(views, movements=dict.fromkeys(OPEN, Movement(COVERED, 0.5))) == OPEN
    assert not found(views, movements=dict.fromkeys(OPEN, Movement(COVERED, 0.7)))


def test_frames_near_a_rival_are_not_still(views) -> None:
    rival = dict.fromkeys(OPEN, Movement(COVERED, 0.3))
    near = [k for k in FRAMES if k in OPEN or 5 <= k < 18]
    assert not found([views[k] for k in near], WALK[near], movements=rival)
    assert found(views, movements=rival) == OPEN


def test_frames_without_a_view_follow_their_neighbours(views) -> None:
    kept = [k for k in FRAMES if k not in (10, 12, 13)]
    some = [views[k] for k in kept]
    assert found(some, WALK[kept]) == OPEN
    assert found(some, dragged({11})[kept]) == {9}
