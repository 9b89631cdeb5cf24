"""Searches for corresponding points that look at more than the distance in space."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64, Int64
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
    cost: Float64,
) -> None:
    """Find the point with the least ``|x - q|^2 + weight |f - g|^2`` for each query q (m, 3).

    The first five are the arrays of a `KdTree`; `features` f (n, k), in the order of the points as
    they were given, and `query_features` g (m, k) come ready weighted, in m. Only points closer in
    space than the squared distance `limit`, and with no feature off by more than `tolerance`, are
    looked at. Writes `index` (m,), -1 where there is none, and the squared distance in space
    `cost` (m,), infinity there. NaN features match nothing. Of equal points the one with the
    lowest index is found.
    """
    n = len(arranged)
    inner = len(cuts)
    waiting = np.empty(depth + 1, np.int64)
    bounds = np.empty((depth + 1, 3))
    for q in range(len(queries)):
        best = np.inf
        found = -1
        apart = np.inf
        waiting[0] = 0
        bounds[0, :] = 0.0
        count = 1
        while count > 0:
            count -= 1
            node = waiting[count]
            bx = bounds[count, 0]
            by = bounds[count, 1]
            bz = bounds[count, 2]
            if bx * bx + by * by + bz * bz > min(best, limit):
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
                if fx * fx + fy * fy + fz * fz <= min(best, limit):
                    waiting[count] = far
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
                alike = True
                for a in range(features.shape[1]):
                    gap = query_features[q, a] - features[order[i], a]
                    if not abs(gap) <= tolerance:
                        alike = False
                        break
                    total += weight * gap * gap
                if alike and (total < best or (total == best and order[i] < found)):
                    best = total
                    found = order[i]
                    apart = d
        index[q] = found
        cost[q] = apart


@kernel
def grid_search(
    grid: Int64,
    points: Float64,
    moved: Float64,
    pixels: Float64,
    radius: int,
    index: Int64,
    distance2: Float64,
) -> None:
    """Find the closest point near the pixel on which each of the `moved` points (m, 3) falls.

    `grid` (H, W) holds positions in `points` (n, 3), -1 for none; `pixels` (m, 2) are (u, v), NaN
    behind the camera. The search takes the closest of the pixels within `radius` and goes on from
    there until none is closer. Writes `index` (m,), -1 where there is none, and `distance2` (m,).
    """
    rows, columns = grid.shape
    for k in range(len(moved)):
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
                    other = grid[i, j]
                    if other < 0:
                        continue
                    d = 0.0
                    for a in range(3):
                        d += (moved[k, a] - points[other, a]) ** 2
                    if d < distance2[k]:
                        distance2[k] = d
                        index[k] = other
                        best_u = j
                        best_v = i
            if best_u == u and best_v == v:
                break
            u = best_u
            v = best_v


@kernel
def nearest_rows(rows: Float32, columns: Float32, out: Int64, start: int, stop: int) -> None:
    """Write to `out` (n,) which of the columns (d, m) is nearest to each of the rows (n, d).

    Of the rows `start` to `stop`; of equals the first. The other side is transposed so that the
    inner loop runs over independent sums.
    """
    apart = np.empty(columns.shape[1], np.float32)
    for i in range(start, stop):
        apart[:] = 0
        for k in range(rows.shape[1]):
            value = rows[i, k]
            for j in range(columns.shape[1]):
                gap = value - columns[k, j]
                apart[j] += gap * gap
        nearest = 0
        for j in range(1, columns.shape[1]):
            if apart[j] < apart[nearest]:
                nearest = j
        out[i] = nearest


@kernel
def histograms(
    points: Float64,
    normals: Float64,
    near: Int64,
    squared: Float64,
    reach: float,
    signed: bool,
    out: Float64,
    start: int,
    stop: int,
) -> None:
    """Write the simplified point feature histograms of some points to `out` (n, 3, bins).

    Parameters
    ----------
    points, normals
        (n, 3).
    near, squared
        (n, k) neighbours of each point and their squared distances.
    reach
        Neighbours that are further away don't count, m.
    signed
        See `fpfh`.
    """
    bins = out.shape[2]
    for i in range(start, stop):
        count = 0
        out[i] = 0
        for a in range(near.shape[1]):
            j = near[i, a]
            length = np.sqrt(squared[i, a])
            if j == i or length == 0 or length > reach:
                continue
            dx, dy, dz = (points[j] - points[i]) / length
            ux, uy, uz = normals[i]
            nx, ny, nz = normals[j]
            vx, vy, vz = uy * dz - uz * dy, uz * dx - ux * dz, ux * dy - uy * dx
            size = max(np.sqrt(vx * vx + vy * vy + vz * vz), 1e-12)
            vx, vy, vz = vx / size, vy / size, vz / size
            wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            alpha = vx * nx + vy * ny + vz * nz
            phi = ux * dx + uy * dy + uz * dz
            across = wx * nx + wy * ny + wz * nz
            along = ux * nx + uy * ny + uz * nz
            if signed:
                theta = np.arctan2(across, along) / np.pi
            else:
                alpha, phi = 2 * abs(alpha) - 1, 2 * abs(phi) - 1
                theta = 4 * np.arctan2(abs(across), abs(along)) / np.pi - 1
            count += 1
            for k, angle in enumerate((alpha, phi, theta)):
                place = int((angle + 1) / 2 * bins)
                out[i, k, min(max(place, 0), bins - 1)] += 1
        if count:
            out[i] /= count


@kernel
def weighted_means(
    values: Float64,
    near: Int64,
    squared: Float64,
    reach: float,
    out: Float64,
    start: int,
    stop: int,
) -> None:
    """Write to `out` (n, d) the means of neighbours' values (n, d), by the inverse distance."""
    for i in range(start, stop):
        total = 0.0
        out[i] = 0
        for a in range(near.shape[1]):
            j = near[i, a]
            length = np.sqrt(squared[i, a])
            if j == i or length == 0 or length > reach:
                continue
            total += 1 / length
            out[i] += values[j] / length
        if total > 0:
            out[i] /= total
