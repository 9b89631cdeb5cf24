"""Refinement of clouds as a part: planes that all views share (see `common_planes`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured, PoseGraph, external_sensors
from tofuse.engine.parts import part
from tofuse.engine.refinement.common_planes import SUPPORT_NOISE, Aligned, refine_clouds
from tofuse.engine.refinement.refinement import (
    MAX_LOSS,
    Refinement,
    RefinementMethod,
    Refiner,
    with_unsupported_views_fixed,
)
from tofuse.engine.stored_views import Spacing, ViewStore
from tofuse.engine.views import PreparedView


@part("refinement", "planes")
@dataclass(frozen=True)
class Planes(Bounded, RefinementMethod):
    """Moves all clouds to the planes that they share (eq 2.8 with an unknown surface).

    See `refine_clouds`. Views are kept by the motion of their points; frames in between follow
    them. The result is accepted only if the views support each other about as well as before, and
    views that lose support keep their pose relative to their neighbours.

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
    """Sampled points (n, 3) of a view in its frame, and their median distance from their centre.

    The position of the sensor is unknown: the origin may be that of a site or a map, which is the
    same for all views. So views are spaced by the motion of their points.
    """

    index: int
    depth: float
    points: Float64
    centre: Float64

    @classmethod
    def of(cls, view: Frame, max_points: int) -> SampledPoints:
        """Sample at most `max_points` points, at an even stride."""
        points = view.points[:: max(1, -(-len(view) // max_points))].astype(np.float64)
        centre = np.median(points, axis=0) if len(points) else np.zeros(3)
        depth = float(np.median(np.linalg.norm(points - centre, axis=1))) if len(points) else 0.0
        return cls(view.index, depth, points, centre)

    def placed(self, T_component_view: Float64) -> Float64:
        """Return the pose (4, 4) by which views are spaced: that of the centre, m."""
        return T_component_view @ se3.translation(self.centre)


class _Planes(Refiner):
    def __init__(self, options: Planes) -> None:
        self._options = options
        self._store: ViewStore[SampledPoints] = ViewStore(
            Spacing(max_views=options.max_views, max_stretch=1e6)
        )

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Refiner.push`."""
        sampled = SampledPoints.of(view, self._options.points)
        self._store.push(sampled, sampled.placed(T_component_camera))

    def finish(self, graph: PoseGraph, sensors: external_sensors.SensorPriors) -> Refinement:
        """See `Refiner.finish`."""
        poses, row = graph.poses, {int(index): k for k, index in enumerate(graph.ids)}
        views = [posed.view for posed in self._store.of(row)]
        if len(views) < 2:
            return Refinement(poses, views=len(views))
        positions = np.array([row[view.index] for view in views], np.intp)
        before = poses[positions]
        aligned = refine_clouds([view.points for view in views], before)
        mean = float(aligned.before.mean()), float(aligned.after.mean())
        unchanged = Refinement(poses, False, len(views), len(aligned.pairs), support=mean)
        if not len(aligned.pairs) or mean[1] < mean[0] - SUPPORT_NOISE:
            return unchanged
        lost = aligned.after < aligned.before - MAX_LOSS
        after = with_unsupported_views_fixed(before, aligned.poses, lost)
        edges = tuple(_edges(aligned, [view.index for view in views], lost))
        return replace(unchanged.accepted(positions, after), edges=edges)


def _edges(aligned: Aligned, ids: Sequence[int], lost: Bool) -> list[Measured]:
    """Joint measurements of neighbouring views; those of all pairs would count them repeatedly."""
    out = []
    for (i, j), C in zip(aligned.pairs, aligned.covariance, strict=True):
        if j == i + 1 and not (lost[i] or lost[j]):
            T = se3.inverse(aligned.poses[i]) @ aligned.poses[j]
            out.append(Measured(ids[i], ids[j], T, np.linalg.inv(C)))
    return out
