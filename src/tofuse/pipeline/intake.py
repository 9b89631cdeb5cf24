"""Checks of frames before they are processed."""

from __future__ import annotations

import numpy as np

from tofuse.errors import InputError
from tofuse.pipeline.config import ViewKind, kind_of
from tofuse.recordings.frames import Frame, RangeFrame


class Intake:
    """Checks the order and the kind of frames, and detects repeated images.

    Attributes
    ----------
    kind
        Kind of the frames so far; None before the first.
    """

    def __init__(self) -> None:
        self.kind: ViewKind | None = None
        self._index: int | None = None
        self._previous: RangeFrame | None = None  # uncorrected

    def check_kind(self, frame: Frame) -> bool:
        """Return whether it is the first frame; InputError for another kind than those before."""
        kind = kind_of(frame)
        if self.kind and kind != self.kind:
            raise InputError(
                f"is a {kind} view among {self.kind} views",
                where=f"frame {frame.index}",
                remedy="pass images only, or clouds only",
            )
        return self.kind is None

    def check_order(self, index: int) -> None:
        """Raise InputError if the index of the next frame is not larger than the last one."""
        if self._index is not None and index <= self._index:
            raise InputError(
                f"comes after frame {self._index}",
                where=f"frame {index}",
                remedy="number the frames in the order in which they are pushed",
            )

    def accept(self, index: int, kind: ViewKind | None = None) -> None:
        """Record a frame that passed all checks; its kind is None if it could not be read."""
        self._index = index
        self.kind = self.kind or kind

    def is_repeated(self, frame: Frame) -> bool:
        """Whether an image equals the previous one: the camera is stuck, as noise never repeats."""
        if not isinstance(frame, RangeFrame):
            return False
        previous, self._previous = self._previous, frame
        if previous is None:
            return False
        # Most images already differ there; the first rows of some cameras are invalid.
        middle = len(frame.depth) // 2
        if not np.array_equal(
            previous.depth[middle : middle + 1], frame.depth[middle : middle + 1]
        ):
            return False
        return np.array_equal(previous.depth, frame.depth) and len(frame) > 0

    def end(self) -> None:
        """Release the last frame."""
        self._previous = None
