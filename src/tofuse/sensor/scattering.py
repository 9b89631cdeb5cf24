"""Light that the lens scatters over the image, and the range bias that it makes.

Between lens and sensor a fraction of the light is reflected to and fro, and falls on other pixels:
a bright, near object pulls the range of all others towards its own, in a pattern that is fixed to
the image. What a pixel measures, as a phasor (amplitude and phase), is its own light plus a blur
image of all light (Mure-Dubois and Huegli 2007, who take the blur for a sum of Gaussians, too)::

    M = D + sum_i s_i G_i * D

The fractions s_i can be seen where a thing moves before a background that stands still: whatever of
the background's light follows the blur image of the thing was scattered.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import nnls

from tofuse.arrays import Bool, Complex128, Float64

# The blur is computed on an image of about so many columns.
_COLUMNS = 44
# Fixed-point steps that take the scattered light off: each is right to one more power of its fraction.
_STEPS = 2
# Fewest still pixels to learn from.
_MIN_PIXELS = 200
# Least chi^2 that scattering must explain to be believed: neighbouring pixels fraction some noise.
_MIN_CHI2 = 50.0
# Larger fractions than this in all are another effect.
_MAX_FRACTION = 0.2


@dataclass(frozen=True)
class Scattering:
    """How much light a lens scatters, and how far.

    Attributes
    ----------
    widths
        Standard deviations of the Gaussians, as fractions of the image's width.
    fractions
        Share of the light that goes into each.
    """

    widths: tuple[float, ...]
    fractions: tuple[float, ...]

    def removed(self, measured: Complex128) -> Complex128:
        """Return the measured light (H, W) without what was scattered onto each pixel.

        What is scattered varies slowly over the image, so it is computed on a coarse grid.
        """
        step = _coarse_step(measured.shape[1], min(self.widths))
        coarse = _reduce(measured, step)
        own, scattered = coarse, np.zeros_like(coarse)
        for _ in range(_STEPS):
            scattered = np.zeros_like(coarse)
            for width, fraction in zip(self.widths, self.fractions, strict=True):
                if fraction:
                    scattered += fraction * _blur(own, width * measured.shape[1] / step)
            own = coarse - scattered
        return measured - _enlarge(scattered, step, measured.shape)


def blur(light: Complex128, width: float) -> Complex128:
    """Blur an image (H, W) by a Gaussian of `width` times its width; beyond it there is no light.

    Fine detail is lost in a wide blur, so that it is computed on a coarse grid.
    """
    step = _coarse_step(light.shape[1], width)
    small = _blur(_reduce(light, step), width * light.shape[1] / step)
    return _enlarge(small, step, light.shape)


def _coarse_step(columns: int, width: float) -> int:
    """Side in pixels of the blocks of the coarse grid, at least two to a standard deviation."""
    return max(1, min(columns // _COLUMNS, int(width * columns / 2)))


def _reduce(light: Complex128, step: int) -> Float64:
    """Block means (h, w, 2): real and imaginary part."""
    rows, columns = light.shape
    h, w = -(-rows // step), -(-columns // step)
    padded = np.zeros((h * step, w * step, 2))
    padded[:rows, :columns, 0] = light.real
    padded[:rows, :columns, 1] = light.imag
    size = (w, h)
    return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA), np.float64)


def _blur(small: Float64, sigma: float) -> Float64:
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(3 * sigma)) + 1, sigma)
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.sepFilter2D(small, cv2.CV_64F, kernel, kernel, borderType=border))


def _enlarge(small: Float64, step: int, shape: tuple[int, ...]) -> Complex128:
    size = (small.shape[1] * step, small.shape[0] * step)
    large = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]]
    return np.ascontiguousarray(large).view(np.complex128)[..., 0]


def estimate_fractions(
    light: Complex128, source: Bool, still: Bool, widths: tuple[float, ...]
) -> Float64:
    """Find the fractions of light that a lens scatters from what moves onto what does not.

    Of each still pixel the change over time is compared with that of the blur images of what
    moves (least squares, no fraction below 0). What changes all still pixels alike, the exposure or
    the sensor's temperature, is taken off from both.

    Parameters
    ----------
    light
        (N, H, W) phasors.
    source, still
        (H, W) where things move; where nothing does, in any of the images.
    widths
        See `Scattering`.

    Returns
    -------
    The fraction of each width; all 0 where nothing is scattered, or nothing can be told.
    """
    none = np.zeros(len(widths))
    still = still & (light != 0).all(0)
    if np.count_nonzero(still) < _MIN_PIXELS or len(light) < 3:
        return none
    seen = light[:, still]
    mean = seen.mean(0)

    def own_change(values: Complex128) -> Float64:
        change = values - values.mean(0)
        common = (change * mean.conj()).sum(1) / (np.abs(mean) ** 2).sum()
        change = change - common[:, None] * mean
        return np.concatenate([change.real.ravel(), change.imag.ravel()])

    moving = np.where(source, light, 0)
    images = [np.stack([blur(image, width)[still] for image in moving]) for width in widths]
    A = np.stack([own_change(image) for image in images], 1)
    b = own_change(seen)
    # einsum, not a matrix product: BLAS may sum differently with more threads.
    H, g = np.einsum("ni,nj->ij", A, A), np.einsum("ni,n->i", A, b)
    if not np.diag(H).all():
        return none
    scale = 1 / np.sqrt(np.diag(H))
    fractions = nnls(H * np.outer(scale, scale), g * scale)[0] * scale
    explained = float(2 * (fractions * g).sum() - fractions @ H @ fractions)
    noise = float(np.einsum("n,n->", b, b)) - explained
    if not explained * len(b) > _MIN_CHI2 * noise or fractions.sum() > _MAX_FRACTION:
        return none
    return np.asarray(fractions)
