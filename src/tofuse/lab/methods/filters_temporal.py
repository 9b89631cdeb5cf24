"""Outlier removal by the variation of depth over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part


@part("filter", "temporal", label="validated")
@dataclass(frozen=True)
class TemporalDeviation(Bounded, Filter):
    """Remove pixels whose z varied too much over the last frames (section 2.8).

    The thesis calls it a "z-variance threshold" and gives a length, 25 mm: here that is the sample
    standard deviation of z at the pixel, over the frames of the window in which it is valid. It
    measures noise while the camera is static; while it moves, slopes and edges vary too. Pixels
    with a single measurement are kept.

    Attributes
    ----------
    threshold
        Highest standard deviation that is kept, m.
    frames
        Length of the window, the current frame included.
    """

    threshold: Annotated[float, Bounds(0, exclusive=True)] = 0.025
    frames: Annotated[int, Bounds(2, 1000)] = 4

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    @property
    def window(self) -> int:
        """See `Filter.window`."""
        return self.frames

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        assert isinstance(frame, RangeFrame)
        past = [
            f.z for f in history if isinstance(f, RangeFrame) and f.depth.shape == frame.depth.shape
        ]
        return ~(z_deviation([*past[-(self.frames - 1) :], frame.z]) > self.threshold)


def z_deviation(z: Sequence[Float32]) -> Float64:
    """Return the sample standard deviation (H, W) in m of z images (H, W), ignoring invalid zeros.

    NaN where fewer than two images have a value.
    """
    stack = np.asarray(z, np.float64)
    valid = stack > 0
    count = valid.sum(0)
    mean = stack.sum(0, where=valid) / np.maximum(count, 1)
    squares = ((stack - mean) ** 2).sum(0, where=valid)
    return np.where(count >= 2, np.sqrt(squares / np.maximum(count - 1, 1)), np.nan)
