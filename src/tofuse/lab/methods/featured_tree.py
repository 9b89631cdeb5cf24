"""A kd-tree that also compares features, and computes moments of points in balls."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.geometry import KdTree, checked_points


class FeaturedKdTree(KdTree):
    """A `KdTree` with searches by distance and features."""

    def nearest_featured(
        self,
        queries: ArrayLike,
        features: Float64,
        query_features: Float64,
        tolerance: float = np.inf,
        max_distance: float = np.inf,
        weight: float = 1.0,
    ) -> tuple[Int64, Float64]:
        """Find the point closest in space and features, for each query (M, 3).

        Minimises the squared distance in space plus `weight` times that of the features: `features`
        (N, K) of the points and `query_features` (M, K), already scaled to m. Points beyond
        `max_distance` m in space, or with a feature that differs by more than `tolerance` or is
        NaN, are ignored. Returns index (M,), -1 where there is none, and the squared distance in
        space (M,) in m^2, infinity there.
        """
        array = checked_points(queries, "queries")
        index = np.full(len(array), -1, np.int64)
        distance2 = np.full(len(array), np.inf)
        usable = np.flatnonzero(np.isfinite(features).all(1))
        tree = cKDTree(_joined(self._points[usable], features[usable], weight))
        joined = _joined(array, query_features, weight)
        open_queries = np.flatnonzero(
            (self.nearest(array, max_distance)[0] >= 0) & np.isfinite(joined).all(1)
        )
        k = 0
        while len(open_queries) and k < len(usable):
            # Several times as many candidates for queries without a permitted one.
            k = min(max(4 * k, 4), len(usable))
            candidates = usable[tree.query(joined[open_queries], range(1, k + 1))[1]]
            difference = array[open_queries, None] - self._points[candidates]
            squared = (difference**2).sum(2)
            gap = np.abs(query_features[open_queries, None] - features[candidates])
            permitted = (squared <= max_distance**2) & (gap <= tolerance).all(2)
            first, found = permitted.argmax(1), permitted.any(1)
            rows = np.flatnonzero(found)
            index[open_queries[found]] = candidates[rows, first[rows]]
            distance2[open_queries[found]] = squared[rows, first[rows]]
            open_queries = open_queries[~found]
        return index, distance2

    def moments(self, centres: ArrayLike, radius: float) -> Float64:
        """Eigenvalues (M, 3), ascending, of the second moments in a ball around each centre (M, 3).

        Of ``sum (x - c)(x - c)^T / count`` over the points x within `radius` m of the centre c, in
        m^2; zero where there are none.
        """
        array = checked_points(centres, "centres")
        balls = self._tree.query_ball_point(array, radius, return_sorted=True)
        matrices = np.zeros((len(array), 3, 3))
        for k, members in enumerate(balls):
            if members:
                x = self._points[members] - array[k]
                matrices[k] = x.T @ x / len(members)
        return np.asarray(np.linalg.eigvalsh(matrices), np.float64)


def _joined(points: Float64, features: Float64, weight: float) -> Float64:
    """Coordinates (N, 3 + K) of points and features, whose distance is to be minimised."""
    return np.hstack([points, np.sqrt(weight) * features])
