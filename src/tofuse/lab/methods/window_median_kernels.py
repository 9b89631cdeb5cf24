"""The median filter, by rows."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32
from tofuse.engine.compute import kernel


@kernel
def window_median(z: Float32, half: int, start: int, stop: int, out: Float32) -> None:
    """Write the median of the positive values in the window around each pixel; 0 without any.

    Parameters
    ----------
    z
        (H, W) values; 0 is invalid.
    half
        Half width of the window in pixels; it is clipped at the border.
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
                        # Insertion sort.
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
