"""Histograms of fast point features, and the nearest of them."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64, Int64
from tofuse.kernels.jit import kernel


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
