"""Tell each pixel's noise by what is known of the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from tofuse.arrays import Float64
from tofuse.corrections.base import Correction, Corrector
from tofuse.parts import part
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.sensor.noise import NoiseModel


@part("correction", "noise")
@dataclass(frozen=True)
class Noise(Correction, Corrector):
    """Give each frame the standard deviation of its range, for all that weighs by it.

    Depth itself is not changed. Frames that bring their camera's own sigma keep it; clouds are
    passed on.

    Attributes
    ----------
    model
        Noise of the camera. None: as the recording's `noise.json` says, else as is known of the
        camera's family; where neither is there, nothing is told.
    """

    model: NoiseModel | None = None

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def start(self) -> Noise:
        """See `Correction.start`. Nothing is learnt from frames."""
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
