"""Poses while frames arrive: components that were connected so far, and loops that closed.

A loop counts later than its frame, but always equally late.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.kernels.threads import job_pool
from tofuse.odometry.base import Step
from tofuse.pipeline.frame_log import FrameLog
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.loops import ClosedLoop, Loops
from tofuse.registration.base import Link

# A job begins at one frame and counts this many frames later, however soon it was done: the poses
# are then the same on every machine. A slow machine waits there.
DELAY = 10
# The graph is solved anew at the earliest after this fraction of the frames that it has, so that
# what a frame costs does not grow with those before it.
_LATER = 0.01


class LiveLoops:
    """Looks for loops on another thread.

    Attributes
    ----------
    closed
        Accepted loops that count already.
    """

    def __init__(self, loops: Loops) -> None:
        self.closed: list[ClosedLoop] = []
        self._loops = loops
        self._pool: ThreadPoolExecutor | None = None
        self._job: Future[list[ClosedLoop]] | None = None
        self._frames = 0
        self._due = 0

    def step(self) -> bool:
        """Go on by a frame with a pose, already known to the loops; True if new loops count now."""
        self._frames += 1
        found: list[ClosedLoop] = []
        if self._job is not None and self._frames >= self._due:
            found = [loop for loop in self._job.result() if loop.T_i_j is not None]
            self.closed += found
            self._job = None
        if self._job is None:
            work = self._loops.look()
            if work is not None:
                if self._pool is None:
                    self._pool = job_pool(1, "tofuse-loops")
                self._job = self._pool.submit(work)
                self._due = self._frames + DELAY
        return bool(found)

    def wait(self) -> None:
        """Wait for the job that is under way; what it found counts when it is due."""
        if self._job is not None:
            self._job.result()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the thread, with what the job found."""
        found = None if self._job is None else self._job.result()
        return {**self.__dict__, "_pool": None, "_job": found}

    def __setstate__(self, state: dict[str, Any]) -> None:
        found = state["_job"]
        self.__dict__.update(state)
        if found is not None:
            self._job = Future()
            self._job.set_result(found)

    def finish(self) -> None:
        """Wait for the job that is under way, and let the thread go."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool, self._job = None, None


class LivePoses:
    """Where the camera is in the frame of the first component, as known so far.

    The end decides anew which components are connected, and closes all loops.
    """

    def __init__(self, loops: Loops) -> None:
        self._loops = LiveLoops(loops)
        self._component = 0
        self._waiting = False  # loops that count, but have moved nothing yet
        self._since = 0  # frames of this component since the graph was solved
        self._size = 0  # frames of this component
        # Of the components that are connected to the first one, and what loops that closed on the
        # way have moved in the present one.
        self._T_world_component: dict[int, Float64] = {0: np.eye(4)}
        self._T_closed_tracked = np.eye(4)

    def follow(self, step: Step, log: FrameLog) -> list[ClosedLoop]:
        """Take the next frame; returns the loops of its component if new ones count now."""
        if step.component != self._component:
            self._component, self._T_closed_tracked = step.component, np.eye(4)
            self._waiting, self._since, self._size = False, 0, 0
        for link in step.links:
            self._connect(link, log)
        if step.T_component_camera is None:
            return []
        self._size, self._since = self._size + 1, self._since + 1
        self._waiting |= self._loops.step()
        if not self._waiting or self._since < _LATER * self._size:
            return []
        self._waiting, self._since = False, 0
        here = {e.record.index for e in log.of_component(step.component).posed}
        return [c for c in self._loops.closed if {c.record.i, c.record.j} <= here]

    def close(self, tracked: PoseGraph, optimised: PoseGraph) -> None:
        """Move what follows by as much as loops moved the last pose of a graph."""
        self._T_closed_tracked = optimised.poses[-1] @ se3.inverse(tracked.poses[-1])

    def pose(self, step: Step) -> Float64 | None:
        """T_world_camera (4, 4); None where it is lost, or not connected to the first component."""
        T_world_component = self._T_world_component.get(step.component)
        if step.T_component_camera is None or T_world_component is None:
            return None
        T = T_world_component @ self._T_closed_tracked @ step.T_component_camera
        return np.asarray(T, np.float64)

    def _connect(self, link: Link, log: FrameLog) -> None:
        a, b = log.step_of(link.i), log.step_of(link.j)
        known = self._T_world_component
        if not link.certain or a.component not in known or b.component in known:
            return
        assert a.T_component_camera is not None
        assert b.T_component_camera is not None
        T_a_b = a.T_component_camera @ link.T_i_j @ se3.inverse(b.T_component_camera)
        known[b.component] = known[a.component] @ T_a_b

    def wait(self) -> None:
        """Wait for loops that are being measured."""
        self._loops.wait()

    def finish(self) -> None:
        """Wait, and let the thread go."""
        self._loops.finish()
