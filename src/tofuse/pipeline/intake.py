"""What is checked of a frame before anything is made of it."""

from __future__ import annotations

import numpy as np

from tofuse.errors import InputError
from tofuse.pipeline.config import ViewKind, kind_of
from tofuse.recordings.frames import Frame, RangeFrame


class Intake:
    """The order and the kind of frames, and whether an image is the one before.

    Attributes
    ----------
    kind
        Of the frames so far; None before the first.
    """

    def __init__(self) -> None:
        self.kind: ViewKind | None = None
        self._index: int | None = None
        self._before: RangeFrame | None = None  # as the camera gave it

    def check_kind(self, frame: Frame) -> bool:
        """Whether it is the first frame; InputError if it is of another kind than those before."""
        kind = kind_of(frame)
        if self.kind and kind != self.kind:
            raise InputError(
                f"is a {kind} view among {self.kind} views",
                where=f"frame {frame.index}",
                remedy="give images only, or clouds only",
            )
        return self.kind is None

    def check_order(self, index: int) -> None:
        """Raise InputError if the index of the next frame does not grow."""
        if self._index is not None and index <= self._index:
            raise InputError(
                f"comes after frame {self._index}",
                where=f"frame {index}",
                remedy="number the frames in the order in which they are pushed",
            )

    def accept(self, index: int, kind: ViewKind | None = None) -> None:
        """Take note of a frame that passed all checks; its kind is None if it was not read."""
        self._index = index
        self.kind = self.kind or kind

    def is_repeated(self, frame: Frame) -> bool:
        """Whether an image is the one before: a camera that hangs, as noise never repeats."""
        if not isinstance(frame, RangeFrame):
            return False
        before, self._before = self._before, frame
        if before is None or not np.array_equal(before.depth[0], frame.depth[0]):
            return False  # most differ there already
        return np.array_equal(before.depth, frame.depth) and len(frame) > 0

    def end(self) -> None:
        """Keep no frame any longer."""
        self._before = None
