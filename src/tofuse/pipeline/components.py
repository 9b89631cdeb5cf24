"""The final numbers of components, and models of those that are not connected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.pipeline.frame_log import FrameLog, poses_in_world
from tofuse.posegraph.joining import Group
from tofuse.posegraph.merged_components import Join, JoinKind
from tofuse.results.ranges import runs
from tofuse.results.types import Component, Reconstruction

# Reconstructs frames, given their poses in one frame and the joins of their components.
Reconstruct = Callable[[FrameLog, dict[int, Float64], Sequence[Join]], Reconstruction]

# An unconnected component gets its own model if it has more frames than this.
_MAX_WITHOUT_MODEL = 5


@dataclass(frozen=True, eq=False)
class _Part:
    """Components of the tracker that form one of the result, and their pose (4, 4)."""

    members: tuple[int, ...]
    group: Group
    T_main_component: Float64 | None
    connection: JoinKind | None


def numbered_components(
    log: FrameLog, groups: Sequence[Group], reconstruct: Reconstruct
) -> tuple[FrameLog, tuple[Component, ...]]:
    """Number components: the main one is 0, then in the order in which they began.

    Parameters
    ----------
    log
        All frames.
    groups
        Groups of connected tracker components, the main one first. Each other group becomes one
        component.
    reconstruct
        Reconstructs a component that is not connected to the main one.

    Returns
    -------
    The log with the final component in each record, and the components.
    """
    parts = _parts(groups)
    numbered = log.numbered({c: k for k, part in enumerate(parts) for c in part.members})
    components = []
    for k, part in enumerate(parts):
        is_member = [e.has_pose and e.record.component == k for e in numbered.entries]
        ranges = runs([e.record.index for e in log.entries], is_member)
        result = None
        if part.T_main_component is None and part.group.frames > _MAX_WITHOUT_MODEL:
            frames = [e.record.index for e in numbered.posed if e.record.component == k]
            component_log = log.of(frames)  # in its own model it is the main component
            poses = poses_in_world(component_log, part.group.T_group_component)
            result = reconstruct(component_log, poses, part.group.joins)
        components.append(Component(ranges, part.T_main_component, part.connection, result))
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
