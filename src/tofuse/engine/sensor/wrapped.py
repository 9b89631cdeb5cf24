"""Removal of wrapped pixels: surfaces beyond the ambiguity range, measured as near ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Bool
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.sensor.raw_amplitude import pixel_pitch, range_and_amplitude
from tofuse.engine.sensor.unwrap import UnwrapOptions, count_periods, white_amplitude

# Number of pixels of a view from which white is estimated, and dark pixels are counted.
_SAMPLED_PIXELS = 10_000
# Minimum fraction of the valid pixels that are darker than any material: single ones are noise.
_MIN_DARK = 0.001
# Information need not propagate across the image, as wrapped pixels are removed and not corrected.
_OPTIONS = UnwrapOptions(iterations=20)


@part("filter", "wrapped")
@dataclass(frozen=True)
class Wrapped(Bounded, Filter):
    """Remove pixels whose phase wrapped, see `tofuse.engine.sensor.unwrap`.

    Wrapped surfaces appear in free space, and consistently in consecutive views, so that they are
    no outliers. They are detected by their amplitude, which is that of a far surface. Views are
    examined only if some pixels are darker than any material would be at the measured range; then
    these are removed, and all pixels that are wrapped according to `count_periods`, with white
    estimated from the view itself.

    Works on cameras with one modulation frequency that record amplitude; other views are unchanged.

    Attributes
    ----------
    min_albedo
        Lowest possible albedo: darker pixels are wrapped. Lower it for very dark materials.
    """

    min_albedo: Annotated[float, Bounds(0, 1)] = 0.02

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        keep = np.ones(frame.valid.shape, bool)
        signal = range_and_amplitude(frame, None)
        if signal is None or not isinstance(frame, RangeFrame):
            return keep
        radial, amplitude, period = signal
        step = max(1, round(np.sqrt(radial.size / _SAMPLED_PIXELS)))
        sampled, sampled_amplitude = radial[::step, ::step], amplitude[::step, ::step]
        white = white_amplitude(sampled_amplitude, sampled, sampled > 0)
        # Amplitude is 0 where it is unknown or saturated.
        valid = (sampled > 0) & (sampled_amplitude > 0)
        dark = valid & (sampled_amplitude * np.square(sampled) < self.min_albedo * white)
        if dark.sum() <= _MIN_DARK * valid.sum():
            return keep
        periods = count_periods(radial, amplitude, period, white, pixel_pitch(frame), _OPTIONS)
        is_dark = (amplitude > 0) & (amplitude * np.square(radial) < self.min_albedo * white)
        return (periods == 0) & ~is_dark
