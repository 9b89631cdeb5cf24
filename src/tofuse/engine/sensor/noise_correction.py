"""Assign each pixel the standard deviation of its range, by the camera's noise model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from tofuse.engine.arrays import Float64
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.noise import NoiseModel
from tofuse.engine.parts import part
from tofuse.engine.sensor.base import Correction, Corrector


@part("correction", "noise")
@dataclass(frozen=True)
class Noise(Correction, Corrector):
    """Assign the standard deviation of the range to each pixel, for all later weighting.

    Depths are not changed. Frames with a sigma stated by the camera keep it; clouds are passed
    through.

    Attributes
    ----------
    model
        Noise of the camera. None: that of the recording's `noise.json`, else that of the camera's
        family; without either, frames are passed through.
    """

    model: NoiseModel | None = None

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def start(self) -> Noise:
        """See `Correction.start`; there is no state."""
        return self

    def is_independent(self, frame: Frame) -> bool:
        """See `Corrector.is_independent`."""
        return True

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`."""
        if self.model is None or not isinstance(frame, RangeFrame):
            return frame
        if frame.sigma_image is not None:
            return frame
        return replace(frame, sigma_image=self.model.sigma(frame))
