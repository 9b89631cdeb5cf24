"""Refinement of clouds as a part: planes that all views share (see `common_planes`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from tofuse.arrays import Bool, Float64
from tofuse.bounds import Bounded, Bounds
from tofuse.geometry import se3
from tofuse.parts import part
from tofuse.posegraph.build import Measured
from tofuse.posegraph.common_planes import CHANCE, Aligned, PlaneOptions, refine_clouds
from tofuse.posegraph.external_sensors import SensorPriors
from tofuse.posegraph.refinement import (
    MAX_LOSS,
    Refinement,
    RefinementMethod,
    Refiner,
    moved_to,
    with_unsupported_views_fixed,
)
from tofuse.posegraph.view_store import Spacing, ViewStore
from tofuse.recordings.frames import Frame
from tofuse.registration.prepared_view import PreparedView


@part("refinement", "planes")
@dataclass(frozen=True)
class Planes(Bounded, RefinementMethod):
    """Moves all clouds to the planes that they share (eq 2.8 with an unknown surface).

    See `refine_clouds`. Views are kept by the motion of the camera; frames in between follow
    them. The outcome is accepted only if the views support each other about as well as before, and
    views that lose support stay where their neighbours had them.

    Attributes
    ----------
    max_views
        Maximum number of views that take part.
    points
        Maximum number of points of each view, taken at an even stride.
    """

    max_views: Annotated[int, Bounds(2, 100_000)] = 100
    points: Annotated[int, Bounds(100)] = 5000

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `RefinementMethod.start`."""
        return _Planes(self)


@dataclass(frozen=True, eq=False)
class SampledPoints:
    """What is kept of a view: some (n, 3) of its points in its frame, and their median range, m."""

    index: int
    depth: float
    points: Float64

    @classmethod
    def of(cls, view: Frame, most: int) -> SampledPoints:
        """Keep at most so many points, at an even stride."""
        points = view.points[:: max(1, -(-len(view) // most))].astype(np.float64)
        depth = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
        return cls(view.index, depth, points)


class _Planes(Refiner):
    def __init__(self, options: Planes) -> None:
        self._options = options
        self._store: ViewStore[SampledPoints] = ViewStore(
            Spacing(most=options.max_views, max_stretch=1e6)
        )

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Refiner.push`."""
        self._store.push(SampledPoints.of(view, self._options.points), T_component_camera)

    def finish(
        self, ids: Sequence[int], poses: Float64, measured: SensorPriors | None = None
    ) -> Refinement:
        """See `Refiner.finish`."""
        row = {int(index): k for k, index in enumerate(ids)}
        views = [posed.view for posed in self._store.of(row)]
        if len(views) < 2:
            return Refinement(poses, views=len(views))
        at = np.array([row[view.index] for view in views], np.intp)
        before = poses[at]
        found = refine_clouds([view.points for view in views], before, PlaneOptions())
        mean = float(found.before.mean()), float(found.after.mean())
        unchanged = Refinement(poses, False, len(views), len(found.pairs), support=mean)
        if not len(found.pairs) or mean[1] < mean[0] - CHANCE:
            return unchanged
        lost = found.after < found.before - MAX_LOSS
        after = with_unsupported_views_fixed(before, found.poses, lost)
        edges = tuple(_edges(found, [view.index for view in views], lost))
        return replace(moved_to(unchanged, at, after), edges=edges)


def _edges(found: Aligned, ids: Sequence[int], lost: Bool) -> list[Measured]:
    """Joint measurements of neighbouring views; those of all pairs would be counted many times."""
    out = []
    for (i, j), C in zip(found.pairs, found.covariance, strict=True):
        if j == i + 1 and not (lost[i] or lost[j]):
            T = se3.inverse(found.poses[i]) @ found.poses[j]
            out.append(Measured(ids[i], ids[j], T, np.linalg.inv(C)))
    return out
