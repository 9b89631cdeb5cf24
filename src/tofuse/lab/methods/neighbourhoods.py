"""Local geometry of the target's surface: neighbours and curvature."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from tofuse.arrays import Float64, Int64
from tofuse.kernels.kdtree import KdTree
from tofuse.registration.interfaces import Alignment, Matches, Points

# A quadric through a point has five parameters.
_FEWEST = 6


@dataclass(frozen=True, eq=False)
class Bending:
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

    def __init__(self, points: Points) -> None:
        self._at, self._normals, self._count = points.points, points.normals, points.neighbours

    @cached_property
    def tree(self) -> KdTree:
        """Tree of the valid points."""
        return KdTree(self._at)

    @cached_property
    def near(self) -> Int64:
        """(n, k) nearest neighbours of each point, itself first."""
        return self.tree.neighbours(self._at, min(self._count, len(self._at)))[0]

    @cached_property
    def tangents(self) -> Float64:
        """(n, 2, 3) two unit tangents per normal; NaN where there is no normal."""
        n = self._normals
        axis = np.eye(3)[np.argmin(np.abs(np.nan_to_num(n)), axis=1)]
        first = np.cross(n, axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(n, first)], axis=1)

    @cached_property
    def bending(self) -> Bending:
        """By the quadric ``w = a u^2 / 2 + b u v + c v^2 / 2 + d u + e v`` at each point."""
        n = len(self._at)
        away = self._at[self.near] - self._at[:, None]
        u, v = np.moveaxis(np.einsum("nki,nti->nkt", away, self.tangents), 2, 0)
        w = np.einsum("nki,ni->nk", away, self._normals)
        size = np.sqrt((u * u + v * v).mean(1)) + 1e-300
        u, v, w = u / size[:, None], v / size[:, None], w / size[:, None]
        A = np.stack([u * u / 2, u * v, v * v / 2, u, v], axis=2)
        known = np.isfinite(A).all((1, 2)) & (self.near.shape[1] >= _FEWEST)
        x = np.zeros((n, 5))
        x[known] = np.einsum("nij,nj->ni", np.linalg.pinv(A[known], rcond=1e-6), w[known])
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
        return Bending(curvature / size[:, None], np.einsum("nij,nik->njk", axes, tangents))

    @cached_property
    def fans(self) -> Int64:
        """(n, k) neighbours of each point, ordered by angle about its normal."""
        near = self.near[:, 1:]
        away = self._at[near] - self._at[:, None]
        u, v = np.moveaxis(np.einsum("nki,nti->nkt", away, np.nan_to_num(self.tangents)), 2, 0)
        order = np.argsort(np.arctan2(v, u), axis=1, kind="stable")
        return np.take_along_axis(near, order, axis=1)


_known: WeakKeyDictionary[Points, Neighbourhood] = WeakKeyDictionary()


def neighbourhood(points: Points) -> Neighbourhood:
    """Return the local geometry of a target, cached for each set of points."""
    if points not in _known:
        _known[points] = Neighbourhood(points)
    return _known[points]


def with_normals(matches: Matches, alignment: Alignment) -> Matches:
    """Return the matches used by `surface_pairs`: those with a normal and nonzero weight."""
    known = np.isfinite(alignment.target.normals[matches.target]).all(1)
    return matches.keep(known & (matches.weights() > 0))
