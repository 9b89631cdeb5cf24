"""Images that no longer fit as they are, but would if they were not mirrored or rescaled.

A camera hardly does what a changed setting of its driver, or a mistake in an export, does between
two frames: to turn the image over, or to count depths in another unit. If the image fits where the
camera was expected once that is undone, then it is what happened.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.kernels.middle import median
from tofuse.recordings.frames import RangeFrame

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
S = TypeVar("S", bound=np.generic)

_ORDERS = {
    "mirrored left to right": (slice(None), slice(None, None, -1)),
    "mirrored top to bottom": (slice(None, None, -1), slice(None)),
    "turned upside down": (slice(None, None, -1), slice(None, None, -1)),
}
# What a camera that moves changes of the typical depth between two frames, as a factor.
_SAME_SCALE = 1.05
# Every so manieth row and column tells it.
_EVERY = 4
# A glance at a view: so many depths. Logarithms that differ by more are as good as unknown.
_ROWS, _COLUMNS, _FARTHEST = 18, 24, 0.5
# A view looks turned over if that makes it differ by less than this share.
_MUCH_ALIKE = 0.8


@dataclass(frozen=True)
class Mending:
    """What to undo.

    Attributes
    ----------
    words
        What is wrong with the image.
    order
        The order of its rows and columns that puts it right.
    factor
        What puts its depths right.
    """

    words: str
    order: tuple[slice, slice] = (slice(None), slice(None))
    factor: float = 1.0

    def __call__(self, frame: RangeFrame) -> RangeFrame:
        """Return the frame put right."""
        return replace(
            frame,
            depth=frame.depth[self.order] * np.float32(self.factor),
            amplitude_image=self._ordered(frame.amplitude_image),
            color_image=self._ordered(frame.color_image),
            sigma_image=self._ordered(frame.sigma_image),
            confidence_image=None,
            shared_sigma_image=None,
            normal_image=None,
        )

    def _ordered(self, image: NDArray[S] | None) -> NDArray[S] | None:
        return None if image is None else np.ascontiguousarray(image[self.order])


def mendings(
    before: RangeFrame, frame: RangeFrame, T_before_frame: Float64, *, turned: bool = True
) -> Iterator[Mending]:
    """What may be wrong with a frame that does not go on from the one before it.

    `T_before_frame` (4, 4) is where it was expected, `turned` whether it may be turned over.
    """
    for words, order in _ORDERS.items() if turned else ():
        yield Mending(words, order)
    factor = scale_between(before, frame, T_before_frame)
    if max(factor, 1 / factor) > _SAME_SCALE:
        yield Mending(f"in depths that are {1 / factor:.2g} times what they were", factor=factor)


def scale_between(before: RangeFrame, frame: RangeFrame, T_before_frame: Float64) -> float:
    """Factor by which the depths of a frame become those before it; 1 where none are known."""
    some = frame.z[::_EVERY, ::_EVERY]
    rays = frame.camera.rays()[::_EVERY, ::_EVERY][some > 0].astype(np.float64)
    points = np.concatenate([rays, np.ones((len(rays), 1))], 1) * some[some > 0][:, None]
    rows, columns = before.depth.shape
    factor = 1.0
    for motion in (np.eye(4), T_before_frame, T_before_frame, T_before_frame):
        moved = se3.transform(motion, factor * points)
        u, v = np.nan_to_num(np.round(before.camera.project(moved)), nan=-1).T
        seen = (u >= 0) & (v >= 0) & (u < columns) & (v < rows) & (moved[:, 2] > 0)
        z = before.z[v[seen].astype(int), u[seen].astype(int)]
        if not (z > 0).any():
            return 1.0
        factor *= float(np.median(z[z > 0] / moved[seen, 2][z > 0]))
    return factor


def glance(z: Float32) -> Float32:
    """(18, 24) logarithms of some of the depths (H, W), NaN where unknown."""
    rows, columns = z.shape
    i = (np.arange(_ROWS) * 2 + 1) * rows // (2 * _ROWS)
    j = (np.arange(_COLUMNS) * 2 + 1) * columns // (2 * _COLUMNS)
    some = z[i[:, None], j]
    some[some <= 0] = np.nan
    return np.log(some)


def looks_turned_over(before: Float32, now: Float32) -> bool:
    """Whether a view looks more like the one before it if it is mirrored, or turned over."""
    ways = np.stack([now, *(now[order] for order in _ORDERS.values())])
    # An unknown depth is as good as any that is far off.
    straight, *turned = np.fmin(np.abs(before - ways), np.float32(_FARTHEST)).mean((1, 2))
    return bool(min(turned) < _MUCH_ALIKE * straight)


def looks_rescaled(before: Float32, now: Float32) -> bool:
    """Whether a view's depths are not what they were just before, in the median."""
    difference = now - before
    known = difference[np.isfinite(difference)]
    return len(known) > 0 and abs(median(known)) > math.log(_SAME_SCALE)
