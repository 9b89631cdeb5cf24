"""Global stages of a run: join components, and reconstruct each connected part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64
from tofuse.kernels.threads import threads
from tofuse.pipeline.backend import BackEnd
from tofuse.pipeline.checkpoint import NoCheckpoints, Stages
from tofuse.pipeline.components import numbered_components
from tofuse.pipeline.config import Config
from tofuse.pipeline.frame_log import FrameLog, poses_in_world
from tofuse.pipeline.observations import Observations
from tofuse.pipeline.progress import Progress, Stopwatch
from tofuse.pipeline.tracked_graph import TrackedGraph
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.joining import Group
from tofuse.posegraph.loops import ClosedLoop, PriorLoop
from tofuse.posegraph.merged_components import Join
from tofuse.results.types import Reconstruction


@dataclass(frozen=True, eq=False)
class Assembly:
    """Reconstructs tracked frames from stored observations.

    Attributes
    ----------
    observations
        The store of observations.
    prior_loops
        Given loops.
    """

    config: Config
    observations: Observations
    prior_loops: tuple[PriorLoop, ...]
    progress: Progress
    watch: Stopwatch
    seed: int
    threads: int

    def run(self, log: FrameLog, stages: Stages) -> Reconstruction:
        """Join components, and reconstruct them: the main one last."""
        with threads(self.threads):
            groups = self._join(log, stages)
            log, components = numbered_components(log, groups, self._reconstruct_separate)
            poses = poses_in_world(log, groups[0].T_group_component)
            result = self._back_end(log, poses, groups[0].joins).run(stages, components)
        return replace(result, seed=self.seed, threads=self.threads)

    def graph(self, log: FrameLog, component: int, loops: Sequence[ClosedLoop]) -> PoseGraph:
        """Return the pose graph of a component as tracked, with loops."""
        component_log = log.of_component(component)
        poses = poses_in_world(component_log, {component: np.eye(4)})
        return TrackedGraph(component_log.posed, poses, ()).build(loops)

    def _join(self, log: FrameLog, stages: Stages) -> list[Group]:
        """Decide from all views which components are connected, and how."""
        saved = stages.load("joining")
        if saved is not None:
            self.watch.seconds.update(saved[1])
            return list(saved[0])
        components = log.tracked_components(self.observations.views)
        if len(components) > 1:
            self.progress.stage("joining components")
        with self.watch.timing("joining"):
            groups = self.config.joining.join(components, log.links, self.config.search)
        stages.save("joining", (groups, dict(self.watch.seconds)))
        return groups

    def _reconstruct_separate(
        self, log: FrameLog, poses: dict[int, Float64], joins: Sequence[Join]
    ) -> Reconstruction:
        """Reconstruct a component that is not connected to the main one."""
        result = self._back_end(log, poses, joins).run(NoCheckpoints(), ())
        return replace(result, seed=self.seed, threads=self.threads)

    def _back_end(self, log: FrameLog, poses: dict[int, Float64], joins: Sequence[Join]) -> BackEnd:
        return BackEnd(
            self.config,
            log,
            poses,
            joins,
            self.prior_loops,
            self.observations.for_back_end(),
            self.progress,
            self.watch,
        )
