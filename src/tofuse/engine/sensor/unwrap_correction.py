"""Phase unwrapping of surfaces beyond the ambiguity range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Self

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.sensor.base import Correction, Corrector
from tofuse.engine.sensor.raw_amplitude import pixel_pitch, range_and_amplitude
from tofuse.engine.sensor.unwrap import UnwrapOptions, count_periods, white_amplitude

_ROUNDS = 4


@part("correction", "unwrap", label="validated")
@dataclass(frozen=True)
class Unwrap(Bounded, Correction):
    """Unwrap the phase by amplitude and continuity, see `tofuse.engine.sensor.unwrap`.

    Works on cameras with one modulation frequency that record amplitude; other views are passed
    through.

    Attributes
    ----------
    white
        Raw amplitude of a white wall at 1 m on the optical axis; None: estimated from the
        recording.
    period_m
        Ambiguity range; None: that of the frame.
    options
        Of the unwrapping.
    """

    white: Annotated[float | None, Bounds(0, exclusive=True)] = None
    period_m: Annotated[float | None, Bounds(0, exclusive=True)] = None
    options: UnwrapOptions = field(default_factory=UnwrapOptions)

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    @property
    def needs_fit(self) -> bool:
        """See `Correction.needs_fit`."""
        return self.white is None

    def fit(self, frames: Sequence[Frame]) -> Self:
        """Return the part with the amplitude of white estimated from the brightest frames."""
        white = 0.0
        # Alternate with unwrapping, as most surfaces may be beyond the ambiguity range.
        for _ in range(_ROUNDS):
            estimates = [w for frame in frames if (w := self._white_of(frame, white)) > 0]
            if not estimates:
                return self
            previous, white = white, float(np.quantile(estimates, 0.9))
            if abs(white - previous) < 0.02 * white:
                break
        return replace(self, white=white)

    def start(self) -> UnwrapCorrector:
        """See `Correction.start`."""
        return UnwrapCorrector(self)

    def _white_of(self, frame: Frame, white: float) -> float:
        signal = range_and_amplitude(frame, self.period_m)
        if signal is None:
            return 0.0
        radial, amplitude, period = signal
        pitch = pixel_pitch(frame)
        periods = count_periods(radial, amplitude, period, white, pitch, self.options)
        return white_amplitude(
            amplitude, (radial + periods * period).astype(np.float32), radial > 0
        )


class UnwrapCorrector(Corrector):
    """Adds whole periods to the ranges of each frame."""

    def __init__(self, part: Unwrap) -> None:
        self.part = part

    def is_independent(self, frame: Frame) -> bool:
        """See `Corrector.is_independent`."""
        return True

    def apply(self, frame: Frame, T_world_camera: Float64 | None = None) -> Frame:
        """See `Corrector.apply`. Range-compensated amplitude is scaled to the new range."""
        signal = range_and_amplitude(frame, self.part.period_m)
        if signal is None or not isinstance(frame, RangeFrame):
            return frame
        radial, measured, period = signal
        white, pitch = self.part.white or 0.0, pixel_pitch(frame)
        periods = count_periods(radial, measured, period, white, pitch, self.part.options)
        if not periods.any():
            return frame
        factor = np.where(periods > 0, 1 + periods * period / np.where(radial > 0, radial, 1), 1)
        amplitude = frame.amplitude_image
        if amplitude is not None and frame.amplitude_kind == "range_compensated":
            amplitude = np.where(periods > 0, amplitude * factor**2, amplitude).astype(np.float32)
        return replace(
            frame,
            depth=(frame.depth * factor).astype(np.float32),
            amplitude_image=amplitude,
            ambiguity_m=frame.ambiguity_m,
        )
