"""Compensation of light that the lens scatters over the image."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.bounds import Bounded, Bounds, NotEmpty
from tofuse.engine.errors import InputError
from tofuse.engine.filters import moving_object
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.sensor.base import Correction, Corrector
from tofuse.engine.sensor.raw_amplitude import frame_phasor, phasor, tof_image
from tofuse.engine.sensor.scattering import Scattering, estimate_fractions

# Smallest ratio of direct to measured light of a pixel that is corrected.
_MIN_DIRECT = 0.5
# Margin in pixels around moving objects that counts neither as moving nor as static.
_MARGIN = 4
# Fraction of the frames in which a static pixel must show its background.
_MIN_STATIC = 0.9


@part("correction", "scattering", label="validated")
@dataclass(frozen=True)
class LensScattering(Bounded, Correction):
    """Compensate lens scattering (Mure-Dubois and Huegli 2007), see `tofuse.engine.sensor.scattering`.

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

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

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

    def start(self) -> ScatteringCorrector:
        """See `Correction.start`."""
        return ScatteringCorrector(self)


class ScatteringCorrector(Corrector):
    """Corrects the frames of one recording."""

    def __init__(self, options: LensScattering) -> None:
        self._period_m = options.period_m
        self._model = (
            Scattering(options.widths, options.fractions)
            if options.fractions is not None and any(options.fractions)
            else None
        )

    def is_independent(self, frame: Frame) -> bool:
        """See `Corrector.is_independent`."""
        return True

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`. Scattered light is removed from the amplitude as well."""
        if self._model is None or not isinstance(frame, RangeFrame):
            return frame
        image = tof_image(frame, self._period_m)
        if image is None:
            return frame
        measured = phasor(image)
        direct = self._model.without_scatter(measured)
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
