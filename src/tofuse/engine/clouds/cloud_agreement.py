"""Agreement of two clouds at a pose: coincident surfaces and free-space violations.

As `agreement`, for views without a camera. The distance tolerance follows from the thickness of
the surfaces at the resolution of the comparison. Free space is known only for views with a known
viewpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.clouds import distinct_surfaces
from tofuse.engine.clouds.fpfh import MAX_VIOLATION, VIOLATION_WEIGHT
from tofuse.engine.clouds.viewpoint import RangeSphere, Viewpoint, free_space_viewpoint
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import surface_shape
from tofuse.engine.search import pair_agreement

# Points of each plane fit.
NEIGHBOURS = 12
# Maximum numbers of points of each view that are compared, and tested for free-space violations.
_COMPARED_POINTS, _FREE_SPACE_POINTS = 2500, 5000
# Cosine of the incidence angle below which a surface is at grazing incidence.
_MIN_INCIDENCE_COSINE = 0.25
# Surfaces coincide within a number of standard deviations of their points, plus a fraction of the
# resolution for the error of plane fits at curved surfaces.
_SIGMAS, _CURVATURE_TOLERANCE = 3.0, 0.25
# Maximum distance of corresponding points, in resolutions.
_MAX_DISTANCE = 2.0
# Cosine of the largest angle between normals of surfaces that support each other.
_MIN_NORMAL_COSINE = 0.75
# A point is in free space if it lies in front of the surface by more than this fraction of the
# range plus the tolerance.
_IN_FRONT = 0.02


@dataclass(frozen=True)
class CloudAgreement(pair_agreement.Agreement):
    """Agreement of two clouds, also by distinct surfaces (`distinct_surfaces`).

    Attributes
    ----------
    surfaces
        Number of distinct surfaces that coincide.
    near_surfaces
        Number of those that are near one of the other view, whether or not they coincide.
    """

    surfaces: float = 0.0
    near_surfaces: float = 0.0

    @property
    def coincidence(self) -> float:
        """Fraction of the surfaces near each other that coincide."""
        return self.surfaces / max(self.near_surfaces, 1e-9)

    @property
    def uncontradicted_surfaces(self) -> float:
        """Number of surfaces that coincide, less as many as free space contradicts."""
        return self.surfaces * min(max(self.score, 0.0) / max(self.support, 1e-9), 1.0)


@dataclass(frozen=True, eq=False)
class CloudMap:
    """A cloud averaged to a resolution, with its surfaces and its free space.

    Attributes
    ----------
    view
        The averaged points.
    normals
        (n, 3) unit normals, NaN where points lie on no surface.
    sigma
        Typical distance of points from their planes, m.
    size
        Resolution, m.
    tested
        (m, 3) points that are tested for free-space violations, m; m = 0 without a viewpoint.
        Mixed pixels at edges and at grazing incidence are excluded, as they violate free space
        even at the right pose (2 % of the points of a torso).
    viewpoint, sphere
        Viewpoint, and range in each direction; None if unknown.
    """

    view: CloudFrame
    normals: Float64
    sigma: float
    size: float
    tested: Float64
    viewpoint: Viewpoint | None
    sphere: RangeSphere | None

    @classmethod
    def of(cls, view: CloudFrame, size: float, full_view: Frame) -> CloudMap:
        """Prepare a view that was averaged from `full_view`."""
        shape = surface_shape.shape_at(view, np.arange(len(view)), NEIGHBOURS)
        thickness = shape.thickness[np.isfinite(shape.thickness)]
        sigma = float(np.median(thickness)) if len(thickness) else size
        viewpoint = free_space_viewpoint(full_view)
        sphere = None if viewpoint is None else RangeSphere.of(full_view, viewpoint)
        tested = (
            np.zeros((0, 3)) if viewpoint is None else _tested_points(view, shape, viewpoint.origin)
        )
        return cls(view, shape.normals, sigma, size, tested, viewpoint, sphere)

    @property
    def tree(self) -> KdTree:
        """kd-tree over the averaged points."""
        return surface_shape.tree_of(self.view)

    @cached_property
    def compared(self) -> tuple[Float64, Float64]:
        """Evenly chosen points (n, 3) on surfaces, and their normals (n, 3)."""
        valid = np.flatnonzero(np.isfinite(self.normals).all(1))
        valid = valid[:: max(1, -(-len(valid) // _COMPARED_POINTS))]
        return self.view.points[valid].astype(np.float64), self.normals[valid]

    @cached_property
    def surface_share(self) -> Float64:
        """Share (n,) of each compared point in its plane, see `distinct_surfaces`."""
        return distinct_surfaces.shares(*self.compared, tolerance(self, self))


def _tested_points(view: CloudFrame, shape: surface_shape.Shape, viewpoint: Float64) -> Float64:
    """Return points (m, 3) on surfaces, except at edges and grazing incidence."""
    points = view.points.astype(np.float64)
    rays = points - viewpoint
    facing = np.abs((shape.normals * rays).sum(1)) > _MIN_INCIDENCE_COSINE * np.linalg.norm(
        rays, axis=1
    )
    selected = np.flatnonzero(facing & ~shape.boundary)  # a nan faces nothing
    return points[selected[:: max(1, -(-len(selected) // _FREE_SPACE_POINTS))]]


def are_oriented(source: CloudMap, target: CloudMap) -> bool:
    """Whether the normals of both point to where they were seen from, so that sides are known.

    From two rooms either side of the wall between them is seen. These must not be laid together.
    """
    return all(m.viewpoint is not None and not m.viewpoint.fused for m in (source, target))


def tolerance(source: CloudMap, target: CloudMap) -> float:
    """Return the distance in m within which surfaces of two views coincide."""
    noise = float(np.hypot(source.sigma, target.sigma))
    return _SIGMAS * noise + _CURVATURE_TOLERANCE * max(source.size, target.size)


def cloud_agreement(source: CloudMap, target: CloudMap, T_target_source: Float64) -> CloudAgreement:
    """Return the agreement of both views at a pose (4, 4).

    `overlap` counts points that are near a surface or in free space. Without a known viewpoint
    there are no violations.
    """
    max_distance = tolerance(source, target)
    directions = ((source, target, T_target_source), (target, source, se3.inverse(T_target_source)))
    statistics = [_one_direction(a, b, T, max_distance) for a, b, T in directions]
    near_fraction, on_surface, violation, squares, surfaces, near_surfaces = np.mean(
        statistics, axis=0
    )
    return CloudAgreement(
        overlap=float(near_fraction + violation),
        support=float(on_surface),
        violation=float(violation),
        clash=0.0,
        rms_m=float(np.sqrt(squares / on_surface)) if on_surface else np.inf,
        points=sum(len(view.compared[0]) for view in (source, target)),
        score=float(on_surface - VIOLATION_WEIGHT * min(violation, MAX_VIOLATION)),
        surfaces=float(surfaces),
        near_surfaces=float(near_surfaces),
    )


def both_supports(
    source: CloudMap, target: CloudMap, T_target_source: Float64
) -> tuple[float, float]:
    """Return the fractions of the source and of the target on the other's surfaces at a pose."""
    limit = tolerance(source, target)
    return (
        _one_direction(source, target, T_target_source, limit)[1],
        _one_direction(target, source, se3.inverse(T_target_source), limit)[1],
    )


