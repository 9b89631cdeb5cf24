"""The radial distortion of any lens, fitted to the rays of its pixels.

Errors of the focal length and of the principal point move pixels, and the lens maps pixels to rays:
how far a ray moves depends on the slope of the distortion there.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import projection_kernels as kernels

# A lens without distortion.
UNDISTORTED = np.array([1, 0, 0, 0, 0], np.float32)
# Approximate number of pixels along each side that the fit uses.
_SAMPLED = 64
# A lens that displaces pixels by a smaller fraction of their distance from the axis has none.
_LEAST = 1e-4
_CHECKED = 50  # distances at which the distortion is checked


def fitted(rays: Float32) -> Float32:
    """Return the distortion (5,) by the squared distance s from the axis: c1 to c4, and largest s.

    It multiplies the ray by ``(1 + c1 s + c2 s^2 + c3 s^3 + c4 s^4) / (1 + s)``, which is exact for
    three radial coefficients (Brown 1966) and close for wide lenses, whose factor falls like the
    angle over its tangent. By least squares on the positions of the pixels: the principal point
    plus focal length times the distorted ray. `UNDISTORTED` where the factor is 1, and where the
    fit is not monotonic in the image.

    Parameters
    ----------
    rays
        (H, W, 2) x/z and y/z of the pixels, NaN where unknown.
    """
    steps = tuple(slice(None, None, max(1, side // _SAMPLED)) for side in rays.shape[:2])
    height, width = rays.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)[steps]
    known = np.isfinite(rays[steps]).all(-1)
    xy, uv = rays[steps][known].astype(np.float64), pixels[known].astype(np.float64)
    squares = (xy**2).sum(-1)
    powers = _powers(squares)
    # Both coordinates together: their focal lengths differ by the shape of the pixels.
    distorted = (xy * np.array([1.0, _aspect(rays)]))[:, :, None] * powers[:, None]
    ones = np.broadcast_to(np.eye(2), (len(xy), 2, 2))
    columns = np.concatenate([distorted, ones], -1).reshape(2 * len(xy), -1)
    found = np.linalg.lstsq(columns, uv.ravel(), rcond=None)[0]
    largest = squares.max(initial=0.0)
    lens = np.array([*found[1:-2] / (found[0] or 1.0), largest], np.float32)
    s = np.linspace(0, largest, _CHECKED)
    factor = _powers(s) @ [1, *lens[:-1]]
    is_monotonic = (np.diff(factor * np.sqrt(s)) > 0).all()
    return lens if np.abs(factor - 1).max() > _LEAST and is_monotonic else UNDISTORTED


def _powers(s: Float64) -> Float64:
    """Return the terms (N, 5) of the distortion, 1 and those of c1 to c4, at distances s (N,)."""
    return np.asarray(s[:, None] ** np.arange(len(UNDISTORTED)) / (1 + s[:, None]), np.float64)


def _aspect(rays: Float32) -> float:
    """Return the ratio of the vertical to the horizontal focal length, by the middle of the image.

    It is 1 if no neighbouring rays are known there.
    """
    middle = tuple(slice(n // 4, n - n // 4) for n in rays.shape[:2])
    across, down = (np.diff(rays[..., k][middle], axis=1 - k) for k in (0, 1))
    known = [d[np.isfinite(d)] for d in (across, down)]
    if not all(len(d) and np.median(d) for d in known):
        return 1.0
    return float(np.median(known[0]) / np.median(known[1]))


def moved_rays(rays: Float32, focal: float, center: tuple[float, float]) -> Float32:
    """Return the rays (H, W, 2) of a camera with other intrinsics, and the same lens.

    Parameters
    ----------
    rays
        (H, W, 2) x/z and y/z of the pixels, NaN where unknown.
    focal, center
        By what distorted rays are longer, as a fraction, and further right and down.
    """
    out = np.empty(rays.shape, np.float32)
    kernels.move_rays(rays, fitted(rays), 1 + focal, np.array(center, float), out)
    return out
