"""Rooms whose halves look alike: views that are joined as if they showed one half are found."""

from __future__ import annotations

import numpy as np

from made_rooms import BOXES, at, seen, surface
from tofuse.engine.quality.rival_places import ambiguous_places
from tofuse.engine.stored_views.view_store import PosedView

TURN = [at(0.1 * np.sin(a), 0.1 * np.cos(a), a) for a in np.arange(16) * np.pi / 8]
HALF_OF_BOXES = BOXES[:3]
# The same room after half a turn.
SYMMETRIC = (
    *HALF_OF_BOXES,
    *(((-x, y, -z), half, turn) for (x, y, z), half, turn in HALF_OF_BOXES),
)


def found(poses, components, **scene) -> tuple[int, ...]:
    """The ambiguous frames among views of a turn that were joined at these poses."""
    views = [
        PosedView(surface(seen(T, k, **scene)), np.eye(4), c)
        for k, (T, c) in enumerate(zip(TURN, components, strict=True))
    ]
    return ambiguous_places(views, dict(enumerate(poses)))


def test_views_of_a_symmetric_room_fit_at_two_places() -> None:
    folded = [TURN[4 + (k - 4) % 8] for k in range(16)]
    assert found(folded, range(16), boxes=SYMMETRIC, spots=0)


def test_motion_tells_the_halves_apart() -> None:
    assert found(TURN, [0] * 16, boxes=SYMMETRIC, spots=0) == ()


def test_pattern_tells_the_halves_apart() -> None:
    assert found(TURN, range(16), boxes=SYMMETRIC, spots=400) == ()
