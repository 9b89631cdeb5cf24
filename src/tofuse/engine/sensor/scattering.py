"""Lens scattering: light that the lens spreads over the image, and the range bias it causes.

Between lens and sensor a fraction of the light is reflected repeatedly, and reaches other pixels: a
bright, near object biases the range of all others towards its own, in a pattern fixed to the image.
A pixel measures, as a phasor (amplitude and phase), its direct light plus a blurred image of all
light, modelled by a sum of Gaussians (Mure-Dubois and Huegli 2007)::

    M = D + sum_i s_i G_i * D

The fractions s_i are observable where an object moves in front of a static background: changes of
the background that correlate with the blurred image of the object are due to scattering.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
import scipy  # loads its parts when they are used

from tofuse.engine.arrays import Bool, Complex128, Float64
from tofuse.engine.bounds import Bounded, Bounds, NotEmpty
from tofuse.engine.errors import InputError
from tofuse.engine.filters import moving_object
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.sensor.base import FrameCorrection
from tofuse.engine.sensor.raw_amplitude import frame_phasor, phasor, tof_image

# Smallest ratio of direct to measured light of a pixel that is corrected.
_MIN_DIRECT = 0.5
# Margin in pixels around moving objects that counts neither as moving nor as static.
_MARGIN = 4
# Fraction of the frames in which a static pixel must show its background.
_MIN_STATIC = 0.9

# Columns of the coarse image on which the blur is computed.
_COLUMNS = 44
# Fixed-point iterations; each is accurate to one more power of the scattered fraction.
_ITERATIONS = 2
# Smallest number of static pixels.
_MIN_PIXELS = 200
# Smallest chi^2 that scattering must explain, as the noise of neighbouring pixels is correlated.
_MIN_CHI2 = 50.0
# Largest plausible total fraction.
_MAX_FRACTION = 0.2


@dataclass(frozen=True)
class Scattering:
    """Scattering model of a lens: a sum of Gaussian blurs.

    Attributes
    ----------
    widths
        Standard deviations of the Gaussians, relative to the image's width.
    fractions
        Fraction of the light in each.
    """

    widths: tuple[float, ...]
    fractions: tuple[float, ...]

    def without_scatter(self, measured: Complex128) -> Complex128:
        """Return the measured phasors (H, W) without scattered light.

        Scattered light varies slowly over the image, so it is computed on a coarse grid.
        """
        step = _coarse_step(measured.shape[1], min(self.widths))
        coarse = _reduce(measured, step)
        direct, scattered = coarse, np.zeros_like(coarse)
        for _ in range(_ITERATIONS):
            scattered = np.zeros_like(coarse)
            for width, fraction in zip(self.widths, self.fractions, strict=True):
                if fraction:
                    scattered += fraction * _blur(direct, width * measured.shape[1] / step)
            direct = coarse - scattered
        return measured - _enlarge(scattered, step, measured.shape)


def blur(phasors: Complex128, width: float) -> Complex128:
    """Blur phasors (H, W) by a Gaussian of `width` times the image's width, padded by zeros.

    Computed on a coarse grid.
    """
    step = _coarse_step(phasors.shape[1], width)
    small = _blur(_reduce(phasors, step), width * phasors.shape[1] / step)
    return _enlarge(small, step, phasors.shape)


def _coarse_step(columns: int, width: float) -> int:
    """Return the block side of the coarse grid in pixels, at least two per standard deviation."""
    return max(1, min(columns // _COLUMNS, int(width * columns / 2)))


def _reduce(phasors: Complex128, step: int) -> Float64:
    """Return block means (h, w, 2): real and imaginary part."""
    rows, columns = phasors.shape
    h, w = -(-rows // step), -(-columns // step)
    padded = np.zeros((h * step, w * step, 2))
    padded[:rows, :columns, 0] = phasors.real
    padded[:rows, :columns, 1] = phasors.imag
    return np.asarray(cv2.resize(padded, (w, h), interpolation=cv2.INTER_AREA), np.float64)


def _blur(small: Float64, sigma: float) -> Float64:
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(3 * sigma)) + 1, sigma)
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.sepFilter2D(small, cv2.CV_64F, kernel, kernel, borderType=border))


def _enlarge(small: Float64, step: int, shape: tuple[int, ...]) -> Complex128:
    size = (small.shape[1] * step, small.shape[0] * step)
    large = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]]
    return np.ascontiguousarray(large).view(np.complex128)[..., 0]


def estimate_fractions(
    phasors: Complex128, source: Bool, static: Bool, widths: tuple[float, ...]
) -> Float64:
    """Estimate the scattered fractions from moving objects in front of a static background.

    The change over time of static pixels is fitted by that of the blurred images of the moving
    pixels (non-negative least squares). A change common to all static pixels, due to exposure or
    temperature, is removed from both.

    Parameters
    ----------
    phasors
        (N, H, W) phasors.
    source, static
        (H, W) masks of moving and of static pixels, over all images.
    widths
        See `Scattering`.

    Returns
    -------
    The fraction of each width; all 0 if scattering is insignificant or not observable.
    """
    zero = np.zeros(len(widths))
    static = static & (phasors != 0).all(0)
    if np.count_nonzero(static) < _MIN_PIXELS or len(phasors) < 3:
        return zero
    observed = phasors[:, static]
    mean = observed.mean(0)

    def relative_change(values: Complex128) -> Float64:
        change = values - values.mean(0)
        common = (change * mean.conj()).sum(1) / (np.abs(mean) ** 2).sum()
        change = change - common[:, None] * mean
        return np.concatenate([change.real.ravel(), change.imag.ravel()])

    moving = np.where(source, phasors, 0)
    images = [np.stack([blur(image, width)[static] for image in moving]) for width in widths]
    A = np.stack([relative_change(image) for image in images], 1)
    b = relative_change(observed)
    # einsum, not a matrix product: BLAS may sum differently with more threads.
    H, g = np.einsum("ni,nj->ij", A, A), np.einsum("ni,n->i", A, b)
    if not np.diag(H).all():
        return zero
    scale = 1 / np.sqrt(np.diag(H))
    # Of a root of H: where a fraction is 0, the others of the normal equations are not the best.
    value, vector = np.linalg.eigh(H * np.outer(scale, scale))
    root = np.sqrt(np.maximum(value, 1e-12 * value[-1]))
    projected = vector.T @ (g * scale)
    fractions = scipy.optimize.nnls(root[:, None] * vector.T, projected / root)[0] * scale
    explained = float(2 * (fractions * g).sum() - fractions @ H @ fractions)
    noise = float(np.einsum("n,n->", b, b)) - explained
    if not explained * len(b) > _MIN_CHI2 * noise or fractions.sum() > _MAX_FRACTION:
        return zero
    return np.asarray(fractions)


@part("correction", "scattering", label="validated")
@dataclass(frozen=True)
class LensScattering(Bounded, FrameCorrection):
    """Compensate lens scattering (Mure-Dubois and Huegli 2007), see above.

    Works on cameras with one modulation frequency that record amplitude. Other views are passed
    through, as are all views if the fractions are neither given nor estimated.

    Attributes
    ----------
    fractions
        Fraction of the light in each Gaussian. None: estimated from the recording, if an object
        moves in front of a static background.
    widths
        Standard deviations of the Gaussians, as fractions of the image's width.
    period_m
        Ambiguity range; None: that of the frame.
    """

    fractions: tuple[float, ...] | None = None
    widths: Annotated[tuple[float, ...], NotEmpty()] = (0.04, 0.1, 0.3)
    period_m: Annotated[float | None, Bounds(0, exclusive=True)] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(width in Bounds(0.005, 2) and width > 0.005 for width in self.widths):
            raise ValueError(f"widths is {self.widths}, not each above 0.005 and at most 2")
        if self.fractions is not None:
            if len(self.fractions) != len(self.widths):
                raise ValueError(
                    f"fractions has {len(self.fractions)} numbers, widths {len(self.widths)}"
                )
            if not all(fraction in Bounds(0, 0.5) for fraction in self.fractions):
                raise ValueError(f"fractions is {self.fractions}, not each 0 to 0.5")

    @property
    def needs_fit(self) -> bool:
        """See `Correction.needs_fit`."""
        return self.fractions is None

    def fit(self, frames: Sequence[Frame]) -> LensScattering:
        """See `Correction.fit`; 0 if nothing moves in front of a static background."""
        fractions = np.zeros(len(self.widths))
        images = [frame for frame in frames if isinstance(frame, RangeFrame)]
        phasors = [x for image in images if (x := frame_phasor(image, self.period_m)) is not None]
        if images and len(phasors) == len(images):
            with suppress(InputError):
                moving, static = _moving_and_static(images)
                fractions = estimate_fractions(np.stack(phasors), moving, static, self.widths)
        return replace(self, fractions=tuple(float(fraction) for fraction in fractions))

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`. Scattered light is removed from the amplitude as well."""
        if not self.fractions or not any(self.fractions) or not isinstance(frame, RangeFrame):
            return frame
        image = tof_image(frame, self.period_m)
        if image is None:
            return frame
        measured = phasor(image)
        direct = Scattering(self.widths, self.fractions).without_scatter(measured)
        valid = (measured != 0) & (np.abs(direct) > _MIN_DIRECT * np.abs(measured))
        ratio = np.where(valid, direct, 1) / np.where(valid, measured, 1)
        r = np.where(valid, frame.radial_range, 1)
        range_ratio = 1 + np.angle(ratio) * (image.period_m / (2 * np.pi)) / r
        valid &= range_ratio > 0
        range_ratio = np.where(valid, range_ratio, 1)
        factor = np.where(valid, np.abs(ratio), 1)
        if frame.amplitude_kind == "range_compensated":
            factor = factor * range_ratio**2
        assert frame.amplitude_image is not None
        return replace(
            frame,
            depth=(frame.depth * range_ratio).astype(np.float32),
            amplitude_image=(frame.amplitude_image * factor).astype(np.float32),
        )


def _moving_and_static(images: Sequence[RangeFrame]) -> tuple[Bool, Bool]:
    """Return masks (H, W) of moving pixels, and of static pixels away from them."""
    segmentation = moving_object(images)
    moving = segmentation.always_occluded | np.any(
        [segmentation.mask(image.z) for image in images], axis=0
    )
    square = np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8)
    around = cv2.dilate(moving.astype(np.uint8), square) > 0
    return moving, ~around & np.isfinite(segmentation.background.z) & (
        segmentation.background.static_fraction > _MIN_STATIC
    )
