"""Local geometry of the target's surface: neighbours and curvature."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.geometry import KdTree, tangents
from tofuse.engine.icp import interfaces, surface_shape

# A quadric through a point has five parameters; the point itself is its first neighbour.
_MIN_NEIGHBOURS = 6
# Smallest eigenvalue of the mean equations of a quadric that is determined.
_MIN_EIGENVALUE = 1e-9


@dataclass(frozen=True, eq=False)
class PrincipalCurvatures:
    """Principal curvatures at n points.

    Attributes
    ----------
    curvature
        (n, 2) 1/m, positive where the surface bends towards its normal; 0 where unknown.
    directions
        (n, 2, 3) principal directions, unit tangents.
    """

    curvature: Float64
    directions: Float64


class Neighbourhood:
    """The points of a target, with a tree and the local surface shape."""

    def __init__(self, points: interfaces.Points) -> None:
        self._points, self._normals, self._count = points.points, points.normals, points.neighbours

    @cached_property
    def tree(self) -> KdTree:
        """Tree of the valid points."""
        return KdTree(self._points)

    @cached_property
    def neighbours(self) -> Int64:
        """(n, k) nearest neighbours of each point, itself first."""
        return self.tree.neighbours(self._points, min(self._count, len(self._points)))[0]

    @cached_property
    def tangents(self) -> Float64:
        """(n, 2, 3) two unit tangents per normal; NaN where there is no normal."""
        return tangents(self._normals)

    @cached_property
    def principal_curvatures(self) -> PrincipalCurvatures:
        """Of the quadric ``w = a u^2 / 2 + b u v + c v^2 / 2 + d u + e v`` fitted at each point."""
        n = len(self._points)
        offsets = self._points[self.neighbours] - self._points[:, None]
        A, w, scale = _quadric(offsets, self._normals, self.tangents)
        valid = np.isfinite(A).all((1, 2)) & (self.neighbours.shape[1] >= _MIN_NEIGHBOURS)
        x = np.zeros((n, 5))
        x[valid] = np.einsum("nij,nj->ni", np.linalg.pinv(A[valid], rcond=1e-6), w[valid])
        a, b, c, d, e = x.T
        # Shape operator of the graph of w at the point: I^-1 II, made symmetric by I^-1/2.
        first = np.stack([1 + d * d, d * e, d * e, 1 + e * e], 1).reshape(n, 2, 2)
        values, vectors = np.linalg.eigh(first)
        root = np.einsum("nij,nj,nkj->nik", vectors, 1 / np.sqrt(values), vectors)
        second = (
            np.stack([a, b, b, c], 1).reshape(n, 2, 2) / np.sqrt(1 + d * d + e * e)[:, None, None]
        )
        curvature, axes = np.linalg.eigh(root @ second @ root)
        tangents = np.nan_to_num(self.tangents)
        return PrincipalCurvatures(
            curvature / scale[:, None], np.einsum("nij,nik->njk", axes, tangents)
        )

    @cached_property
    def fans(self) -> Int64:
        """(n, k) neighbours of each point, ordered by angle about its normal."""
        neighbours = self.neighbours[:, 1:]
        offsets = self._points[neighbours] - self._points[:, None]
        u, v = np.moveaxis(np.einsum("nki,nti->nkt", offsets, np.nan_to_num(self.tangents)), 2, 0)
        order = np.argsort(np.arctan2(v, u), axis=1, kind="stable")
        return np.take_along_axis(neighbours, order, axis=1)


_cache: WeakKeyDictionary[interfaces.Points, Neighbourhood] = WeakKeyDictionary()


def neighbourhood(points: interfaces.Points) -> Neighbourhood:
    """Return the local geometry of a target, cached for each set of points."""
    if points not in _cache:
        _cache[points] = Neighbourhood(points)
    return _cache[points]


_mean_curvatures: WeakKeyDictionary[interfaces.Points, Float64] = WeakKeyDictionary()


def mean_curvature(points: interfaces.Points) -> Float64:
    """Return the (n,) mean curvature in 1/m, cached for each set of points.

    It is positive where the surface bulges towards the sensor, and NaN where undetermined.
    """
    if points not in _mean_curvatures:
        _mean_curvatures[points] = _fitted_mean_curvature(points)
    return _mean_curvatures[points]


def _fitted_mean_curvature(points: interfaces.Points) -> Float64:
    view, count = points.view, min(points.neighbours, len(points.view))
    index, _ = surface_shape.tree_of(view).neighbours(points.points, count)
    near, normals = view.points.astype(np.float64)[index], points.shape.normals
    A, w, scale = _quadric(near - near.mean(1, keepdims=True), normals, tangents(normals))
    A = np.concatenate([A, np.ones_like(w)[..., None]], 2)
    At = np.swapaxes(A, 1, 2)
    M, g = At @ A, At @ w[..., None]
    valid: Bool = np.asarray(np.isfinite(M).all((1, 2)))
    valid[valid] = np.linalg.eigvalsh(M[valid])[:, 0] > _MIN_EIGENVALUE * count
    x = np.full((len(M), 6), np.nan)
    x[valid] = np.linalg.solve(M[valid], g[valid])[..., 0]
    a, b, c, d, e, _ = x.T
    bend = (1 + e * e) * a - 2 * d * e * b + (1 + d * d) * c
    return np.asarray(-bend / (2 * scale * (1 + d * d + e * e) ** 1.5), np.float64)


def _quadric(
    offsets: Float64, normals: Float64, tangents: Float64
) -> tuple[Float64, Float64, Float64]:
    """Equations ``A x = w`` of quadrics ``w = a u^2 / 2 + b u v + c v^2 / 2 + d u + e v``.

    Returns A (n, k, 5) and w (n, k) for k points each, in units of their rms distance (n,).
    """
    u, v = np.moveaxis(np.einsum("nki,nti->nkt", offsets, tangents), 2, 0)
    w = np.einsum("nki,ni->nk", offsets, normals)
    scale = np.sqrt((u * u + v * v).mean(1)) + 1e-300
    u, v, w = u / scale[:, None], v / scale[:, None], w / scale[:, None]
    return np.stack([u * u / 2, u * v, v * v / 2, u, v], axis=2), w, scale


def with_normals(
    matches: interfaces.Matches, alignment: interfaces.Alignment
) -> interfaces.Matches:
    """Return the matches used by `surface_pairs`: those with a normal and nonzero weight."""
    valid = np.isfinite(alignment.target.normals[matches.target]).all(1)
    return matches.keep(valid & (matches.weights() > 0))
