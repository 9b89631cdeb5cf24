"""Voxel-grid downsampling, for the coarse levels of a registration."""

from __future__ import annotations

import math

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.frames import CloudFrame, Frame

# Maximum number of cubes with a unique index in float64.
_MAX_CELLS = 2.0**52


def extent(points: Float32 | Float64) -> float:
    """Return the diagonal in m of the middle 90 % of points (n, 3) along each axis; 0 of none."""
    if not len(points):
        return 0.0
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(np.linalg.norm(high - low))


def averaged(view: Frame, size: float) -> CloudFrame:
    """Return a cloud with the mean of the points in each cube with edges of `size` m.

    Its points are in the order of the cubes; amplitude and colour are not kept.
    """
    points = view.points.astype(np.float64)
    if len(points) == 0:
        return CloudFrame(view.index, view.timestamp, view.points, origin=view.origin)
    order, starts = _cells(points, size)
    counts = np.diff(np.r_[starts, len(points)])
    means = np.add.reduceat(points[order], starts, axis=0) / counts[:, None]
    return CloudFrame(
        view.index, view.timestamp, means.astype(np.float32), origin=np.asarray(view.origin)
    )


def _cells(points: Float64, size: float) -> tuple[Intp, Intp]:
    """Order of points (n, 3) by cubes, x before y before z, and where each cube starts in it."""
    columns = np.ascontiguousarray(points.T)
    cell = np.floor((columns - columns.min(1)[:, None]) / size)
    count = cell.max(1) + 1
    if count.prod() < _MAX_CELLS:
        # A single key sorts faster than three.
        key = ((cell[0] * count[1] + cell[1]) * count[2] + cell[2]).astype(np.int64)
        order = np.argsort(key, kind="stable")
        key = key[order]
        return order, np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    order = np.lexsort(cell[::-1])
    cell = cell[:, order]
    return order, np.flatnonzero(np.r_[True, (cell[:, 1:] != cell[:, :-1]).any(0)])


def reduced(
    source: Frame, target: Frame, size: float, max_points: int
) -> tuple[float, CloudFrame, CloudFrame]:
    """Return the voxel size in m and both averaged views, with at most `max_points` points each.

    The voxel size is `size` m, or larger if that leaves too many points.
    """
    while True:
        data, model = averaged(source, size), averaged(target, size)
        count = max(len(data), len(model))
        if count <= max_points:
            return size, data, model
        # Points lie on surfaces: their number falls with the square of the edge.
        size *= 1.02 * max(1.05, math.sqrt(count / max_points))
