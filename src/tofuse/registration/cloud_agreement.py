"""Agreement of two clouds at a pose: coincident surfaces and free-space violations.

As `agreement`, for views without a camera. The distance tolerance follows from the roughness of
the surfaces at the resolution of the comparison. Free space is known only for views with a known
viewpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.arrays import Bool, Float64
from tofuse.geometry import se3
from tofuse.kernels.kdtree import KdTree
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.registration.agreement import Agreement
from tofuse.registration.shape import Shape, shape_at, tree_of
from tofuse.registration.viewpoint import RangeSphere, Viewpoint, viewpoint_of

# Points of each plane fit.
NEIGHBOURS = 12
# Maximum numbers of points of each view that are compared, and tested for free-space violations.
_COMPARED, _CONTRADICTING = 2500, 5000
# Cosine of the incidence angle below which a surface is at grazing incidence.
_GRAZED = 0.25
# Surfaces coincide within this many standard deviations of their points, plus a fraction of the
# resolution for the error of plane fits at curved surfaces.
_SIGMAS, _BENT = 3.0, 0.25
# Maximum distance of corresponding points, in resolutions.
_NEAR = 2.0
# Cosine of the largest angle between normals of surfaces that support each other.
_ALIKE = 0.75
# A point is in free space if it lies in front of the surface by more than this fraction of the
# range plus the tolerance.
_IN_FRONT = 0.02
# Weight of a point in free space relative to a supporting one: at a wrong pose most points lie on
# some surface, as walls are similar, but at the right pose hardly any lies in free space.
_VIOLATION_WEIGHT = 20.0


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
    clear
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
    clear: Float64
    viewpoint: Viewpoint | None
    sphere: RangeSphere | None

    @classmethod
    def of(cls, view: CloudFrame, size: float, whole: Frame) -> CloudMap:
        """Prepare a view that was averaged from the `whole` one."""
        shape = shape_at(view, np.arange(len(view)), NEIGHBOURS)
        rough = shape.roughness[np.isfinite(shape.roughness)]
        sigma = float(np.median(rough)) * size if len(rough) else size
        viewpoint = viewpoint_of(whole)
        sphere = None if viewpoint is None else RangeSphere.of(whole, viewpoint)
        clear = np.zeros((0, 3)) if viewpoint is None else _clear(view, shape, viewpoint.origin)
        return cls(view, shape.normals, sigma, size, clear, viewpoint, sphere)

    @property
    def tree(self) -> KdTree:
        """kd-tree over the averaged points."""
        return tree_of(self.view)

    @cached_property
    def compared(self) -> tuple[Float64, Float64]:
        """Evenly chosen points (n, 3) on surfaces, and their normals (n, 3)."""
        known = np.flatnonzero(np.isfinite(self.normals).all(1))
        known = known[:: max(1, -(-len(known) // _COMPARED))]
        return self.view.points[known].astype(np.float64), self.normals[known]


def _clear(view: CloudFrame, shape: Shape, viewpoint: Float64) -> Float64:
    """Return points (m, 3) on surfaces, except at edges and grazing incidence."""
    points = view.points.astype(np.float64)
    rays = points - viewpoint
    facing = np.abs((shape.normals * rays).sum(1)) > _GRAZED * np.linalg.norm(rays, axis=1)
    chosen = np.flatnonzero(facing & ~shape.boundary)  # a nan faces nothing
    return points[chosen[:: max(1, -(-len(chosen) // _CONTRADICTING))]]


def tolerance(source: CloudMap, target: CloudMap) -> float:
    """Return the distance in m within which surfaces of two views coincide."""
    noise = float(np.hypot(source.sigma, target.sigma))
    return _SIGMAS * noise + _BENT * max(source.size, target.size)


def cloud_agreement(source: CloudMap, target: CloudMap, T_target_source: Float64) -> Agreement:
    """Return the agreement of both views at a pose (4, 4).

    `overlap` counts points that are near a surface or in free space. Without a known viewpoint
    there are no violations.
    """
    within = tolerance(source, target)
    ways = ((source, target, T_target_source), (target, source, se3.inverse(T_target_source)))
    found = [_one_way(seen, by, T, within) for seen, by, T in ways]
    near, on_surface, free, squares = np.mean(found, axis=0)
    return Agreement(
        overlap=float(near + free),
        support=float(on_surface),
        violation=float(free),
        clash=0.0,
        rms_m=float(np.sqrt(squares / on_surface)) if on_surface else np.inf,
        points=sum(len(view.compared[0]) for view in (source, target)),
        score=float(on_surface - _VIOLATION_WEIGHT * free),
    )


def _one_way(
    seen: CloudMap, by: CloudMap, T: Float64, within: float
) -> tuple[float, float, float, float]:
    """Return fractions near a surface, on one, in free space; and mean square distance, m^2."""
    points, normals = seen.compared
    if not len(points):
        return 0.0, 0.0, 0.0, 0.0
    points, normals = se3.transform(T, points), normals @ T[:3, :3].T
    near, off, alike = _surface_at(by, points, normals, max(seen.size, by.size))
    on = near & alike & (off < within)
    free = _in_free_space(seen, by, T, within)
    return float(np.mean(near)), float(np.mean(on)), free, float((off[on] ** 2).sum() / len(off))


def _in_free_space(seen: CloudMap, by: CloudMap, T: Float64, within: float) -> float:
    """Return the fraction of the clear points in the other view's free space."""
    if by.sphere is None or not len(seen.clear):
        return 0.0
    points = se3.transform(T, seen.clear)
    ranges = np.linalg.norm(points - by.sphere.origin, axis=1)
    points = points[by.sphere.before(points) > within + _IN_FRONT * ranges]
    close, gap, _ = _surface_at(by, points, None, max(seen.size, by.size))
    return float(np.count_nonzero(~(close & (gap < within))) / len(seen.clear))


def _surface_at(
    view: CloudMap, points: Float64, normals: Float64 | None, size: float
) -> tuple[Bool, Float64, Bool]:
    """Return whether points (n, 3) are near a surface, and their distance (n,) from its plane.

    The third result is whether their normals (n, 3), if given, agree with those of the surface.
    """
    nearest, _ = view.tree.nearest(points, _NEAR * size)
    near = nearest >= 0
    other = view.normals[np.maximum(nearest, 0)]
    surface = view.view.points[np.maximum(nearest, 0)].astype(np.float64)
    off = np.abs(((points - surface) * other).sum(1))
    alike = near if normals is None else np.abs((normals * other).sum(1)) > _ALIKE
    return near, off, alike
