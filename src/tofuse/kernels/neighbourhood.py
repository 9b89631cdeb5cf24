"""What a pixel's neighbours say about it: kernels of the spatial filters, by rows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.jit import kernel


@kernel
def window_median(
    z: NDArray[np.float32], half: int, start: int, stop: int, out: NDArray[np.float32]
) -> None:
    """Write the median of the positive values around each pixel of some rows; 0 without any.

    Parameters
    ----------
    z
        (H, W) values; those not above 0 don't count.
    half
        The window reaches so many pixels to each side, less at the border.
    start, stop
        Rows of `out` (H, W) to write.
    """
    height, width = z.shape
    values = np.empty((2 * half + 1) ** 2, np.float32)
    for i in range(start, stop):
        for j in range(width):
            n = 0
            for v in range(max(0, i - half), min(height, i + half + 1)):
                for u in range(max(0, j - half), min(width, j + half + 1)):
                    value = z[v, u]
                    if value > 0:
                        # Insertion keeps the few values sorted as they come.
                        k = n
                        while k > 0 and values[k - 1] > value:
                            values[k] = values[k - 1]
                            k -= 1
                        values[k] = value
                        n += 1
            if n == 0:
                out[i, j] = 0
            elif n % 2 == 1:
                out[i, j] = values[n // 2]
            else:
                out[i, j] = np.float32(0.5) * (values[n // 2 - 1] + values[n // 2])


@kernel
def largest_angle(
    points: NDArray[np.float32],
    valid: NDArray[np.bool_],
    start: int,
    stop: int,
    out: NDArray[np.float32],
) -> None:
    """Write the largest angle, over the 8 neighbours, between camera and neighbour at each point.

    Parameters
    ----------
    points
        (H, W, 3), the camera at the origin.
    valid
        (H, W).
    start, stop
        Rows of `out` (H, W) to write: radians, 0 where the point or all neighbours are invalid.
    """
    height, width = valid.shape
    for i in range(start, stop):
        for j in range(width):
            out[i, j] = 0
            if not valid[i, j]:
                continue
            x, y, z = (
                np.float64(points[i, j, 0]),
                np.float64(points[i, j, 1]),
                np.float64(points[i, j, 2]),
            )
            # The smallest cosine, squared with its sign: one root for all neighbours.
            least = 2.0
            square = x * x + y * y + z * z
            for v in range(max(0, i - 1), min(height, i + 2)):
                for u in range(max(0, j - 1), min(width, j + 2)):
                    if (v == i and u == j) or not valid[v, u]:
                        continue
                    dx = np.float64(points[v, u, 0]) - x
                    dy = np.float64(points[v, u, 1]) - y
                    dz = np.float64(points[v, u, 2]) - z
                    away2 = dx * dx + dy * dy + dz * dz
                    if away2 == 0:
                        continue
                    toward = -(x * dx + y * dy + z * dz)
                    least = min(least, toward * abs(toward) / (away2 * square))
            if least <= 1.0 + 1e-9:
                least = min(max(least, -1.0), 1.0)
                out[i, j] = math.acos(math.copysign(math.sqrt(abs(least)), least))
