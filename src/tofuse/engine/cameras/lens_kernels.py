"""The radial distortion of a lens inside kernels, by the coefficients of `lens.fitted_lens`."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.compute import kernel

# Smallest slope of the distortion: beyond its fold rays have no pixel.
MIN_SLOPE = 0.1
_ITERATIONS = 3


@kernel
def distortion(r2: np.float32, lens: Float32) -> np.float32:
    """Return the factor by which the lens moves a ray at the squared distance r2 from the axis.

    Beyond the image it stays as it is there.
    """
    one, s = np.float32(1), min(r2, lens[4])
    return (one + s * (lens[0] + s * (lens[1] + s * (lens[2] + s * lens[3])))) / (one + s)


@kernel
def bend(r2: np.float32, lens: Float32) -> np.float32:
    """Return b: if a ray x (2,) is distorted by the factor f, moving that by d moves x by

    ``(d - b x (x . d)) / f``, the inverse of the slope ``f + f' x x^T`` of the distortion.
    """
    one, two, three, four = np.float32(1), np.float32(2), np.float32(3), np.float32(4)
    above = lens[0] + r2 * (two * lens[1] + r2 * (three * lens[2] + r2 * four * lens[3]))
    factor = distortion(r2, lens)
    slope = two * (above - factor) / (one + r2) if r2 < lens[4] else np.float32(0)
    return slope / max(factor + slope * r2, np.float32(MIN_SLOPE))


@kernel
def undistorted(
    x: np.float32, y: np.float32, near_x: np.float32, near_y: np.float32, lens: Float32
) -> tuple[np.float32, np.float32]:
    """Return the ray of the distorted one (x, y), by Newton's method from a ray near it."""
    for _ in range(_ITERATIONS):
        r2 = near_x * near_x + near_y * near_y
        factor, b = distortion(r2, lens), bend(r2, lens)
        dx, dy = x - near_x * factor, y - near_y * factor
        along = b * (near_x * dx + near_y * dy)
        near_x += (dx - along * near_x) / factor
        near_y += (dy - along * near_y) / factor
    return near_x, near_y


@kernel
def move_rays(rays: Float32, lens: Float32, scale: float, center: Float64, out: Float32) -> None:
    """Write what pixels see whose distorted rays are scaled, and moved by a center (2,).

    `rays` and `out` are (H, W, 2) x/z and y/z, NaN where unknown.
    """
    scale32, x0, y0 = np.float32(scale), np.float32(center[0]), np.float32(center[1])
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            x, y = rays[i, j, 0], rays[i, j, 1]
            factor = scale32 * distortion(x * x + y * y, lens)
            out[i, j] = undistorted(factor * x + x0, factor * y + y0, x, y, lens)
