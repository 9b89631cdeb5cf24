"""Extension of fitted planes to neighbouring pixels without a fit."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Int32
from tofuse.engine.compute import kernel


@kernel
def extend_planes(
    w: Float32,
    sigma: Float32,
    rays: Float32,
    wanted: Bool,
    planes: Float32,
    variance: Float32,
    offsets: Int32,
    variance_growth: Float32,
    sigmas: float,
    jump: float,
    planes_out: Float32,
    variance_out: Float32,
) -> None:
    """Assign to each `wanted` pixel the nearest plane that its depth agrees with.

    Parameters
    ----------
    w, sigma
        (H, W) measured 1/z and its standard deviation, 1/m.
    rays
        (H, W, 2) x/z and y/z.
    planes, variance
        (H, W, 4) of `fit_planes`, 0 where there is none, and (H, W) the variance of their 1/z.
    offsets, variance_growth
        (K, 2) rows and columns of the candidates relative to the pixel, in order of preference, and
        (K,) the factor by which the variance of their planes grows up to the pixel.
    sigmas, jump
        The pixel agrees with a plane if 1/z differs by at most `sigmas` standard deviations, 1/z of
        the plane changes by at most the fraction `jump` between the two pixels, and the pixel's
        sigma is at most twice the other one's, as a change of noise indicates another surface.
    planes_out, variance_out
        (H, W, 4) and (H, W), written: planes, and the variances of their 1/z.
    """
    rows, columns = w.shape
    limit = np.float32(sigmas * sigmas)
    tolerance = np.float32(jump)
    for i in range(rows):
        for j in range(columns):
            if not wanted[i, j]:
                continue
            x = rays[i, j, 0]
            y = rays[i, j, 1]
            measured = w[i, j]
            noise = sigma[i, j] * sigma[i, j]
            for k in range(len(offsets)):
                p = i + offsets[k, 0]
                q = j + offsets[k, 1]
                if p < 0 or q < 0 or p >= rows or q >= columns or not planes[p, q, 3] > 0:
                    continue
                predicted = planes[p, q, 0] * x + planes[p, q, 1] * y + planes[p, q, 2]
                if not abs(predicted - planes[p, q, 3]) <= tolerance * predicted:
                    continue
                difference = measured - predicted
                plane_variance = variance_growth[k] * variance[p, q]
                max_noise = np.float32(4) * sigma[p, q] * sigma[p, q]
                if noise > max_noise or difference * difference > limit * (noise + plane_variance):
                    continue
                variance_out[i, j] = plane_variance
                for c in range(3):
                    planes_out[i, j, c] = planes[p, q, c]
                planes_out[i, j, 3] = predicted
                break
