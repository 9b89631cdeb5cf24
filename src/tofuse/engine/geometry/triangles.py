"""Areas of triangles, random points of them, and those that are closest to others."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64

_MIN_DETERMINANT = 1e-14  # relative: below it a triangle is a line, which its edges cover


def crosses(triangles: Float64) -> Float64:
    """Return normals (M, 3) of triangles (M, 3, 3), with twice their areas as length."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.cross(b - a, c - a)


def areas(triangles: Float64) -> Float64:
    """Return the areas (M,) of triangles (M, 3, 3), in squares of their unit."""
    return np.asarray(0.5 * np.linalg.norm(crosses(triangles), axis=1))


def random_points(triangles: Float64, count: int, rng: np.random.Generator) -> Float64:
    """Return random points (count, 3) of triangles (M, 3, 3), evenly over their area."""
    area = areas(triangles)
    return points_in(triangles[rng.choice(len(triangles), count, p=area / area.sum())], rng)


def points_in(triangles: Float64, rng: np.random.Generator) -> Float64:
    """Return a random point (M, 3) of each of M triangles (M, 3, 3)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    u, v = rng.random((2, len(triangles), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a + u * (b - a) + v * (c - a), np.float64)


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
