"""Extension of fitted planes to neighbouring pixels without a fit of their own."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Bool, Float32, Int32
from tofuse.kernels.jit import kernel


@kernel
def extend_planes(
    w: Float32,
    sigma: Float32,
    rays: Float32,
    wanted: Bool,
    planes: Float32,
    variance: Float32,
    steps: Int32,
    growth: Float32,
    sigmas: float,
    jump: float,
    found: Float32,
    varied: Float32,
) -> None:
    """Assign to each `wanted` pixel the plane of the nearest pixel that its depth agrees with.

    Parameters
    ----------
    w, sigma
        (H, W) measured 1/z and its standard deviation, 1/m.
    rays
        (H, W, 2) x/z and y/z.
    planes, variance
        (H, W, 4) of `fit_planes`, 0 where there is none, and (H, W) the variance of 1/z on them.
    steps, growth
        (K, 2) offsets in rows and columns of the candidates, in order of preference, and (K,) the
        factor by which the variance of their planes grows up to the pixel.
    sigmas, jump
        The pixel agrees with a plane if 1/z differs by at most `sigmas` standard deviations, 1/z of
        the plane changes by at most the fraction `jump` between the two pixels, and the pixel's
        sigma is at most twice that of the other one, as a change in noise marks another surface.
    found, varied
        (H, W, 4) and (H, W), written: planes and their variances.
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
            here = w[i, j]
            own = sigma[i, j] * sigma[i, j]
            for k in range(len(steps)):
                p = i + steps[k, 0]
                q = j + steps[k, 1]
                if p < 0 or q < 0 or p >= rows or q >= columns or not planes[p, q, 3] > 0:
                    continue
                value = planes[p, q, 0] * x + planes[p, q, 1] * y + planes[p, q, 2]
                if not abs(value - planes[p, q, 3]) <= tolerance * value:
                    continue
                off = here - value
                grown = growth[k] * variance[p, q]
                quiet = np.float32(4) * sigma[p, q] * sigma[p, q]
                if own > quiet or off * off > limit * (own + grown):
                    continue
                varied[i, j] = grown
                for c in range(3):
                    found[i, j, c] = planes[p, q, c]
                found[i, j, 3] = value
                break
