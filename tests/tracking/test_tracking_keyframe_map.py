"""Selection of stored keyframes, and the frequency of relocalization among them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from made_rooms import OTHER, at, seen, surface
from pose_errors import pose_error
from tofuse.engine.geometry import se3
from tofuse.engine.search.search_grid import SearchOptions
from tofuse.engine.search.verification import FitStatistics
from tofuse.engine.tracking import keyframe_map
from tofuse.engine.tracking.keyframe_map import Keyframe, KeyframeMap, Relocalizer

VIEW = surface(seen(at(0, 0.3, 0), 0))


def along(x, index, component=0):
    """A keyframe `x` m to the right; what it sees does not matter."""
    T = np.eye(4)
    T[0, 3] = x
    return Keyframe(replace(VIEW, index=index), T, component)


def turned(angle, index, component=0):
    return Keyframe(replace(VIEW, index=index), se3.exp([0, 0, 0, 0, angle, 0]), component)


def kept(keyframes):
    return [k.view.index for k in keyframes._keyframes]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(keyframe_map, "CAPACITY", 4)
    return KeyframeMap(0.2, 0.1)


def test_keyframe_count_is_bounded_and_newest_is_kept(small) -> None:
    for k in range(30):
        small.add(along(0.3 * k, k))
        assert len(small) == min(k + 1, 4)
        assert small.newest.view.index == k


def test_later_of_two_close_keyframes_is_removed(small) -> None:
    """Out and back: frames 0 to 4 cover the path, later ones revisit it."""
    for n, place in enumerate([0, 1, 2, 3, 4, 3, 2, 1]):
        small.add(along(0.3 * place + 0.001 * n, n))
    found = kept(small)
    assert found[-1] == 7
    assert len({min(n, 8 - n) for n in found}) == 4  # no place twice


def test_rotation_counts_like_translation(small) -> None:
    for index, angle in enumerate([0.0, 1.0, 1.05, 2.0, 3.0]):
        small.add(turned(angle, index))
    assert kept(small) == [0, 1, 3, 4]


def test_keyframes_of_different_components_are_not_compared(small) -> None:
    """Poses are comparable within a component only."""
    for index, (x, component) in enumerate([(0.0, 0), (0.5, 0), (0.01, 1), (0.6, 1), (0.0, 2)]):
        small.add(along(x, index, component))
    # Two or one of each component: the nearest two of one component are 0 and 1.
    assert kept(small) == [0, 2, 3, 4]


def test_motion_decides_when_view_becomes_keyframe() -> None:
    keyframes = KeyframeMap(0.2, 0.1)
    first = along(0.0, 0)
    keyframes.add(first)
    step = 0.1 * VIEW.depth
    assert not keyframes.is_far(along(0.9 * step, 1).T_component_camera, first)
    assert keyframes.is_far(along(1.1 * step, 1).T_component_camera, first)
    assert not keyframes.is_far(turned(0.19, 1).T_component_camera, first)
    assert keyframes.is_far(turned(0.21, 1).T_component_camera, first)


@pytest.fixture(scope="module")
def around():
    """Keyframes of two components with different viewing directions."""
    keyframes = KeyframeMap(0.2, 0.1)
    poses = [at(0, 0.3, 0.7 * k) for k in range(6)]
    for k, T in enumerate(poses):
        keyframes.add(Keyframe(surface(seen(T, k)), T, k // 3))
    return keyframes, poses


def test_most_similar_keyframe_is_found(around) -> None:
    keyframes, poses = around
    for k, T in enumerate(poses):
        near = surface(seen(T @ se3.exp([0.02, 0, 0, 0, 0.05, 0]), 9))
        assert keyframes.most_similar(near, 9).view.index == k
        # Excluding keyframes of its own component.
        assert keyframes.most_similar(near, k // 3).component != k // 3
    only = KeyframeMap(0.2, 0.1)
    assert only.most_similar(VIEW, 0) is None
    only.add(along(0.0, 0, 2))
    assert only.most_similar(VIEW, 2) is None


# Search budget


def relocalizer():
    return Relocalizer(SearchOptions(), FitStatistics())


def counted(monkeypatch):
    """Searches that find nothing; returns the list of searched pairs."""
    asked = []

    def registered(view, target, **_):
        asked.append((view.index, target.index))

    monkeypatch.setattr(keyframe_map, "register_pair", registered)
    return asked


def test_search_budget_grows_with_frames(around, monkeypatch) -> None:
    keyframes, _ = around
    asked = counted(monkeypatch)
    budgeted, lost = relocalizer(), surface(seen(at(0, 0.3, 0.7), 7))
    for k in range(100):
        budgeted.links(replace(lost, index=7 + k), keyframes, 9)
    at_first = len(asked)
    assert 0 < at_first <= 60
    for k in range(1000):
        budgeted.count_frame()
        if k % 5 == 4:
            budgeted.links(replace(lost, index=107 + k), keyframes, 9)
    # A search costs as much as tracking some tens of frames.
    assert 10 <= len(asked) - at_first <= 50


def test_each_pair_of_views_is_searched_once(around, monkeypatch) -> None:
    keyframes, _ = around
    asked = counted(monkeypatch)
    budgeted, lost = relocalizer(), surface(seen(at(0, 0.3, 0.7), 7))
    for _ in range(3):
        budgeted.links(lost, keyframes, 9)
    assert len(asked) == len(set(asked)) > 0


def test_newest_and_most_similar_keyframes_are_searched(around, monkeypatch) -> None:
    keyframes, _ = around
    asked = counted(monkeypatch)
    lost = surface(seen(at(0, 0.3, 0.72), 7))
    assert relocalizer().links(lost, keyframes, 2, 5) == ()
    assert asked == [(7, 5), (7, 1)]
    # Only in other components, each keyframe once.
    asked.clear()
    relocalizer().links(lost, keyframes, 1)
    assert [j for _, j in asked] == [1]
    asked.clear()
    relocalizer().links(surface(seen(at(0, 0.3, 3.52), 7)), keyframes, 2)
    assert [j for _, j in asked] == [5]


def test_lost_view_is_linked_at_correct_pose(around) -> None:
    keyframes, poses = around
    T = poses[1] @ se3.exp([0.05, 0, 0, 0, 0.1, 0])
    links = relocalizer().links(surface(seen(T, 7)), keyframes, 9)
    link = links[-1]
    assert link.certain
    assert (link.i, link.j) == (1, 7)
    assert pose_error(link.T_i_j, se3.inverse(poses[1]) @ T)[0] < 0.01


def test_view_of_another_scene_gets_no_certain_link(around) -> None:
    frame = seen(at(0.1, 0, 2.0), 7, boxes=OTHER, half=(2.3, 1.2, 2.2), scene=9)
    links = relocalizer().links(surface(frame), around[0], 9)
    assert not any(link.certain for link in links)
