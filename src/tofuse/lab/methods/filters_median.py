"""Outlier removal by the local median of the depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tofuse.engine.arrays import Bool, Float32
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part


@part("filter", "median")
@dataclass(frozen=True)
class Median(Bounded, Filter):
    """Remove pixels whose z is further than a threshold from the local median (section 2.8).

    Kept depths are not smoothed.

    Attributes
    ----------
    threshold
        Largest distance from the median that is kept, m.
    size
        Width and height of the window in pixels, odd.
    """

    threshold: Annotated[float, Bounds(0, exclusive=True)] = 0.1
    size: Annotated[int, Bounds(3, 31)] = 5

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size % 2 == 0:
            raise ValueError(f"size must be odd, not {self.size}")

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        assert isinstance(frame, RangeFrame)
        return np.abs(frame.z - local_median(frame.z, self.size)) <= self.threshold


def local_median(z: Float32, size: int) -> Float32:
    """Return the median (H, W) of the valid (positive) pixels in the window around each pixel.

    It is 0 without valid pixels. Windows of `size` x `size` are clipped at the border. Of an even
    number of values the two central ones are averaged.
    """
    out = np.zeros_like(z)
    unknown = np.float32(np.inf)
    padded = np.pad(np.where(z > 0, z, unknown), size // 2, constant_values=unknown)
    for row, windows in zip(out, sliding_window_view(padded, (size, size)), strict=True):
        values = np.sort(windows.reshape(len(row), -1), axis=1)
        count = (values < unknown).sum(1)
        middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2], 1)
        low, high = np.take_along_axis(values, middle, 1).T
        row[:] = np.where(count > 0, np.float32(0.5) * (low + high), 0)
    return out
