"""Global stages of a run: join components, and reconstruct each connected part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import threads
from tofuse.engine.frames import frame_ranges
from tofuse.engine.geometry import se3
from tofuse.engine.loops import Group, JoinKind
from tofuse.engine.mapping.backend import BackEnd, Job
from tofuse.engine.mapping.frame_log import FrameLog, poses_in_world
from tofuse.engine.results import Component, Reconstruction
from tofuse.engine.stopwatch import timing

# An unconnected component gets its own model if it has more frames than this.
_MAX_WITHOUT_MODEL = 5


@dataclass(frozen=True, eq=False)
class _Part:
    """Components of the tracker that form one of the result, and their pose (4, 4)."""

    members: tuple[int, ...]
    group: Group
    T_main_component: Float64 | None
    connection: JoinKind | None


@dataclass(frozen=True, eq=False)
class Assembly:
    """Reconstructs tracked frames from stored observations.

    Attributes
    ----------
    job
        The recording.
    """

    job: Job
    seed: int
    threads: int

    def run(self, log: FrameLog) -> Reconstruction:
        """Join components, and reconstruct them: the main one last."""
        with threads(self.threads):
            groups = self._join(log)
            log, components = self._components(log, groups)
            poses = poses_in_world(log, groups[0].T_group_component)
            result = BackEnd(self.job, log, poses, groups[0].joins).run(components)
        return replace(result, seed=self.seed, threads=self.threads)

    @timing("joining")
    def _join(self, log: FrameLog) -> list[Group]:
        """Decide from all views which components are connected, and how."""
        components = log.tracked_components(self.job.observations.views)
        if len(components) > 1:
            self.job.progress.stage("joining components")
        config = self.job.config
        return config.joining.join(components, log.links, config.search)

    def _components(
        self, log: FrameLog, groups: Sequence[Group]
    ) -> tuple[FrameLog, tuple[Component, ...]]:
        """Number components, and reconstruct those that are not connected to the main one.

        The main one is 0, then in the order in which they began. Returns the log with the final
        component in each record, and the components.
        """
        parts = _parts(groups)
        numbered = log.numbered({c: k for k, part in enumerate(parts) for c in part.members})
        components = []
        for k, part in enumerate(parts):
            is_member = [e.has_pose and e.record.component == k for e in numbered.entries]
            ranges = frame_ranges.runs([e.record.index for e in log.entries], is_member)
            result = None
            if part.T_main_component is None and part.group.frames > _MAX_WITHOUT_MODEL:
                frames = [e.record.index for e in numbered.posed if e.record.component == k]
                component_log = log.of(frames)  # in its own model it is the main component
                poses = poses_in_world(component_log, part.group.T_group_component)
                back_end = BackEnd(self.job, component_log, poses, part.group.joins)
                result = replace(back_end.run(()), seed=self.seed, threads=self.threads)
            components.append(
                Component(
                    ranges, part.T_main_component, part.connection, result, part.group.reached
                )
            )
        return numbered, tuple(components)


def _parts(groups: Sequence[Group]) -> list[_Part]:
    main = groups[0]
    first = next(iter(main.T_group_component))
    to_first = se3.inverse(main.T_group_component[first])
    parts = [
        _Part((c,), main, to_first @ T, None if c == first else main.connection(c))
        for c, T in main.T_group_component.items()
    ]
    parts += [_Part(tuple(g.T_group_component), g, None, None) for g in groups[1:]]
    return [parts[0], *sorted(parts[1:], key=lambda part: min(part.members))]
