"""Nearest neighbours among 3D points by a balanced kd-tree (Friedman, Bentley, Finkel 1977).

The tree is implicit: node j of level l holds the points ``order[n*j >> l : n*(j+1) >> l]``, its
children are nodes 2j and 2j+1 of the next level, and leaves are the nodes of the last level. Each
inner node is split at the median of its longest side.

Results are exactly those of an exhaustive search in double precision, with ties going to the lowest
index: the lower bound of a box is summed in the same order as a distance, so rounding can never put
it above the distance of a point inside.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from tofuse.arrays import Float64, Int64
from tofuse.errors import InputError
from tofuse.kernels.jit import kernel
from tofuse.kernels.threads import run_chunks

LEAF_SIZE = 10
# With fewer queries a second thread costs more than it gains.
_MIN_PARALLEL = 4000


@kernel
def kdtree_build(points: Float64, depth: int) -> tuple[Int64, Float64, Int64, Float64]:
    """Arrange (n, 3) finite points in a tree of 2**depth leaves, none of them empty.

    Returns ``(order, sorted_points, axes, splits)``: the permutation (n,), ``points[order]``, and
    axis and coordinate of the split of each of the 2**depth - 1 inner nodes. Points on the left of
    a split are <= it, points on the right are >= it.
    """
    n = len(points)
    inner = (1 << depth) - 1
    order = np.arange(n)
    axes = np.zeros(inner, np.int64)
    splits = np.zeros(inner)
    for level in range(depth):
        for j in range(1 << level):
            start = n * j >> level
            stop = n * (j + 1) >> level
            middle = n * (2 * j + 1) >> (level + 1)
            axis = 0
            longest = -1.0
            for a in range(3):
                low = points[order[start], a]
                high = low
                for i in range(start + 1, stop):
                    x = points[order[i], a]
                    if x < low:
                        low = x
                    elif x > high:
                        high = x
                if high - low > longest:
                    longest = high - low
                    axis = a
            # Hoare's selection algorithm: move the median to `middle`, nothing larger before it.
            left = start
            right = stop - 1
            while left < right:
                a0 = points[order[left], axis]
                a1 = points[order[(left + right) >> 1], axis]
                a2 = points[order[right], axis]
                pivot = max(min(a0, a1), min(max(a0, a1), a2))
                i = left
                k = right
                while i <= k:
                    while points[order[i], axis] < pivot:
                        i += 1
                    while points[order[k], axis] > pivot:
                        k -= 1
                    if i <= k:
                        order[i], order[k] = order[k], order[i]
                        i += 1
                        k -= 1
                if middle <= k:
                    right = k
                elif middle >= i:
                    left = i
                else:
                    break
            node = (1 << level) - 1 + j
            axes[node] = axis
            splits[node] = points[order[middle], axis]
    return order, points[order], axes, splits


@kernel
def kdtree_nearest(
    order: Int64,
    sorted_points: Float64,
    axes: Int64,
    splits: Float64,
    depth: int,
    queries: Float64,
    max_distance2: float,
    index: Int64,
    distance2: Float64,
) -> None:
    """Find the nearest point of each query (m, 3), within the squared distance `max_distance2`.

    Writes into `index` (m,), -1 where there is none, and `distance2` (m,), infinity there.
    A query that is not finite has no neighbour.
    """
    n = len(sorted_points)
    inner = len(splits)
    stack = np.empty(depth + 1, np.int64)
    offsets = np.empty((depth + 1, 3))
    for q in range(len(queries)):
        x = queries[q, 0]
        y = queries[q, 1]
        z = queries[q, 2]
        best = max_distance2
        found = -1
        stack[0] = 0
        offsets[0, :] = 0.0
        count = 1 if np.isfinite(x + y + z) else 0
        while count > 0:
            count -= 1
            node = stack[count]
            # Distance of the query from the node's box along each axis.
            bx = offsets[count, 0]
            by = offsets[count, 1]
            bz = offsets[count, 2]
            if bx * bx + by * by + bz * bz > best:
                continue
            while node < inner:
                fx = bx
                fy = by
                fz = bz
                axis = axes[node]
                if axis == 0:
                    offset = x - splits[node]
                    fx = offset
                elif axis == 1:
                    offset = y - splits[node]
                    fy = offset
                else:
                    offset = z - splits[node]
                    fz = offset
                near = 2 * node + 1
                far = near + 1
                if offset >= 0:
                    near, far = far, near
                if fx * fx + fy * fy + fz * fz <= best:
                    stack[count] = far
                    offsets[count, 0] = fx
                    offsets[count, 1] = fy
                    offsets[count, 2] = fz
                    count += 1
                node = near
            leaf = node - inner
            for i in range(n * leaf >> depth, n * (leaf + 1) >> depth):
                dx = x - sorted_points[i, 0]
                dy = y - sorted_points[i, 1]
                dz = z - sorted_points[i, 2]
                d = dx * dx + dy * dy + dz * dz
                if d < best or (d == best and (found < 0 or order[i] < found)):
                    best = d
                    found = order[i]
        index[q] = found
        distance2[q] = best if found >= 0 else np.inf


@kernel
def kdtree_neighbours(
    order: Int64,
    sorted_points: Float64,
    axes: Int64,
    splits: Float64,
    depth: int,
    queries: Float64,
    index: Int64,
    distance2: Float64,
) -> None:
    """Find the k nearest points of each query (m, 3), nearest first.

    Writes into `index` (m, k), -1 where there are fewer than k points, and `distance2` (m, k),
    infinity there. A query that is not finite has no neighbours.
    """
    n = len(sorted_points)
    inner = len(splits)
    last = index.shape[1] - 1
    stack = np.empty(depth + 1, np.int64)
    offsets = np.empty((depth + 1, 3))
    for q in range(len(queries)):
        x = queries[q, 0]
        y = queries[q, 1]
        z = queries[q, 2]
        found_index = index[q]
        found_distance2 = distance2[q]
        found_index[:] = -1
        found_distance2[:] = np.inf
        stack[0] = 0
        offsets[0, :] = 0.0
        count = 1 if np.isfinite(x + y + z) else 0
        while count > 0:
            count -= 1
            node = stack[count]
            bx = offsets[count, 0]
            by = offsets[count, 1]
            bz = offsets[count, 2]
            if bx * bx + by * by + bz * bz > found_distance2[last]:
                continue
            while node < inner:
                fx = bx
                fy = by
                fz = bz
                axis = axes[node]
                if axis == 0:
                    offset = x - splits[node]
                    fx = offset
                elif axis == 1:
                    offset = y - splits[node]
                    fy = offset
                else:
                    offset = z - splits[node]
                    fz = offset
                near = 2 * node + 1
                far = near + 1
                if offset >= 0:
                    near, far = far, near
                if fx * fx + fy * fy + fz * fz <= found_distance2[last]:
                    stack[count] = far
                    offsets[count, 0] = fx
                    offsets[count, 1] = fy
                    offsets[count, 2] = fz
                    count += 1
                node = near
            leaf = node - inner
            for i in range(n * leaf >> depth, n * (leaf + 1) >> depth):
                dx = x - sorted_points[i, 0]
                dy = y - sorted_points[i, 1]
                dz = z - sorted_points[i, 2]
                d = dx * dx + dy * dy + dz * dz
                worst = found_index[last]
                if d < found_distance2[last] or (
                    d == found_distance2[last] and (worst < 0 or order[i] < worst)
                ):
                    k = last
                    while k > 0 and (
                        d < found_distance2[k - 1]
                        or (d == found_distance2[k - 1] and order[i] < found_index[k - 1])
                    ):
                        found_distance2[k] = found_distance2[k - 1]
                        found_index[k] = found_index[k - 1]
                        k -= 1
                    found_distance2[k] = d
                    found_index[k] = order[i]


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
        array = checked_points(points, "points")
        if not np.isfinite(array).all():
            raise InputError(
                "are not all finite", where="points", remedy="drop the invalid points first"
            )
        self._size = len(array)
        self._depth = max(0, (max(1, -(-self._size // LEAF_SIZE)) - 1).bit_length())
        self._tree = kdtree_build(array, self._depth)

    def __len__(self) -> int:
        return self._size

    def nearest(self, queries: ArrayLike, max_distance: float = np.inf) -> tuple[Int64, Float64]:
        """Find the nearest point of each query (M, 3), not further away than `max_distance` m.

        Returns index (M,), -1 where there is none, and squared distance (M,) in m^2, infinity
        where there is none. Of equally near points the one with the lowest index is found.
        """
        array = checked_points(queries, "queries")
        index = np.empty(len(array), np.int64)
        distance2 = np.empty(len(array))
        limit2 = max_distance * max_distance if max_distance >= 0 else -1.0

        def work(a: int, b: int) -> None:
            kdtree_nearest(*self._tree, self._depth, array[a:b], limit2, index[a:b], distance2[a:b])

        run_queries(work, len(array))
        return index, distance2

    def neighbours(self, queries: ArrayLike, k: int) -> tuple[Int64, Float64]:
        """Find the `k` nearest points of each query (M, 3), nearest first.

        A query that is itself one of the points finds itself. Returns index (M, k), -1 where
        there are fewer than k points, and squared distance (M, k) in m^2, infinity there. Equally
        near points come in the order of their indices.
        """
        if k < 1:
            raise ValueError("k must be at least 1")
        array = checked_points(queries, "queries")
        index = np.empty((len(array), k), np.int64)
        distance2 = np.empty((len(array), k))

        def work(a: int, b: int) -> None:
            kdtree_neighbours(*self._tree, self._depth, array[a:b], index[a:b], distance2[a:b])

        run_queries(work, len(array))
        return index, distance2


def run_queries(work: Callable[[int, int], None], size: int) -> None:
    """Call `work(start, stop)` for chunks of `size` queries, in parallel if they are many."""
    run_chunks(work, size, chunks=min(16, 2 * size // _MIN_PARALLEL) if size > _MIN_PARALLEL else 1)


def checked_points(points: ArrayLike, name: str) -> Float64:
    """Return points as an (N, 3) array; InputError, which mentions `name`, otherwise."""
    array = np.ascontiguousarray(points, np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"have shape {array.shape}", where=name, remedy="pass an (N, 3) array")
    return array
