"""The number of triangles adapts to the frame rate of a browser."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.viewer.frame_budget import MAX_SHOWN_FACES, FrameBudget

THROTTLE_S = 0.02  # between messages of viser


def move(budget, renderer, seconds, start=0.0, coarsest=1):
    """Rotate the model without a pause; return the frame intervals."""
    time, intervals = start, []
    while time < start + seconds:
        shown = max(budget.moving, coarsest)
        intervals.append(renderer(shown))
        time += max(intervals[-1], THROTTLE_S)
        budget.moved(time, shown)
    return np.array(intervals)


def renderer(fixed, per_face):
    return lambda faces: fixed + per_face * faces


@pytest.mark.parametrize("per_face", [1e-9, 5e-8, 2e-6])
def test_slow_and_fast_browsers_reach_30_frames_per_second(per_face) -> None:
    budget = FrameBudget(100)
    late = move(budget, renderer(0.01, per_face), 30)[-10:]
    assert np.median(late) <= 1.2 / 30
    assert budget.moving == MAX_SHOWN_FACES or np.median(late) > 0.5 / 30


def test_the_coarsest_surface_is_the_limit() -> None:
    budget = FrameBudget(30_000)
    move(budget, renderer(0.0, 2e-5), 60, coarsest=30_000)
    assert budget.moving == 30_000
    assert budget.resting == 240_000
    assert budget.rest_s > 1.0  # a frame takes 0.6 s: the camera still moves between two


def test_fast_browser_shows_everything_and_pauses_do_not_count() -> None:
    budget = FrameBudget(1000)
    fast = renderer(0.005, 1e-9)
    for start in range(0, 90, 15):
        move(budget, fast, 2, start)
    assert budget.moving == budget.resting == MAX_SHOWN_FACES
    # A wheel: a few frames at each step, and pauses of different lengths in between.
    for start in np.arange(100, 130, 1.5):
        move(budget, fast, 0.2, start)
    assert budget.moving == MAX_SHOWN_FACES
    assert budget.rest_s < 0.5


def test_rest_follows_motion_soon_and_a_fast_browser_recovers() -> None:
    budget = FrameBudget(1000)
    move(budget, renderer(0.01, 1e-5), 20)
    slow = budget.moving
    assert slow < 10_000
    assert budget.rest_s < 1
    assert budget.resting == pytest.approx(8 * slow, rel=0.01)
    move(budget, renderer(0.005, 1e-9), 5, start=60)
    assert budget.moving == MAX_SHOWN_FACES
