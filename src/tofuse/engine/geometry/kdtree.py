"""Nearest neighbours among 3D points, by SciPy's kd-tree on our threads."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.compute import run_chunks
from tofuse.engine.errors import InputError

# With fewer queries a second thread costs more than it gains.
_MIN_PARALLEL = 4000


class KdTree:
    """Points (N, 3), in m, arranged so that neighbours are found quickly.

    N may be 0; points may repeat or lie on a line. Searches are exact and give the same answer
    on any number of threads; must not be called from inside a chunk of `run_chunks`.

    Raises
    ------
    InputError
        If the points are not an (N, 3) array of finite numbers.
    """

    def __init__(self, points: ArrayLike) -> None:
        self._points = checked_points(points, "points")
        if not np.isfinite(self._points).all():
            raise InputError(
                "are not all finite", where="points", remedy="drop the invalid points first"
            )
        self._tree = cKDTree(self._points)

    def __len__(self) -> int:
        return len(self._points)

    def nearest(self, queries: ArrayLike, max_distance: float = np.inf) -> tuple[Int64, Float64]:
        """Find the nearest point of each query (M, 3), not further away than `max_distance` m.

        Returns index (M,), -1 where there is none, and squared distance (M,) in m^2, infinity
        where there is none.
        """
        index, distance2 = self._search(queries, 1, max_distance)
        return index[:, 0], distance2[:, 0]

    def neighbours(
        self, queries: ArrayLike, k: int, max_distance: float = np.inf
    ) -> tuple[Int64, Float64]:
        """Find the `k` nearest points of each query (M, 3), nearest first, as far as `nearest`.

        A query that is itself one of the points finds itself, or one at the same place. Returns
        index (M, k), -1 where there are fewer than k points, and squared distance (M, k) in m^2,
        infinity there.
        """
        if k < 1:
            raise ValueError("k must be at least 1")
        return self._search(queries, k, max_distance)

    def within(self, queries: ArrayLike, max_distance: float) -> tuple[Int64, Int64, Float64]:
        """Find all points not further than `max_distance` m from each of M finite queries (M, 3).

        Those of query k, in any order, have the positions first[k] to first[k + 1]. Returns first
        (M + 1,), and the index and the distance in m of all that were found.
        """
        array = checked_points(queries, "queries")
        found = cKDTree(array).sparse_distance_matrix(
            self._tree, max_distance, output_type="ndarray"
        )
        found = found[np.argsort(found["i"], kind="stable")]
        counts = np.bincount(found["i"], minlength=len(array))
        first = np.concatenate([[0], np.cumsum(counts)])
        return first, found["j"].astype(np.int64), found["v"].copy()

    def _search(self, queries: ArrayLike, k: int, max_distance: float) -> tuple[Int64, Float64]:
        """Indices and squared distances (M, k); a query that is not finite has no neighbours."""
        array = checked_points(queries, "queries")
        index = np.full((len(array), k), -1, np.int64)
        distance2 = np.full((len(array), k), np.inf)
        if not len(self):
            return index, distance2
        # SciPy's limit is exclusive: points at the limit are found, and those beyond it dropped.
        bound = max_distance * (1 + 1e-9) + 1e-100
        ranks = range(1, k + 1)

        def work(a: int, b: int) -> None:
            rows = a + np.flatnonzero(np.isfinite(array[a:b]).all(1))
            finite = array[rows]
            _, found = self._tree.query(finite, ranks, distance_upper_bound=bound)
            nearest, squared = np.minimum(found, len(self) - 1), np.zeros(found.shape)
            for points, queries in zip(self._points.T, finite.T, strict=True):
                difference = queries[:, None] - points[nearest]
                squared += difference * difference
            absent = (found == len(self)) | (squared > max_distance * max_distance)
            found[absent], squared[absent] = -1, np.inf
            index[rows], distance2[rows] = found, squared

        size = len(array)
        chunks = min(16, 2 * size // _MIN_PARALLEL) if size > _MIN_PARALLEL else 1
        run_chunks(work, size, chunks)
        return index, distance2


def checked_points(points: ArrayLike, name: str) -> Float64:
    """Return points as an (N, 3) array; InputError, which mentions `name`, otherwise."""
    array = np.ascontiguousarray(points, np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"have shape {array.shape}", where=name, remedy="pass an (N, 3) array")
    return array
