"""Sampled pixels of a view as a structure of arrays."""

from __future__ import annotations

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.search.search_kernels import ViewPoints
from tofuse.engine.views import PreparedView, residual_kernels


def sampled_points(view: PreparedView, count: int) -> ViewPoints:
    """Return about `count` pixels that have a plane, evenly over the image."""
    available = view.planar_fraction * view.z.size
    packed = projective.points_of(view, max(1, round(float(np.sqrt(available / count)))))
    points = np.ascontiguousarray(packed[:, residual_kernels.POINT : residual_kernels.POINT + 3])
    return ViewPoints(
        points,
        np.ascontiguousarray(packed[:, residual_kernels.NORMAL : residual_kernels.NORMAL + 3]),
        packed[:, residual_kernels.SIGMA] * points[:, 2],
        packed[:, residual_kernels.POINT_ALBEDO].copy(),
    )


def landing_pixels(view: PreparedView, points: Float64) -> Intp:
    """Return column and row (N, 2) of the pixels that points (N, 3) project to; -1 outside."""
    lookup, (x0, y0, per_x, per_y) = view.projection.lookup, view.projection.frame
    z = np.where(points[:, 2] > 1e-3, points[:, 2], np.nan)
    a, b = (points[:, 0] / z - x0) * per_x, (points[:, 1] / z - y0) * per_y
    rows, columns = lookup.shape[:2]
    inside = (a >= 0) & (b >= 0) & (a < columns - 1) & (b < rows - 1)
    a, b = np.where(inside, a, 0), np.where(inside, b, 0)
    j, i = a.astype(np.intp), b.astype(np.intp)
    f, g = (a - j)[:, None], (b - i)[:, None]
    uv = (
        lookup[i, j] * (1 - f) * (1 - g)
        + lookup[i, j + 1] * f * (1 - g)
        + lookup[i + 1, j] * (1 - f) * g
        + lookup[i + 1, j + 1] * f * g
    )
    return np.where(inside[:, None], np.round(uv), -1).astype(np.intp)
