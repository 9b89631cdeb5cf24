"""Closest points of a cloud to a pixel."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.compute import kernel


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
