"""Online poses, with the components connected and the loops closed so far.

A loop takes effect a fixed number of frames after it was searched for.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from tofuse.engine.alignment import Link
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import job_pool
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Optimiser, PoseGraph, graph_covariances
from tofuse.engine.loops import ClosedLoop, Loops
from tofuse.engine.mapping.frame_log import FrameLog, poses_in_world
from tofuse.engine.mapping.tracked_graph import TrackedGraph
from tofuse.engine.tracking import Step

# The loops of a search take effect this number of frames after its start, even if it finished
# earlier, so that poses are the same on every machine. A slow machine waits for it.
DELAY = 10
# The graph is optimised again after this fraction of new frames at the earliest, so that the cost
# per frame is constant.
_MIN_NEW_FRACTION = 0.01


class LiveLoops:
    """Searches for loops on another thread.

    Attributes
    ----------
    closed
        Accepted loops that are in effect.
    """

    def __init__(self, loops: Loops) -> None:
        self.closed: list[ClosedLoop] = []
        self._loops = loops
        self._pool: ThreadPoolExecutor | None = None
        self._job: Future[list[ClosedLoop]] | None = None
        self._frames = 0
        self._due = 0

    def advance(self) -> bool:
        """Advance by a posed frame, already pushed to the loops; whether new loops closed."""
        self._frames += 1
        new_loops: list[ClosedLoop] = []
        if self._job is not None and self._frames >= self._due:
            new_loops = [loop for loop in self._job.result() if loop.T_i_j is not None]
            self.closed += new_loops
            self._job = None
        if self._job is None:
            job = self._loops.detection_job()
            if job is not None:
                if self._pool is None:
                    self._pool = job_pool(1, "tofuse-loops")
                self._job = self._pool.submit(job)
                self._due = self._frames + DELAY
        return bool(new_loops)

    def finish(self) -> None:
        """Wait for the running search, and end the thread."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool, self._job = None, None


class LivePoses:
    """Current poses in the frame of the first component.

    At the end of the recording components are joined and loops are closed again.
    """

    def __init__(self, loops: Loops, optimiser: Optimiser) -> None:
        self._loops, self._optimiser = LiveLoops(loops), optimiser
        self._component = 0
        self._pending = False  # whether there are closed loops that were not yet optimised
        self._n_new = 0  # frames of this component since the last optimisation
        self._n_frames = 0  # frames of this component
        # Poses of the components that are connected to the first one; the correction of new frames
        # by loops, and those of frames that were corrected, by index.
        self._T_world_component: dict[int, Float64] = {0: np.eye(4)}
        self._T_closed_tracked = np.eye(4)
        self._corrections: dict[int, Float64] = {}
        # Of frames that were asked for, by index; None where a direction is not measured.
        self._covariances: dict[int, Float64 | None] = {}

    def update(self, step: Step, log: FrameLog) -> None:
        """Add the next frame; correct this and the following poses if loops have closed."""
        loops = self.due_loops(step, log)
        if not loops:
            return
        component_log = log.of_component(step.component)
        poses = poses_in_world(component_log, {step.component: np.eye(4)})
        tracked = TrackedGraph(component_log.posed, poses, ()).build(loops)
        optimised = self._optimiser.optimise(tracked).graph
        corrections = optimised.poses @ se3.inverse(tracked.poses)
        self._T_closed_tracked = corrections[-1]
        self._corrections.update(zip(optimised.ids.tolist(), corrections, strict=True))

    def due_loops(self, step: Step, log: FrameLog) -> list[ClosedLoop]:
        """Add the next frame; return the loops of its component if optimisation is due, else []."""
        for link in step.links:
            self._connect(link, log)
        if step.T_component_camera is None:  # a lost frame is in no component
            return []
        if step.component != self._component:
            self._component, self._T_closed_tracked = step.component, np.eye(4)
            self._pending, self._n_new, self._n_frames = False, 0, 0
        self._n_frames, self._n_new = self._n_frames + 1, self._n_new + 1
        self._pending |= self._loops.advance()
        if not self._pending or self._n_new < _MIN_NEW_FRACTION * self._n_frames:
            return []
        self._pending, self._n_new = False, 0
        return self._closed_among(log.of_component(step.component))

    def _closed_among(self, log: FrameLog) -> list[ClosedLoop]:
        frames = {e.record.index for e in log.posed}
        return [c for c in self._loops.closed if {c.record.i, c.record.j} <= frames]

    def graph(self, component: int, log: FrameLog) -> PoseGraph:
        """Return the graph of a component, given its log, optimised if loops have closed."""
        loops = self._closed_among(log)
        poses = poses_in_world(log, {component: np.eye(4)})
        graph = TrackedGraph(log.posed, poses, ()).build(loops)
        if not loops:
            return graph
        return graph_covariances.accepted_only(self._optimiser.optimise(graph)).graph

    def pose(self, step: Step) -> Float64 | None:
        """Return T_world_camera (4, 4); None if lost, or not connected to the first component."""
        T_world_component = self._T_world_component.get(step.component)
        if step.T_component_camera is None or T_world_component is None:
            return None
        T = T_world_component @ self._T_closed_tracked @ step.T_component_camera
        return np.asarray(T, np.float64)

    def covariance(self, index: int, log: FrameLog) -> Float64 | None:
        """Return the (6, 6) covariance of the pose of a frame of the first component as tracked.

        None if a direction is not measured. Those of its references are computed first.
        """
        chain: list[int] = []
        reference: int | None = index
        while reference is not None and reference not in self._covariances:
            chain.append(reference)
            reference = log.step_of(reference).reference
        for k in reversed(chain):
            self._covariances[k] = self._propagated(log.step_of(k))
        return self._covariances[index]

    def _propagated(self, step: Step) -> Float64 | None:
        """The covariance of a pose from that of its reference and the registration."""
        r = step.registration
        if r is None or step.reference is None:
            return np.zeros((6, 6))
        C_reference = self._covariances[step.reference]
        if C_reference is None or len(r.unobservable):
            return None
        r = r.between(np.eye(4), np.eye(4))  # about the frame's own origin
        A = se3.adjoint(se3.inverse(r.T_target_source))
        return np.asarray(A @ C_reference @ A.T + np.linalg.inv(r.information), np.float64)

    def _connect(self, link: Link, log: FrameLog) -> None:
        a, b = log.step_of(link.i), log.step_of(link.j)
        T_world = self._T_world_component
        if not link.certain or a.component not in T_world or b.component in T_world:
            return
        assert a.T_component_camera is not None
        assert b.T_component_camera is not None
        T_a_b = a.T_component_camera @ link.T_i_j @ se3.inverse(b.T_component_camera)
        newest = self._T_closed_tracked if a.component == self._component else np.eye(4)
        T_world[b.component] = T_world[a.component] @ self._corrections.get(link.i, newest) @ T_a_b

    def finish(self) -> None:
        """Wait for the running search, and end the thread."""
        self._loops.finish()
