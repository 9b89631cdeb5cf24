"""Changes between two sessions are detected, without false detections."""

from __future__ import annotations

import numpy as np
import pytest

from made_rooms import BOXES, at, seen, surface
from made_sessions import HERE, with_moved
from tofuse.engine.geometry import se3
from tofuse.engine.quality.change_detection import changes

# The later session runs parallel to the earlier one.
FIRST = HERE[::2]
BESIDE = [T @ at(0.1, 0.05, 0.05, pitch=0.0) for T in FIRST]
CHAIR = 4  # the box in the middle of the view


def views(path, first, **scene):
    return [surface(seen(T, first + k, **scene)) for k, T in enumerate(path)]


@pytest.fixture(scope="module")
def earlier():
    return views(FIRST, 0)


def compared(earlier, poses=None, **scene):
    later = views(BESIDE, 100, **scene)
    return changes(earlier, np.array(FIRST), later, np.array(BESIDE) if poses is None else poses)


def near(change, box) -> bool:
    centre, half, _ = box
    reach = np.linalg.norm(half[::2]) + 0.15
    return bool(np.linalg.norm((change.centre - centre)[::2]) < reach)


def test_unchanged_room_gives_no_changes(earlier) -> None:
    assert compared(earlier) == []


def test_registration_errors_give_no_changes(earlier) -> None:
    off = se3.exp([0.006, -0.004, 0.005, 0.001, 0.002, -0.001])
    assert compared(earlier, poses=off @ np.array(BESIDE)) == []


def test_moved_box_appears_and_vanishes(earlier) -> None:
    moved = with_moved(CHAIR, (0.25, 0.0, 0.0))
    found = compared(earlier, boxes=moved)
    assert {change.kind for change in found} == {"appeared", "vanished"}
    for change in found:
        assert near(change, moved[CHAIR]) or near(change, BOXES[CHAIR])
    right = [c.centre[0] for c in found if c.kind == "appeared"]
    left = [c.centre[0] for c in found if c.kind == "vanished"]
    assert min(right) > max(left)


@pytest.mark.parametrize("kind", ["appeared", "vanished"])
def test_added_or_removed_box_is_detected(kind) -> None:
    rest = BOXES[:CHAIR] + BOXES[CHAIR + 1 :]
    first, second = views(FIRST, 0), views(BESIDE, 100, boxes=rest)
    if kind == "vanished":
        found = changes(first, np.array(FIRST), second, np.array(BESIDE))
    else:
        found = changes(second, np.array(BESIDE), first, np.array(FIRST))
    assert [change.kind for change in found] == [kind]
    (change,) = found
    assert near(change, BOXES[CHAIR])
    _, half, _ = BOXES[CHAIR]
    assert 0.5 * 2 * half[1] < change.size[1] < 2 * half[1] + 0.2
    assert change.volume_m3 == pytest.approx(len(change.points) * change.voxel_m**3)


def test_occluded_regions_give_no_changes(earlier) -> None:
    """A box that is occluded by another one in all views of the earlier session."""
    assert compared(earlier, boxes=(*BOXES, ((0.1, 0.95, 1.65), (0.08, 0.1, 0.05), 0.0))) == []
