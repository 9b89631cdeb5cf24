"""Views that the global stages work on: few enough to keep, and which of them overlap."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.kernels import refinement as kernels
from tofuse.kernels.alignment import POINT, POINT_SIZE, SIGMA
from tofuse.kernels.threads import run_chunks
from tofuse.maps.surface_map import SurfaceMap
from tofuse.posegraph import shared_error
from tofuse.registration.projective import points_of

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Integers = NDArray[np.intp]

# Of every view, to tell which views overlap: so many points, and an image of this width.
_OVERLAP_POINTS = 150
_OVERLAP_COLUMNS = 40
# Points see a surface if they are as near to it, as a share of their z, and face it like this.
_NEAR = 0.1
_FACING = 0.5


@dataclass(frozen=True, eq=False)
class KeptView:
    """A prepared view of few pixels, and the points that it gives as a source."""

    surface: SurfaceMap
    points: Float32

    @classmethod
    def of(cls, surface: SurfaceMap, points: int) -> KeptView:
        """Take about so many points of a view."""
        every = max(1, round(np.sqrt(surface.z.size / points)))
        return cls(surface, points_of(surface, every))

    @cached_property
    def coarse(self) -> SurfaceMap:
        """The surface at few pixels, which is enough to tell what overlaps."""
        return self.surface.thinned(_OVERLAP_COLUMNS)

    @cached_property
    def patches(self) -> NDArray[np.int64]:
        """(N,) the patch of the image that each point is of, see `shared_error`."""
        return shared_error.patches_of(self.points, self.surface)

    @cached_property
    def sigma(self) -> float:
        """Median sigma of the points' z, m."""
        p = self.points
        return float(np.median(p[:, SIGMA] * p[:, POINT + 2])) if len(p) else 0.01


@dataclass(frozen=True)
class Spacing:
    """Which views are kept.

    Attributes
    ----------
    angle, distance
        A view is kept when the camera has moved so far since the last that was: rad, and as a
        share of the median depth.
    most
        When there are more, every other one is dropped, and twice the motion is asked for.
    """

    angle: float = 0.03
    distance: float = 0.015
    most: int = 300

    def __post_init__(self) -> None:
        if not (self.angle >= 0 and self.distance >= 0):
            raise ValueError("angle and distance must be 0 or more")
        if not 2 <= self.most <= 100_000:
            raise ValueError(f"most is {self.most}, not 2 to 100000")


class Storable(Protocol):
    """What is kept of a view."""

    @property
    def index(self) -> int:
        """Of the frame in its recording."""
        ...

    @property
    def depth(self) -> float:
        """Median distance of what it sees, m."""
        ...


V = TypeVar("V", bound=Storable)


@dataclass(frozen=True, eq=False)
class PosedView(Generic[V]):
    """A view with its (4, 4) pose in the frame of its component."""

    view: V
    T_component_camera: Float64
    component: int = 0

    @property
    def index(self) -> int:
        """Of the frame in its recording."""
        return self.view.index


class ViewStore(Generic[V]):
    """The views that global stages work on: spaced by motion, and never more than so many.

    Parameters
    ----------
    spacing
        Which views are kept.
    always
        Frames that are kept in any case.

    Attributes
    ----------
    views
        In the order of their frames. The first of each component stays.
    """

    def __init__(self, spacing: Spacing, always: Collection[int] = ()) -> None:
        self.views: list[PosedView[V]] = []
        self._spacing, self._always = spacing, frozenset(always)
        self._stretch = 1.0

    def wants(
        self, index: int, depth: float, T_component_camera: Float64, component: int = 0
    ) -> bool:
        """Whether the next view is to be kept: the camera has moved enough, or it is asked for."""
        if not self.views or self.views[-1].component != component or index in self._always:
            return True
        motion = se3.inverse(self.views[-1].T_component_camera) @ T_component_camera
        s = self._spacing
        return bool(
            se3.angle(motion) >= s.angle * self._stretch
            or np.linalg.norm(motion[:3, 3]) >= s.distance * self._stretch * depth
        )

    def push(self, view: V, T_component_camera: Float64, component: int = 0) -> bool:
        """Add the next view if it is wanted; returns whether it is."""
        if not self.wants(view.index, view.depth, T_component_camera, component):
            return False
        self.views.append(PosedView(view, T_component_camera, component))
        if len(self.views) > self._spacing.most:
            self._drop_every_other()
            self._stretch *= 2
        return True

    def of(self, frames: Collection[int]) -> list[PosedView[V]]:
        """Views of some frames."""
        return [view for view in self.views if view.index in frames]

    def _drop_every_other(self) -> None:
        kept: list[PosedView[V]] = []
        count = 0
        for view in self.views:
            if not kept or kept[-1].component != view.component:
                count = 0
            if count % 2 == 0 or view.index in self._always:
                kept.append(view)
            count += 1
        # Where nearly every view is a component of its own, some of these have to go.
        self.views = kept if len(kept) < self._spacing.most else self.views[::2]


def overlaps(
    views: Sequence[KeptView], poses: Float64, least: float, *, first: int = 0
) -> tuple[Integers, Float64]:
    """Pairs of views that see at least a share `least` of each other, and that share.

    The share is the smaller of both ways. It counts points that lie near a surface of the other
    view which faces the same way, so it allows for poses that have drifted somewhat.

    Parameters
    ----------
    poses
        (N, 4, 4) T_world_camera.
    first
        Pairs with j before this view are left out.

    Returns
    -------
    pairs (M, 2), i < j, in the order of j, then i; shares (M,).
    """
    axes = poses[:, :3, 2]
    target, source = np.nonzero(np.triu(axes @ axes.T > 0, 1))
    late = source >= first
    target, source = target[late], source[late]
    share = _shares(views, poses, target, source, least)
    near = share >= least
    target, source = target[near], source[near]
    share = np.minimum(share[near], _shares(views, poses, source, target, least))
    order = np.lexsort((target, source))
    order = order[share[order] >= least]
    return np.stack([target[order], source[order]], 1), share[order]


def _shares(
    views: Sequence[KeptView], poses: Float64, target: Integers, source: Integers, least: float
) -> Float64:
    """Share of each source's points that its target sees; 0 where that is below `least`."""
    some = [v.points[:: max(1, len(v.points) // _OVERLAP_POINTS)] for v in views]
    starts = np.concatenate([[0], np.cumsum([len(points) for points in some])])
    points = np.concatenate(some) if some else np.zeros((0, POINT_SIZE), np.float32)
    inverse = se3.inverse(poses)
    # All sources of a target in turn: then the target need not be fetched again.
    order = np.argsort(target, kind="stable")
    different, begin = np.unique(target[order], return_index=True)
    end = np.append(begin[1:], len(order))
    out = np.zeros(len(target))

    def work(a: int, b: int) -> None:
        for k in range(a, b):
            rows = order[begin[k] : end[k]]
            view = views[different[k]].coarse
            found = np.empty(len(rows))
            kernels.overlaps(
                points,
                starts,
                source[rows],
                view.target,
                view.projection.lookup,
                view.projection.frame,
                inverse[different[k]],
                poses,
                _NEAR,
                _FACING,
                least,
                found,
            )
            out[rows] = found

    run_chunks(work, len(different), 32)
    return out
