"""Filter by amplitude: remove points with weak or saturated signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool
from tofuse.engine.filters import Filter, Interval
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.engine.parts import part


@part("filter", "amplitude")
@dataclass(frozen=True)
class Amplitude(Interval, Filter):
    """Keep points whose amplitude lies in a window (section 2.8).

    Saturated pixels are always removed. Views without amplitude are unchanged.

    Attributes
    ----------
    minimum
        Lowest amplitude that is kept, in the recording's counts.
    maximum
        Highest amplitude that is kept; None for no limit below saturation.
    """

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        amplitude = frame.amplitude_image if isinstance(frame, RangeFrame) else frame.amplitude
        if amplitude is None:
            return np.ones(frame.valid.shape, bool)
        return self.contains(amplitude) & (amplitude < SATURATED_AMPLITUDE)
