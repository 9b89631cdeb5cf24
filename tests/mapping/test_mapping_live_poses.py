"""Loop closure during tracking."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from corner_views import corner
from revisited_path import Drifting, away_and_back
from tofuse.engine.alignment.base import Link, Registration
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import LoopRecord
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.engine.loops.loops import ClosedLoop
from tofuse.engine.loops.revisits import Revisits
from tofuse.engine.mapping.frame_log import FrameLog
from tofuse.engine.mapping.live_poses import DELAY, LiveLoops, LivePoses
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.refinement.refinement import NoRefinement
from tofuse.engine.results.types import FrameRecord
from tofuse.engine.tracking.base import Step

COUNT = 24
# As uncertain as the drift is large, so that the graph corrects it.
DRIFTING = Drifting(COUNT, drift=0.5, sigma=1)


@pytest.fixture(scope="module")
def frames():
    return [
        replace(corner(T), index=k, timestamp=float(k)) for k, T in enumerate(away_and_back(COUNT))
    ]


def live(frames, threads):
    loops = Revisits(searches=0)
    config = replace(
        from_method("default"),
        corrections=(),
        model_filters=(),
        odometry=DRIFTING,
        loops=loops,
        refinement=NoRefinement(),
    )
    mapper = Mapper(config, threads=threads)
    poses = [mapper.push(frame) for frame in frames]
    # The camera stands still at the end, long enough for the last loop to take effect.
    for k in range(COUNT, COUNT + DELAY + 1):
        poses += [mapper.push(replace(frames[-1], index=k, timestamp=float(k)))]
    return np.stack(poses)


def test_loops_correct_live_pose_with_fixed_delay(frames):
    truth = away_and_back(COUNT)
    poses = live(frames, 1)

    def off(found):
        return np.linalg.norm(found[:3, 3] - truth[-1, :3, 3])

    # Where the odometry alone ends.
    drifted = np.eye(4)
    for before, after in itertools.pairwise(truth):
        drifted = drifted @ se3.inverse(before) @ after @ DRIFTING.error
    for _ in range(DELAY + 1):
        drifted = drifted @ DRIFTING.error
    assert off(drifted) > 0.08
    assert off(poses[-1]) < 0.5 * off(drifted)
    np.testing.assert_array_equal(poses, live(frames, 2))


def scripted(pairs):
    """A loop detector that returns given loops and counts its calls."""

    class Scripted:
        asked = 0

        def push(self, view, T_component_camera):
            """Nothing to store."""

        def detection_job(self):
            self.asked += 1
            here = [p for p in pairs if p[1] == self.asked - 1]
            if not here:
                return None
            record = LoopRecord(*here[0], True, "")
            return lambda: [ClosedLoop(record, np.eye(4), np.eye(6))]

        def finish(self, poses):
            return []

    return Scripted()


def test_loops_take_effect_after_fixed_delay():
    loops = LiveLoops(scripted([(0, 3)]))
    new = [loops.advance() for _ in range(3 + DELAY + 3)]
    assert [k for k, known in enumerate(new) if known] == [3 + DELAY]
    assert [(c.record.i, c.record.j) for c in loops.closed] == [(0, 3)]
    loops.finish()


def test_error_in_job_is_raised():
    class Broken:
        def detection_job(self):
            def work():
                raise ZeroDivisionError

            return work

    loops = LiveLoops(Broken())
    assert not loops.advance()
    assert not any(loops.advance() for _ in range(DELAY - 1))
    with pytest.raises(ZeroDivisionError):
        loops.advance()


class _AlwaysClosing:
    """Loops of which every search finds one."""

    needs_points: ClassVar[bool] = False

    def detection_job(self):
        record = LoopRecord(0, 1, True, "")
        return lambda: [ClosedLoop(record, np.eye(4), np.eye(6))]


class _Shorter:
    """Loops between the first frame of a walk and its sixth: the way is 10 % shorter."""

    def __init__(self, first):
        self.first, self.asked = first, first - 1

    def detection_job(self):
        self.asked += 1
        if self.asked != self.first + 5:
            return None
        record = LoopRecord(self.first, self.asked, True, "")
        return lambda: [ClosedLoop(record, se3.translation([0.45, 0, 0]), 1e8 * np.eye(6))]


AHEAD = se3.translation([0.1, 0, 0])


def measured(information=1e4):
    return Registration(AHEAD, True, 1, 1, 1, 0.0, 0.0, information * np.eye(6))


class Walk:
    """Frames that are 0.1 m apart, by the tracker; `poses` are the reported ones."""

    def __init__(self, loops):
        self.live, self.log = LivePoses(loops, LevenbergMarquardt()), FrameLog()
        self.poses = []

    def step(self, step):
        index = len(self.log.entries)
        self.log.add(FrameRecord(index, float(index), step.status, ""), step)
        self.live.update(step, self.log)
        self.poses.append(self.live.pose(step))

    def go(self, count, component=0, link=None):
        begin = len(self.log.entries)
        for k in range(count):
            T = se3.translation([0.1 * k, 0, 0])
            links = () if k or link is None else (Link(link, begin, measured(), True, ""),)
            reference, registration = (begin + k - 1, measured()) if k else (None, None)
            self.step(Step("tracked", "", T, reference, registration, None, component, links))


def test_next_component_begins_where_loops_put_the_last_frame():
    walk = Walk(_Shorter(0))
    walk.go(DELAY + 8)
    walk.go(1, component=1, link=DELAY + 7)
    *_, last, first = walk.poses
    assert last[0, 3] < 0.1 * (DELAY + 7) - 0.04
    np.testing.assert_allclose(first, last @ AHEAD, atol=1e-9)
    # What was before the loop has another correction.
    walk.go(1, component=2, link=0)
    np.testing.assert_allclose(walk.poses[-1], AHEAD, atol=1e-9)


def test_lost_frame_leaves_closed_loops_in_effect():
    walk = Walk(_Shorter(1))
    walk.go(1)
    walk.go(DELAY + 8, component=1, link=0)
    before = walk.poses[-1]
    assert before[0, 3] < 0.1 * (DELAY + 8) - 0.04
    walk.step(Step("lost", "dark", None))
    T = walk.log.step_of(DELAY + 8).T_component_camera @ AHEAD
    walk.step(Step("tracked", "", T, DELAY + 8, measured(), None, 1))
    assert walk.poses[-2] is None
    np.testing.assert_allclose(walk.poses[-1], before @ AHEAD, atol=1e-9)


def test_long_graphs_are_solved_less_often():
    live, log = LivePoses(_AlwaysClosing(), LevenbergMarquardt()), FrameLog()
    solved = []
    for k in range(3000):
        step = Step("tracked", "", np.eye(4))
        log.add(FrameRecord(k, float(k), "tracked", ""), step)
        if live.due_loops(step, log):
            solved.append(k)
    live.finish()
    gaps = np.diff(solved)
    # Up to a thousand frames every loop takes effect when due.
    assert (gaps[: np.searchsorted(solved, 900)] == DELAY).all()
    assert (gaps >= 0.01 * np.array(solved[1:])).all()
    assert gaps[-1] <= 40
