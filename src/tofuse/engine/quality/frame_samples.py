"""Small images of some frames, taken during a run, so that no frame is decoded again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, UInt8
from tofuse.engine.frames import RangeFrame

T = TypeVar("T")

MAX_SAMPLES, MAX_LOST_SAMPLES = 160, 40  # of all frames, and of lost ones in addition
MAX_WIDTH = 192  # pixels

NOTHING, REMOVED, TRACKED, KEPT = range(4)  # use of a pixel, in `FrameSample.fate`


@dataclass(frozen=True, eq=False)
class FrameSample:
    """Every n-th pixel of a frame, as it was tracked.

    Attributes
    ----------
    index
        Frame index.
    depth
        (h, w) float16, z in m, before filtering; 0 where nothing was measured.
    fate
        (h, w) uint8: `NOTHING` measured, `REMOVED` by a filter, `TRACKED` but not in the model,
        or `KEPT` in the model.
    amplitude
        (h, w) float32, or None.
    color
        (h, w, 3) uint8, or None.
    """

    index: int
    depth: NDArray[np.float16]
    fate: UInt8
    amplitude: Float32 | None
    color: UInt8 | None

    @classmethod
    def of(cls, frame: RangeFrame, tracked: RangeFrame, kept: RangeFrame) -> FrameSample:
        """Subsample a corrected frame.

        Parameters
        ----------
        frame
            The frame after corrections, before filters.
        tracked, kept
            The same frame after the filters of tracking, and after those of the model.
        """
        step = -(-frame.depth.shape[1] // MAX_WIDTH)
        subset = (slice(None, None, step), slice(None, None, step))
        fate = np.where(frame.valid[subset], REMOVED, NOTHING).astype(np.uint8)
        fate[tracked.valid[subset]] = TRACKED
        fate[kept.valid[subset]] = KEPT
        # Averaging would create depths between an edge and its background.
        depth = np.minimum(frame.z[subset], 6e4).astype(np.float16)
        amplitude, color = frame.amplitude_image, frame.color_image
        return cls(
            frame.index,
            depth,
            fate,
            None if amplitude is None else amplitude[subset].copy(),
            None if color is None else color[subset].copy(),
        )


class EvenSample(Generic[T]):
    """At most `size` items of a stream of unknown length, evenly spaced."""

    def __init__(self, size: int) -> None:
        self.items: list[T] = []
        self._size, self._step, self._count = size, 1, 0

    def offer(self, make: Callable[[], T]) -> None:
        """Offer the next item; `make` is called only if it is taken."""
        if self._count % self._step == 0:
            self.items.append(make())
            if len(self.items) > self._size:
                del self.items[1::2]
                self._step *= 2
        self._count += 1


class FrameSamples:
    """At most `MAX_SAMPLES` evenly spaced frames of a stream, and `MAX_LOST_SAMPLES` lost ones."""

    def __init__(self) -> None:
        self._even: EvenSample[FrameSample] = EvenSample(MAX_SAMPLES)
        self._lost: EvenSample[FrameSample] = EvenSample(MAX_LOST_SAMPLES)

    def take(self, *, lost: bool, make: Callable[[], FrameSample]) -> None:
        """Offer the next frame; `make` is called only if it is taken."""
        make = cache(make)
        self._even.offer(make)
        if lost:
            self._lost.offer(make)

    @property
    def all(self) -> tuple[FrameSample, ...]:
        """All samples, in the order of their frames."""
        samples = {sample.index: sample for sample in (*self._even.items, *self._lost.items)}
        return tuple(samples[index] for index in sorted(samples))
