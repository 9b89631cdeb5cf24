"""Views that the global stages work on: few enough to keep, and which of them overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.kernels import refinement as kernels
from tofuse.kernels.alignment import POINT, SIGMA
from tofuse.kernels.threads import run_chunks
from tofuse.maps.surface_map import SurfaceMap
from tofuse.registration.projective import points_of

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Integers = NDArray[np.intp]

# Of every view, to tell which views overlap.
_OVERLAP_POINTS = 150
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


class Placed(Protocol):
    """What is kept of a view."""

    @property
    def index(self) -> int:
        """Of the frame in its recording."""
        ...

    @property
    def depth(self) -> float:
        """Median distance of what it sees, m."""
        ...


V = TypeVar("V", bound=Placed)


class ViewStore(Generic[V]):
    """Keeps views spaced by the motion of the camera, and never more than a fixed number.

    Attributes
    ----------
    views
        The kept views, oldest first; the first one that was pushed stays.
    """

    def __init__(self, spacing: Spacing) -> None:
        self.views: list[V] = []
        self._poses: list[Float64] = []
        self._spacing = spacing
        self._stretch = 1.0

    def push(self, view: V, T_world_camera: Float64) -> None:
        """Add the next view that has a pose."""
        if self.views and not self._far(view, self._poses[-1], T_world_camera):
            return
        self.views.append(view)
        self._poses.append(T_world_camera)
        if len(self.views) > self._spacing.most:
            self.views, self._poses = self.views[::2], self._poses[::2]
            self._stretch *= 2

    def _far(self, view: V, T_before: Float64, T: Float64) -> bool:
        motion = se3.inverse(T_before) @ T
        s = self._spacing
        return bool(
            se3.angle(motion) >= s.angle * self._stretch
            or np.linalg.norm(motion[:3, 3]) >= s.distance * self._stretch * view.depth
        )


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
    some = [
        np.ascontiguousarray(v.points[:: max(1, len(v.points) // _OVERLAP_POINTS)]) for v in views
    ]
    axes = poses[:, :3, 2]
    inverse = se3.inverse(poses)

    def seen(target: int, source: int) -> float:
        surface = views[target].surface
        return float(
            kernels.overlap(
                some[source],
                surface.target,
                surface.projection.lookup,
                surface.projection.frame,
                np.ascontiguousarray(inverse[target] @ poses[source]),
                _NEAR,
                _FACING,
            )
        )

    def rows(a: int, b: int) -> list[tuple[int, int, float]]:
        found = []
        for j in range(first + a, first + b):
            for i in np.flatnonzero(axes[:j] @ axes[j] > 0):
                share = seen(int(i), j)
                if share >= least:
                    share = min(share, seen(j, int(i)))
                if share >= least:
                    found.append((int(i), j, share))
        return found

    found = [pair for chunk in run_chunks(rows, len(views) - first, 32) for pair in chunk]
    pairs = np.array([pair[:2] for pair in found], np.intp).reshape(-1, 2)
    return pairs, np.array([pair[2] for pair in found])
