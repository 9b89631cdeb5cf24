"""Filter by amplitude: remove points with weak or saturated signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.arrays import Bool
from tofuse.bounds import Bounded, Bounds
from tofuse.filters.base import Filter
from tofuse.parts import part
from tofuse.recordings.frames import SATURATED_AMPLITUDE, Frame, RangeFrame


@part("filter", "amplitude")
@dataclass(frozen=True)
class Amplitude(Bounded, Filter):
    """Keep points whose amplitude lies in a window (section 2.8).

    Saturated pixels are always removed. Views without amplitude are unchanged.

    Attributes
    ----------
    minimum
        Lowest amplitude that is kept, in the recording's counts.
    maximum
        Highest amplitude that is kept; None for no limit below saturation.
    """

    minimum: Annotated[float, Bounds(0)] = 0.0
    maximum: Annotated[float | None, Bounds()] = None

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.maximum is not None and not self.maximum > self.minimum:
            raise ValueError(f"maximum must be above {self.minimum:g}, not {self.maximum!r}")

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        amplitude = frame.amplitude_image if isinstance(frame, RangeFrame) else frame.amplitude
        if amplitude is None:
            return np.ones(frame.valid.shape, bool)
        keep = (amplitude >= self.minimum) & (amplitude < SATURATED_AMPLITUDE)
        return keep if self.maximum is None else keep & (amplitude <= self.maximum)
