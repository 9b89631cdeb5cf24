"""Closest points of a cloud by distance and features, or from a pixel; moments of points in balls.

All but `grid_search` take the arrays of a `KdTree`.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64, Int64
from tofuse.kernels.cloud_shape import symmetric_eigen
from tofuse.kernels.jit import kernel


@kernel
def kdtree_nearest_featured(
    order: Int64,
    arranged: Float64,
    axes: Int64,
    cuts: Float64,
    depth: int,
    features: Float64,
    queries: Float64,
    query_features: Float64,
    tolerance: float,
    weight: float,
    limit: float,
    index: Int64,
    distance2: Float64,
) -> None:
    """Find the point with the least ``|x - q|^2 + weight |f - g|^2`` for each query q (m, 3).

    The first five arguments are the arrays of a `KdTree`. `features` f (n, k), in the original
    order of the points, and `query_features` g (m, k) are already scaled to m. Only points within
    the squared distance `limit` in space, all of whose features differ by at most `tolerance`, are
    considered. Writes `index` (m,), -1 where there is none, and the squared distance in space
    `distance2` (m,), infinity there. NaN features match nothing. Of equally close points the one
    with the lowest index is returned.
    """
    n = len(arranged)
    inner = len(cuts)
    stack = np.empty(depth + 1, np.int64)
    bounds = np.empty((depth + 1, 3))
    for q in range(len(queries)):
        lowest = np.inf
        nearest = -1
        best_distance2 = np.inf
        stack[0] = 0
        bounds[0, :] = 0.0
        count = 1
        while count > 0:
            count -= 1
            node = stack[count]
            bx = bounds[count, 0]
            by = bounds[count, 1]
            bz = bounds[count, 2]
            if bx * bx + by * by + bz * bz > min(lowest, limit):
                continue
            while node < inner:
                axis = axes[node]
                gap = queries[q, axis] - cuts[node]
                fx = gap if axis == 0 else bx
                fy = gap if axis == 1 else by
                fz = gap if axis == 2 else bz
                near = 2 * node + 1
                far = near + 1
                if gap >= 0:
                    near, far = far, near
                if fx * fx + fy * fy + fz * fz <= min(lowest, limit):
                    stack[count] = far
                    bounds[count, 0] = fx
                    bounds[count, 1] = fy
                    bounds[count, 2] = fz
                    count += 1
                node = near
            leaf = node - inner
            for i in range(n * leaf >> depth, n * (leaf + 1) >> depth):
                d = 0.0
                for a in range(3):
                    d += (queries[q, a] - arranged[i, a]) ** 2
                if not d <= limit:
                    continue
                total = d
                compatible = True
                for a in range(features.shape[1]):
                    gap = query_features[q, a] - features[order[i], a]
                    if not abs(gap) <= tolerance:
                        compatible = False
                        break
                    total += weight * gap * gap
                if compatible and (total < lowest or (total == lowest and order[i] < nearest)):
                    lowest = total
                    nearest = order[i]
                    best_distance2 = d
        index[q] = nearest
        distance2[q] = best_distance2


@kernel
def grid_search(
    grid: Int64,
    points: Float64,
    transformed: Float64,
    pixels: Float64,
    radius: int,
    index: Int64,
    distance2: Float64,
) -> None:
    """Find the closest point near the pixel to which each `transformed` point (m, 3) projects.

    `grid` (H, W) contains indices into `points` (n, 3), -1 for none; `pixels` (m, 2) are (u, v),
    NaN behind the camera. The search moves to the closest point within `radius` pixels, and
    continues from there until none is closer. Writes `index` (m,), -1 where there is none, and
    `distance2` (m,).
    """
    rows, columns = grid.shape
    for k in range(len(transformed)):
        index[k] = -1
        distance2[k] = np.inf
        if not np.isfinite(pixels[k, 0] + pixels[k, 1]):
            continue
        if not (abs(pixels[k, 0]) < 2.0**31 and abs(pixels[k, 1]) < 2.0**31):
            continue
        v = int(np.floor(pixels[k, 1] + 0.5))
        u = int(np.floor(pixels[k, 0] + 0.5))
        while True:
            best_u = u
            best_v = v
            for i in range(max(0, v - radius), min(rows, v + radius + 1)):
                for j in range(max(0, u - radius), min(columns, u + radius + 1)):
                    candidate = grid[i, j]
                    if candidate < 0:
                        continue
                    d = 0.0
                    for a in range(3):
                        d += (transformed[k, a] - points[candidate, a]) ** 2
                    if d < distance2[k]:
                        distance2[k] = d
                        index[k] = candidate
                        best_u = j
                        best_v = i
            if best_u == u and best_v == v:
                break
            u = best_u
            v = best_v


@kernel
def ball_moments(
    arranged: Float64, axes: Int64, cuts: Float64, depth: int, centres: Float64, radius: float
) -> Float64:
    """Second-order moments of the points within `radius` of each of the `centres` (m, 3).

    Takes the arrays of a `KdTree`. Returns (m, 3): the eigenvalues, ascending, of the moment matrix
    ``sum (x - c)(x - c)^T / count`` about the ball's centre c, in m^2; zero where it is empty.
    """
    n = len(arranged)
    inner = len(cuts)
    out = np.zeros((len(centres), 3))
    stack = np.empty(depth + 1, np.int64)
    M = np.empty((3, 3))
    vectors = np.empty((3, 3))
    for q in range(len(centres)):
        M[:, :] = 0.0
        members = 0
        stack[0] = 0
        count = 1
        while count > 0:
            count -= 1
            node = stack[count]
            while node < inner:
                gap = centres[q, axes[node]] - cuts[node]
                near = 2 * node + 1
                far = near + 1
                if gap >= 0:
                    near, far = far, near
                if abs(gap) <= radius:
                    stack[count] = far
                    count += 1
                node = near
            leaf = node - inner
            for i in range(n * leaf >> depth, n * (leaf + 1) >> depth):
                d = 0.0
                for a in range(3):
                    d += (arranged[i, a] - centres[q, a]) ** 2
                if d <= radius * radius:
                    members += 1
                    for a in range(3):
                        for b in range(3):
                            M[a, b] += (arranged[i, a] - centres[q, a]) * (
                                arranged[i, b] - centres[q, b]
                            )
        if members > 0:
            for a in range(3):
                for b in range(3):
                    M[a, b] /= members
            symmetric_eigen(M, out[q], vectors)
    return out