def _one_direction(
    view: CloudMap, other: CloudMap, T: Float64, max_distance: float
) -> tuple[float, ...]:
    """Return fractions near a surface, on one, in free space; mean square distance, m^2; surfaces.

    See `CloudAgreement` for the last two, which coincide and which are near.
    """
    points, normals = view.compared
    if not len(points):
        return (0.0,) * 6
    points, normals = se3.transform(T, points), normals @ T[:3, :3].T
    is_near, distance, same_normal = _surface_at(
        other, points, normals, max(view.size, other.size), signed=are_oriented(view, other)
    )
    on_surface = is_near & same_normal & (distance < max_distance)
    violation = _in_free_space(view, other, T, max_distance)
    return (
        float(np.mean(is_near)),
        float(np.mean(on_surface)),
        violation,
        float((distance[on_surface] ** 2).sum() / len(distance)),
        float(view.surface_share[on_surface].sum()),
        float(view.surface_share[is_near].sum()),
    )


def _in_free_space(view: CloudMap, other: CloudMap, T: Float64, max_distance: float) -> float:
    """Return the fraction of the clear points in the other view's free space."""
    if other.sphere is None or not len(view.tested):
        return 0.0
    points = se3.transform(T, view.tested)
    ranges = np.linalg.norm(points - other.sphere.origin, axis=1)
    points = points[other.sphere.distance_in_front(points) > max_distance + _IN_FRONT * ranges]
    is_near, distance, _ = _surface_at(other, points, None, max(view.size, other.size))
    return float(np.count_nonzero(~(is_near & (distance < max_distance))) / len(view.tested))


def _surface_at(
    view: CloudMap,
    points: Float64,
    normals: Float64 | None,
    resolution: float,
    *,
    signed: bool = False,
) -> tuple[Bool, Float64, Bool]:
    """Return whether points (n, 3) are near a surface, and their distance (n,) from its plane.

    The third result is whether their normals (n, 3), if given, agree with those of the surface, if
    `signed` also on the side that is seen.
    """
    nearest, _ = view.tree.nearest(points, _MAX_DISTANCE * resolution)
    is_near = nearest >= 0
    surface_normals = view.normals[np.maximum(nearest, 0)]
    surface_points = view.view.points[np.maximum(nearest, 0)].astype(np.float64)
    distance = np.abs(((points - surface_points) * surface_normals).sum(1))
    if normals is None:
        return is_near, distance, is_near
    cosine = (normals * surface_normals).sum(1)
    return is_near, distance, (cosine if signed else np.abs(cosine)) > _MIN_NORMAL_COSINE
