"""The neighbourhood angle of each pixel, by rows."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float32
from tofuse.engine.compute import kernel


@kernel
def is_steeper(
    z: Float32, rays: Float32, cosine2: np.float32, start: int, stop: int, out: Bool
) -> None:
    """Write where the angle between the camera and one of 8 neighbours exceeds an obtuse threshold.

    The inner loop has no roots, quotients or branches, so that it is vectorised.

    Parameters
    ----------
    z
        (H, W) z depth in m, 0 where invalid.
    rays
        (H, W, 2) x/z and y/z.
    cosine2
        Squared cosine of the obtuse threshold.
    start, stop
        Rows of `out` (H, W) to write: False where the point or all neighbours are invalid.
    """
    height, width = z.shape
    # Points of these rows and of the adjacent ones. Padding and invalid points are at the origin,
    # which is in front of all other points, so that the angle to it is never obtuse.
    points = np.zeros((3, stop - start + 2, width + 2), np.float32)
    for i in range(max(0, start - 1), min(height, stop + 1)):
        for j in range(width):
            if z[i, j] > 0:
                points[0, i - start + 1, j + 1] = rays[i, j, 0] * z[i, j]
                points[1, i - start + 1, j + 1] = rays[i, j, 1] * z[i, j]
                points[2, i - start + 1, j + 1] = z[i, j]
    threshold = np.empty(width, np.float32)
    steep = np.empty(width, np.bool_)
    for i in range(1, stop - start + 1):
        x, y, depth = points[0, i, 1:-1], points[1, i, 1:-1], points[2, i, 1:-1]
        for j in range(width):
            threshold[j] = cosine2 * (x[j] * x[j] + y[j] * y[j] + depth[j] * depth[j])
            steep[j] = False
        for v in range(i - 1, i + 2):
            for u in range(3):
                if v == i and u == 1:
                    continue
                a = points[0, v, u : u + width]
                b = points[1, v, u : u + width]
                c = points[2, v, u : u + width]
                for j in range(width):
                    dx, dy, dz = a[j] - x[j], b[j] - y[j], c[j] - depth[j]
                    dot = x[j] * dx + y[j] * dy + depth[j] * dz
                    distance2 = dx * dx + dy * dy + dz * dz
                    steep[j] |= (dot > 0) & (dot * dot > threshold[j] * distance2)
        for j in range(width):
            out[start + i - 1, j] = steep[j]
