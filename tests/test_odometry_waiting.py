"""Views that are lost when they come, and found from what comes after them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from tofuse.geometry import se3
from tofuse.odometry import keyframes
from tofuse.odometry.keyframes import Keyframes, Recovery
from tofuse.odometry.waiting import Waiting
from tofuse.pipeline.mapper import Mapper
from tofuse.posegraph.views import Spacing, ViewStore
from tofuse.sensor.models import camera_model
from tofuse.simulation.effects import Effects
from tofuse.simulation.render import render
from tofuse.simulation.scene import FRAME_RATE_HZ, build

# A camera that sees 43 degrees turns by 27 from one of these to the next.
FIRST, STEP = 60, 28


@dataclass(frozen=True)
class View:
    index: int
    pixels: int = 100


@pytest.fixture(scope="module")
def turn():
    """Frames of a room, 27 degrees apart, and their poses."""
    scene, path = build("room")
    effects = Effects.none(shot_noise=True)
    model = camera_model("sr4000")
    at = range(FIRST, FIRST + 5 * STEP, STEP)
    frames = [render(scene, path, model, k, effects=effects).frame for k in at]
    return frames, [path.T_world_camera(k / FRAME_RATE_HZ, 0.0) for k in at]


@pytest.fixture(scope="module")
def hand():
    """A frame that shows nothing of the room."""
    scene, path = build("rail")
    model = camera_model("sr4000")
    return render(scene, path, model, 0, effects=Effects.none(shot_noise=True)).frame


def in_order(turn, order):
    frames, poses = turn
    numbered = [replace(frames[k], index=10 * n) for n, k in enumerate(order)]
    first = se3.inverse(poses[order[0]])
    return numbered, [first @ poses[k] for k in order]


def assert_near(T, true):
    off = se3.inverse(true) @ T
    assert np.linalg.norm(off[:3, 3]) < 0.06
    assert np.degrees(se3.angle(off)) < 1.5


def test_what_is_found_shows_where_the_views_before_it_were(turn):
    frames, true = in_order(turn, [0, 3, 2, 1])
    tracker = Keyframes().start(0)
    steps = [tracker.push(frame) for frame in frames]
    assert [step.status for step in steps] == ["tracked", "lost", "lost", "tracked"]
    assert [index for index, _ in steps[3].earlier] == [10, 20]
    assert not len(tracker.waiting)
    found = dict(steps[3].earlier)
    for k in (1, 2):
        step = found[10 * k]
        assert step.status == "tracked"
        assert_near(step.T_world_camera, true[k])
    # Each hangs on the view by which it was found.
    assert (found[20].reference, found[10].reference) == (30, 20)
    relative = se3.inverse(found[20].T_world_camera) @ found[10].T_world_camera
    np.testing.assert_allclose(relative, found[10].registration.T_target_source, atol=1e-9)


def test_without_a_search_lost_views_stay_lost(turn, monkeypatch):
    def refused(*_):
        raise AssertionError("0 keyframes are to be searched")

    monkeypatch.setattr(keyframes, "search", refused)
    frames, _ = in_order(turn, [0, 1, 3])
    tracker = Keyframes(recovery=Recovery(keyframes=0)).start(0)
    assert [tracker.push(frame).status for frame in frames] == ["tracked", "lost", "lost"]
    assert tracker.finish() == ()


def test_views_in_no_order_are_found_in_the_end(turn):
    frames, true = in_order(turn, [0, 3, 1, 4, 2])
    tracker = Keyframes().start(0)
    steps = [tracker.push(frame) for frame in frames]
    assert [step.status for step in steps[:2]] == ["tracked", "lost"]
    poses = {frame.index: step.T_world_camera for frame, step in zip(frames, steps, strict=True)}
    for step in steps:
        poses |= {index: found.T_world_camera for index, found in step.earlier}
    waiting = set(tracker.waiting)
    assert waiting == {index for index, T in poses.items() if T is None}
    late = tracker.finish()
    assert {index for index, _ in late} == waiting
    poses |= {index: found.T_world_camera for index, found in late}
    for frame, T in zip(frames, true, strict=True):
        assert_near(poses[frame.index], T)


def test_a_run_gives_late_views_their_place(turn):
    frames, true = in_order(turn, [0, 3, 1, 4, 2])
    mapper = Mapper("default")
    pushed = [mapper.push(frame) for frame in frames]
    assert any(T is None for T in pushed)
    result = mapper.finish()
    assert result.has_pose.all()
    assert [record.status for record in result.diagnostics.frames] == ["tracked"] * 5
    assert result.graph.ids.tolist() == [0, 10, 20, 30, 40]
    for T, expected in zip(result.trajectory, true, strict=True):
        assert_near(T, expected)
    assert np.isfinite([np.linalg.det(r.covariance) for r in result.diagnostics.frames[1:]]).all()


def test_a_view_of_another_place_stays_lost(turn, hand):
    frames, _ = in_order(turn, [0, 1])
    tracker = Keyframes().start(0)
    steps = [
        tracker.push(replace(frame, index=k))
        for k, frame in enumerate([frames[0], hand, frames[1]])
    ]
    assert [step.status for step in steps] == ["tracked", "lost", "tracked"]
    assert steps[2].earlier == ()
    assert tracker.finish() == ()
    assert set(tracker.waiting) == {1}


@pytest.mark.parametrize("after", [4, 14])
def test_a_start_that_nothing_follows_is_given_up(hand, after):
    """While frames arrive, or once the last one is in; the first frame alone stays lost."""
    scene, path = build("room")
    effects = Effects.none(shot_noise=True)
    at = range(0, 3 * after, 3)
    frames = [render(scene, path, camera_model("sr4000"), k, effects=effects).frame for k in at]
    mapper = Mapper("default")
    pushed = [mapper.push(replace(f, index=k)) for k, f in enumerate([hand, *frames])]
    assert pushed[0] is not None
    assert (pushed[-1] is None) == (after < 10)
    result = mapper.finish()
    assert result.has_pose.tolist() == [False] + [True] * after
    first, *others = result.diagnostics.frames
    assert first.status == "lost"
    assert "hang together" in first.reason
    assert {record.status for record in others} == {"tracked"}
    start = se3.inverse(path.T_world_camera(0.0, 0.0))
    for k, T in zip(at, result.trajectory[1:], strict=True):
        assert_near(T, start @ path.T_world_camera(k / FRAME_RATE_HZ, 0.0))
    assert result.graph.ids.tolist() == list(range(1, after + 1))
    assert "lost_frames" in [reason.code for reason in result.diagnostics.reasons]


def test_a_start_stays_where_no_more_frames_hang_together(hand, turn):
    frames, true = in_order(turn, [0, 1])
    mapper = Mapper("default")
    for k, frame in enumerate([*frames, hand, hand]):
        mapper.push(replace(frame, index=k))
    result = mapper.finish()
    assert result.has_pose.tolist() == [True, True, False, False]
    assert_near(result.trajectory[1], true[1])


def test_waiting_views_take_a_fixed_memory():
    waiting: Waiting[View] = Waiting(pixels=1000)
    for k in range(500):
        waiting.add(View(k))
        assert sum(view.pixels for view in waiting.views) <= 1000
        assert waiting.views[-1].index == k
    assert sorted(waiting.indices) == [view.index for view in waiting.views]
    kept = [view.index for view in waiting.views[:-1]]
    assert len(kept) >= 4
    assert len(set(np.diff(kept))) == 1  # evenly
    assert kept[0] == 0
    large: Waiting[View] = Waiting(pixels=10)
    large.add(View(0))
    assert len(large) == 1  # the newest is kept, however large


def test_waiting_views_are_met_from_a_frame_outwards():
    waiting: Waiting[View] = Waiting()
    for k in (1, 2, 5, 7):
        waiting.add(View(k))
    before, after = ([view.index for view in views] for views in waiting.away_from(4))
    assert before == [2, 1]
    assert after == [5, 7]
    waiting.remove(2)
    assert list(waiting.indices) == [1, 5, 7]


def test_a_late_view_is_stored_where_it_belongs(turn):
    @dataclass(frozen=True)
    class Kept:
        index: int
        depth: float = 2.0

    def at(degrees):
        return se3.exp(np.array([0, 0, 0, 0, np.radians(degrees), 0]))

    store: ViewStore[Kept] = ViewStore(Spacing(angle=0.1))
    for index, degrees in ((0, 0), (4, 40), (2, 20), (3, 21), (1, 39)):
        store.push(Kept(index), at(degrees))
    # 3 is too near to 2, which it follows; 1 is near to 4 only, which is not beside it.
    assert [view.index for view in store.views] == [0, 1, 2, 4]
