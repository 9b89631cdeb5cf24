"""The radial distortion of any lens, fitted to the rays of its pixels.

Errors of the focal length and of the principal point move pixels, and the lens maps pixels to rays:
how far a ray moves depends on the slope of the distortion there.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32
from tofuse.engine.cameras import lens_kernels

_COEFFICIENTS = 3
# Approximate number of pixels along each side that the fit uses.
_SAMPLED = 64
# A lens that displaces pixels by a smaller fraction of their distance from the axis has none.
_LEAST = 1e-4


def fitted_lens(rays: Float32) -> Float32:
    """Return the coefficients (3,) of the distortion ``1 + k1 r^2 + k2 r^4 + k3 r^6``.

    By least squares on the positions of the pixels: that of the ray (x, y) is the principal point
    plus focal length times (x, y) times the distortion, where r^2 = x^2 + y^2 (Brown 1966). All are
    0 without distortion, and where the fit is not monotonic in the image.

    Parameters
    ----------
    rays
        (H, W, 2) x/z and y/z of the pixels, NaN where unknown.
    """
    steps = tuple(slice(None, None, max(1, side // _SAMPLED)) for side in rays.shape[:2])
    pixels = np.stack(np.mgrid[: rays.shape[0], : rays.shape[1]][::-1], -1)[steps]
    known = np.isfinite(rays[steps]).all(-1)
    xy, uv = rays[steps][known].astype(np.float64), pixels[known].astype(np.float64)
    r2 = (xy**2).sum(-1)
    powers = np.stack([r2**k for k in range(_COEFFICIENTS + 1)], -1)
    fits = []
    for axis in (0, 1):
        columns = np.concatenate([xy[:, [axis]] * powers, np.ones((len(xy), 1))], 1)
        found = np.linalg.lstsq(columns, uv[:, axis], rcond=None)[0]
        fits.append(found[1:-1] / (found[0] or 1.0))
    terms = powers[:, 1:] * np.mean(fits, axis=0)
    slope = 1 + terms @ (2.0 * np.arange(1, _COEFFICIENTS + 1) + 1)
    is_distorted = np.abs(terms.sum(-1)).max(initial=0.0) > _LEAST
    if not is_distorted or slope.min(initial=1.0) <= lens_kernels.MIN_SLOPE:
        return np.zeros(_COEFFICIENTS, np.float32)
    return np.mean(fits, axis=0).astype(np.float32)


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
    lens_kernels.move_rays(rays, fitted_lens(rays), 1 + focal, np.array(center, float), out)
    return out
