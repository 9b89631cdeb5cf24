"""The interface of a filter, and applying a list of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

from tofuse.arrays import Bool
from tofuse.parts import name_of
from tofuse.recordings.frames import Frame


class Filter(Protocol):
    """One way of telling good points from bad ones.

    Attributes
    ----------
    takes
        Kinds of view it works on: "range", "cloud".
    window
        How many frames it looks at, the current one included; 1 for all but temporal filters.
    needs_fit
        Whether it must see frames of the whole recording first.
    """

    part_kind: ClassVar[str] = "filter"
    takes: ClassVar[frozenset[str]]

    @property
    def window(self) -> int:
        """How many frames it looks at, the current one included."""
        return 1

    @property
    def needs_fit(self) -> bool:
        """Whether it must see frames of the whole recording, with `fit`, before it works."""
        return False

    def fit(self, frames: Sequence[Frame]) -> Filter:
        """Return the filter with what it has learnt from frames spread over a recording.

        Parameters
        ----------
        frames
            As they reach this filter: corrected, and filtered by those before it.
        """
        return self

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """Say which points to keep.

        Parameters
        ----------
        frame
            The view, as the filters before this one left it.
        history
            Up to ``window - 1`` unfiltered frames just before it, oldest first.

        Returns
        -------
        A mask of the shape of ``frame.valid``; only its value at valid points counts.
        """
        ...


@dataclass(frozen=True)
class Removal:
    """What one filter removed from one frame: `removed` of the `seen` points that reached it."""

    name: str
    seen: int
    removed: int


def apply_filters(
    filters: Sequence[Filter], frame: Frame, history: Sequence[Frame] = ()
) -> tuple[Frame, list[Removal]]:
    """Apply filters in order; each sees what the ones before it left.

    Returns the filtered frame and what each filter removed.
    """
    removals = []
    for item in filters:
        before = len(frame)
        past = history[-(item.window - 1) :] if item.window > 1 else ()
        mask = item.mask(frame, past)
        if not mask.all():
            frame = frame.keep(mask)
        removals.append(Removal(name_of(item), before, before - len(frame)))
    return frame, removals
