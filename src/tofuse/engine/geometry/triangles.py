"""Areas of triangles, and the points of them that are closest to others."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64

_MIN_DETERMINANT = 1e-14  # relative: below it a triangle is a line, which its edges cover


def areas(triangles: Float64) -> Float64:
    """Return the areas (M,) of triangles (M, 3, 3), in squares of their unit."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def closest_points(points: Float64, triangles: Float64) -> Float64:
    """Return the points (..., 3) of triangles (..., 3, 3) that are closest to points (..., 3)."""
    a, b, c = np.moveaxis(triangles, -2, 0)
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    wu, wv = (w * u).sum(-1), (w * v).sum(-1)
    determinant = uu * vv - uv * uv
    det = np.maximum(determinant, 1e-300)
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    inside = (s >= 0) & (t >= 0) & (s + t <= 1) & (determinant > _MIN_DETERMINANT * uu * vv)
    best = a + s[..., None] * u + t[..., None] * v
    least = np.where(inside, -1.0, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        along = ((points - start) * edge).sum(-1) / np.maximum((edge * edge).sum(-1), 1e-300)
        foot = start + np.clip(along, 0, 1)[..., None] * edge
        distance = ((points - foot) ** 2).sum(-1)
        nearer = distance < least
        best = np.where(nearer[..., None], foot, best)
        least = np.where(nearer, distance, least)
    return np.asarray(best)
