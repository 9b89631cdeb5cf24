"""Outlier removal by the local median of the depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.arrays import Bool, Float32
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.compute import run_chunks
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.lab.methods.window_median_kernels import window_median


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
    run_chunks(lambda a, b: window_median(z, size // 2, a, b, out), len(z))
    return out
