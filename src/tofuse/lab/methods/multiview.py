"""Joint registration of many views by corresponding points (section 2.10, eq 2.8).

Correspondences and poses are updated alternately. Methods differ in how correspondences determine
the poses: each is a `RelaxationMethod`, in its own file.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.graph import PoseGraph, external_sensors
from tofuse.engine.icp import icp_kernels, surface_shape
from tofuse.engine.refinement import Refinement, RefinementMethod, Refiner, plane_refinement
from tofuse.engine.stored_views import Spacing, ViewStore
from tofuse.engine.views import PreparedView

# Min fraction and number of points with a partner in an overlapping view.
_MIN_OVERLAP, _MIN_POINTS = 0.1, 30
# Largest displacement of a point at convergence, in resolutions.
_CONVERGENCE = 1e-3


@dataclass(frozen=True, eq=False)
class Cloud:
    """A view of the joint registration.

    Attributes
    ----------
    view
        The points, as a cloud.
    points, normals
        (n, 3) in the view's frame, m; normals may be NaN.
    boundary
        (n,) whether a point is on the surface boundary. Points of other views beyond it are closest
        to these points, and not paired (Turk and Levoy 1994).
    tree
        Of the points.
    """

    view: CloudFrame
    points: Float64
    normals: Float64
    boundary: Bool
    tree: KdTree

    @classmethod
    def of(cls, view: CloudFrame) -> Cloud:
        """Prepare the points of a view."""
        points = view.points.astype(np.float64)
        shape = surface_shape.shape_at(view, np.arange(len(points)))
        return cls(view, points, shape.normals, shape.boundary, KdTree(points))


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points of view i and their closest points of view j.

    Attributes
    ----------
    i, j
        Indices of the views.
    p_i, p_j
        (m, 3) the points, each in its own view's frame.
    n_j
        (m, 3) unit normals of view j at p_j, in its frame; may be NaN.
    """

    i: int
    j: int
    p_i: Float64
    p_j: Float64
    n_j: Float64


@dataclass(frozen=True)
class RelaxationMethod(Bounded, RefinementMethod):
    """A joint refinement of all views by corresponding points.

    Attributes
    ----------
    points
        Maximum number per view, at an even stride.
    reach
        Largest distance of paired points, in resolutions (the median distance of neighbours).
    rounds
        Maximum number of pairing rounds.
    views
        Maximum number of views, spaced by the camera's motion; the others follow them.
    """

    points: Annotated[int, Bounds(1)] = 2000
    reach: Annotated[float, Bounds(0, exclusive=True)] = 5.0
    rounds: Annotated[int, Bounds(1)] = 60
    views: Annotated[int, Bounds(1)] = 60

    @abstractmethod
    def relax(self, poses: Float64, pairs: Sequence[Pairs], clouds: Sequence[Cloud]) -> Float64:
        """Return the poses (N, 4, 4) T_world_view determined by the pairs; the first is fixed."""
        ...

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `RefinementMethod.start`."""
        return _Relaxation(self)


class _Relaxation(Refiner):
    needs_points: ClassVar[bool] = True

    def __init__(self, method: RelaxationMethod) -> None:
        self._method = method
        self._store: ViewStore[plane_refinement.SampledPoints] = ViewStore(
            Spacing(max_views=method.views, max_stretch=1e6)
        )

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Refiner.push`."""
        sampled = plane_refinement.SampledPoints.of(view, self._method.points)
        self._store.push(sampled, sampled.placed(T_component_camera))

    def finish(self, graph: PoseGraph, sensors: external_sensors.SensorPriors) -> Refinement:
        """See `Refiner.finish`; rejected if the support decreases."""
        poses, row = graph.poses, {int(index): k for k, index in enumerate(graph.ids)}
        sampled = [posed.view for posed in self._store.of(row)]
        sampled = [k for k in sampled if len(k.points) >= _MIN_POINTS]
        if len(sampled) < 2:
            return Refinement(poses, views=len(sampled))
        rows = np.array([row[k.index] for k in sampled], np.intp)
        clouds = [Cloud.of(CloudFrame.of(k.points, index=k.index)) for k in sampled]
        relaxed_poses = relax_poses(self._method, clouds, poses[rows])
        reach = self._method.reach * resolution_of(clouds)
        pairs, pairs_after = (
            closest_pairs(clouds, view_poses, reach) for view_poses in (poses[rows], relaxed_poses)
        )
        support = (
            _support(poses[rows], pairs, reach, clouds),
            _support(relaxed_poses, pairs_after, reach, clouds),
        )
        unchanged = Refinement(poses, False, len(clouds), len(pairs_after), support=support)
        improved = bool(pairs_after) and support[1] >= support[0]
        return unchanged.accepted(rows, relaxed_poses) if improved else unchanged


def relax_poses(method: RelaxationMethod, clouds: Sequence[Cloud], poses: Float64) -> Float64:
    """Pair and move views until convergence; poses (N, 4, 4) T_world_view, the first is fixed."""
    resolution = resolution_of(clouds)
    for _ in range(method.rounds):
        pairs = closest_pairs(clouds, poses, method.reach * resolution)
        if not pairs:
            break
        updated = method.relax(poses, pairs, clouds)
        updated = se3.orthonormalise(poses[0] @ se3.inverse(updated[0]) @ updated)
        displacement = max(
            float(
                np.abs(
                    icp_kernels.transform_points(a, c.points)
                    - icp_kernels.transform_points(b, c.points)
                ).max()
            )
            for a, b, c in zip(poses, updated, clouds, strict=True)
        )
        poses = updated
        if displacement < _CONVERGENCE * resolution:
            break
    return poses


def resolution_of(clouds: Sequence[Cloud]) -> float:
    """Median distance of neighbours of the median view, m."""
    nearest = [np.median(c.tree.neighbours(c.points, 2)[1][:, 1]) for c in clouds]
    return float(np.sqrt(np.median(nearest)))


def closest_pairs(clouds: Sequence[Cloud], poses: Float64, reach: float) -> list[Pairs]:
    """Closest points of all overlapping views, in both directions; `reach` in m."""
    out = []
    for i, source in enumerate(clouds):
        for j, target in enumerate(clouds):
            if i == j:
                continue
            transformed = icp_kernels.transform_points(
                se3.inverse(poses[j]) @ poses[i], source.points
            )
            nearest, _ = target.tree.nearest(transformed, reach)
            a = np.flatnonzero((nearest >= 0) & ~target.boundary[nearest])
            if len(a) >= max(_MIN_POINTS, _MIN_OVERLAP * len(transformed)):
                b = nearest[a]
                out.append(Pairs(i, j, source.points[a], target.points[b], target.normals[b]))
    return out


def _support(
    poses: Float64, pairs: Sequence[Pairs], reach: float, clouds: Sequence[Cloud]
) -> float:
    """Closeness of points to those of other views: up to 1 per view that also sees them."""
    total = sum(len(c.points) for c in clouds)
    closeness = 0.0
    for p in pairs:
        difference = icp_kernels.transform_points(poses[p.i], p.p_i) - icp_kernels.transform_points(
            poses[p.j], p.p_j
        )
        closeness += float((1 - np.linalg.norm(difference, axis=1) / reach).sum())
    return closeness / max(total, 1)
