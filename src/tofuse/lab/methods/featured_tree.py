"""A kd-tree that also compares features, and computes moments of points in balls."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.arrays import Float64, Int64
from tofuse.kernels.kdtree import KdTree, checked_points, run_queries
from tofuse.lab.kernels.cloud_search import ball_moments, kdtree_nearest_featured


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
        index = np.empty(len(array), np.int64)
        distance2 = np.empty(len(array))
        limit = max_distance * max_distance if max_distance >= 0 else -1.0
        point_rows, query_rows = (
            np.ascontiguousarray(f, np.float64) for f in (features, query_features)
        )

        def search(a: int, b: int) -> None:
            kdtree_nearest_featured(
                *self._tree,
                self._depth,
                point_rows,
                array[a:b],
                query_rows[a:b],
                tolerance,
                weight,
                limit,
                index[a:b],
                distance2[a:b],
            )

        run_queries(search, len(array))
        return index, distance2

    def moments(self, centres: ArrayLike, radius: float) -> Float64:
        """Eigenvalues (M, 3), ascending, of the second moments in a ball around each centre (M, 3).

        Of ``sum (x - c)(x - c)^T / count`` over the points x within `radius` m of the centre c, in
        m^2; zero where there are none.
        """
        array = checked_points(centres, "centres")
        out = np.empty((len(array), 3))
        _, arranged, axes, cuts = self._tree

        def compute(a: int, b: int) -> None:
            out[a:b] = ball_moments(arranged, axes, cuts, self._depth, array[a:b], radius)

        run_queries(compute, len(array))
        return out
