"""Small images of some frames, taken while a run works, so that nothing is decoded again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32, UInt8
from tofuse.recordings.frames import RangeFrame

MOST, MOST_LOST = 160, 40  # samples of all frames, and of lost ones beside them
WIDTH = 192  # pixels at most

NOTHING, REMOVED, TRACKED, KEPT = range(4)  # what became of a pixel, in `FrameSample.fate`


@dataclass(frozen=True, eq=False)
class FrameSample:
    """Every n-th pixel of a frame, as it was tracked.

    Attributes
    ----------
    index
        Of the frame.
    depth
        (h, w) float16, z in m, before filters; 0 where nothing was measured.
    fate
        (h, w) uint8: `NOTHING` measured, `REMOVED` by a filter, `TRACKED` but not in the model,
        or `KEPT`.
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
        """Thin a corrected frame; `tracked` and `kept` are what filters left of it."""
        step = -(-frame.depth.shape[1] // WIDTH)
        thin = (slice(None, None, step), slice(None, None, step))
        fate = np.where(frame.valid[thin], REMOVED, NOTHING).astype(np.uint8)
        fate[tracked.valid[thin]] = TRACKED
        fate[kept.valid[thin]] = KEPT
        # Averaging would invent depths between an edge and what is behind it.
        depth = np.minimum(frame.z[thin], 6e4).astype(np.float16)
        amplitude, color = frame.amplitude_image, frame.color_image
        return cls(
            frame.index,
            depth,
            fate,
            None if amplitude is None else amplitude[thin].copy(),
            None if color is None else color[thin].copy(),
        )


class FrameSamples:
    """At most `MOST` evenly spaced frames of an endless stream, and some of the lost ones."""

    def __init__(self) -> None:
        self._even: list[FrameSample] = []
        self._lost: list[FrameSample] = []
        self._steps = [1, 1]
        self._counts = [0, 0]

    def take(self, *, lost: bool, make: Callable[[], FrameSample]) -> None:
        """Take the next frame, if its turn has come: only then is its sample made."""
        sample = None
        for k, (items, most) in enumerate(((self._even, MOST), (self._lost, MOST_LOST))):
            if k == 1 and not lost:
                break
            if self._counts[k] % self._steps[k] == 0:
                sample = sample or make()
                items.append(sample)
                if len(items) > most:
                    del items[1::2]
                    self._steps[k] *= 2
            self._counts[k] += 1

    @property
    def all(self) -> tuple[FrameSample, ...]:
        """In the order of their frames."""
        both = {sample.index: sample for sample in (*self._even, *self._lost)}
        return tuple(both[index] for index in sorted(both))
