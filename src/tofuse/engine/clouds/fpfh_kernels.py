"""Fast point feature histograms."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.compute import kernel


@kernel
def histograms(
    points: Float64,
    normals: Float64,
    first: Int64,
    neighbours: Int64,
    distances: Float64,
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
    first, neighbours, distances
        See `KdTree.within`. Neighbours at the same place are ignored.
    signed
        See `fpfh`.
    """
    bins = out.shape[2]
    for i in range(start, stop):
        count = 0
        out[i] = 0
        for a in range(first[i], first[i + 1]):
            j, length = neighbours[a], distances[a]
            if length == 0:
                continue
            dx = (points[j, 0] - points[i, 0]) / length
            dy = (points[j, 1] - points[i, 1]) / length
            dz = (points[j, 2] - points[i, 2]) / length
            ux, uy, uz = normals[i]
            nx, ny, nz = normals[j]
            vx, vy, vz = uy * dz - uz * dy, uz * dx - ux * dz, ux * dy - uy * dx
            norm = max(np.sqrt(vx * vx + vy * vy + vz * vz), 1e-12)
            vx, vy, vz = vx / norm, vy / norm, vz / norm
            wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            alpha = vx * nx + vy * ny + vz * nz
            phi = ux * dx + uy * dy + uz * dz
            w_dot_n = wx * nx + wy * ny + wz * nz
            u_dot_n = ux * nx + uy * ny + uz * nz
            if signed:
                theta = np.arctan2(w_dot_n, u_dot_n) / np.pi
            else:
                alpha, phi = 2 * abs(alpha) - 1, 2 * abs(phi) - 1
                theta = 4 * np.arctan2(abs(w_dot_n), abs(u_dot_n)) / np.pi - 1
            count += 1
            for k, angle in enumerate((alpha, phi, theta)):
                index = int((angle + 1) / 2 * bins)
                out[i, k, min(max(index, 0), bins - 1)] += 1
        if count:
            out[i] /= count


@kernel
def weighted_means(
    values: Float64,
    first: Int64,
    neighbours: Int64,
    distances: Float64,
    out: Float64,
    start: int,
    stop: int,
) -> None:
    """Write to `out` (n, d) means of the neighbours' values (n, d), weighted by 1 / distance."""
    for i in range(start, stop):
        total = 0.0
        out[i] = 0
        for a in range(first[i], first[i + 1]):
            j, length = neighbours[a], distances[a]
            if length == 0:
                continue
            total += 1 / length
            for k in range(values.shape[1]):
                out[i, k] += values[j, k] / length
        if total > 0:
            out[i] /= total
