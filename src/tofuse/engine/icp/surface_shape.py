"""Normals and edges of a view's surface, from the neighbours of its points.

They are computed at most once for each view and number of neighbours, over all of its points:
registrations against the same view share them.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.compute import run_chunks
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import KdTree
from tofuse.engine.icp.icp_kernels import local_shapes

NEIGHBOURS = 20
# Twenty random neighbours have an angular gap this wide at one in 300 inner points; at a straight
# edge it is 180 degrees.
_BOUNDARY_GAP = np.deg2rad(135)
# Below this fraction of a view's points only the requested ones are computed.
_MAX_SUBSET = 0.25


@dataclass(frozen=True, eq=False)
class Shape:
    """The surface at n points.

    Attributes
    ----------
    normals
        (n, 3) unit normals of fitted planes, towards the sensor; NaN where points lie on a line.
    boundary
        (n,) True where the surface ends: an empty angle of 135 degrees or more round the point.
    thickness
        (n,) rms distance of the neighbours from the plane, m; NaN where points lie on a line.
    roughness
        (n,) the same relative to their extent along the plane: 0 on a plane, near 1 where the noise
        is as wide as the neighbourhood.
    """

    normals: Float64
    boundary: Bool
    thickness: Float64
    roughness: Float64

    def at(self, index: Int64) -> Shape:
        """Return the shape at a subset of the points."""
        return Shape(
            self.normals[index], self.boundary[index], self.thickness[index], self.roughness[index]
        )


@dataclass(eq=False)
class _CachedView:
    tree: KdTree
    shapes: dict[int, Shape]


_cache: WeakKeyDictionary[Frame, _CachedView] = WeakKeyDictionary()


def tree_of(view: Frame) -> KdTree:
    """Return the kd-tree over all points of a view."""
    return _cached(view).tree


def shape_at(view: Frame, index: Int64, neighbours: int = NEIGHBOURS) -> Shape:
    """Return the shape of the view's surface at the points ``view.points[index]``."""
    cached = _cached(view)
    if neighbours not in cached.shapes:
        if len(index) < _MAX_SUBSET * len(view):
            return _fit(view, cached.tree, index, neighbours)
        cached.shapes[neighbours] = _fit(view, cached.tree, np.arange(len(view)), neighbours)
    return cached.shapes[neighbours].at(index)


def normals_at(view: Frame, index: Int64, neighbours: int = NEIGHBOURS) -> Float64:
    """Return the normals (n, 3) at the points `index`: the view's own if it has any, else fits."""
    normals = view.normals
    return (
        shape_at(view, index, neighbours).normals
        if normals is None
        else normals[index].astype(float)
    )


def _cached(view: Frame) -> _CachedView:
    cached = _cache.get(view)
    if cached is None:
        cached = _cache[view] = _CachedView(KdTree(view.points), {})
    return cached


def _fit(view: Frame, tree: KdTree, index: Int64, neighbours: int) -> Shape:
    points = view.points.astype(np.float64)
    centres = points[index]
    neighbour_index, _ = tree.neighbours(centres, neighbours)
    n = len(index)
    normals = np.empty((n, 3))
    gap, extents = np.empty(n), np.empty((n, 2))
    origin = np.asarray(view.origin, np.float64)

    def work(a: int, b: int) -> None:
        local_shapes(
            points,
            neighbour_index[a:b],
            centres[a:b],
            origin,
            normals[a:b],
            gap[a:b],
            extents[a:b],
        )

    run_chunks(work, n)
    across, along = extents.T
    return Shape(normals, gap >= _BOUNDARY_GAP, across, across / along)
