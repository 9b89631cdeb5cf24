"""The interface of filters, and the application of a list of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Protocol

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import Frame
from tofuse.engine.parts import name_of


class Filter(Protocol):
    """A method that marks points of a view as invalid.

    Attributes
    ----------
    takes
        Kinds of view it accepts: "range", "cloud"; by default both.
    window
        Number of frames it uses, the current one included; 1 for all but temporal filters.
    needs_fit
        Whether parameters are to be estimated from frames of the recording first.
    """

    part_kind: ClassVar[str] = "filter"
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    @property
    def window(self) -> int:
        """Number of frames it uses, the current one included."""
        return 1

    @property
    def needs_fit(self) -> bool:
        """Whether `fit` must be called with frames of the recording before `mask`."""
        return False

    def fit(self, frames: Sequence[Frame]) -> Filter:
        """Return the filter with parameters estimated from frames sampled over a recording.

        Parameters
        ----------
        frames
            As they reach this filter: corrected, and filtered by those before it.
        """
        return self

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """Return the mask of points to keep.

        Parameters
        ----------
        frame
            The view, after the preceding filters.
        history
            Up to ``window - 1`` unfiltered frames just before it, oldest first.

        Returns
        -------
        A mask of the shape of ``frame.valid``; its values at invalid points are ignored.
        """
        ...


@dataclass(frozen=True)
class Interval(Bounded):
    """Numbers from `minimum` to `maximum`; None for no upper limit."""

    minimum: Annotated[float, Bounds(0)] = 0.0
    maximum: Annotated[float | None, Bounds()] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.maximum is not None and not self.maximum > self.minimum:
            raise ValueError(f"maximum must be above {self.minimum:g}, not {self.maximum!r}")

    def contains(self, values: Float32 | Float64) -> Bool:
        """Return which of the values lie in the interval."""
        keep: Bool = values >= self.minimum
        return keep if self.maximum is None else keep & (values <= self.maximum)


@dataclass(frozen=True)
class Removal:
    """Statistics of one filter on one frame: it removed `removed` of `received` points."""

    name: str
    received: int
    removed: int


def apply_filters(
    filters: Sequence[Filter], frame: Frame, history: Sequence[Frame] = ()
) -> tuple[Frame, list[Removal]]:
    """Apply filters in order, each to the result of the ones before.

    Returns the filtered frame and the statistics of each filter.
    """
    removals = []
    for filter_ in filters:
        count = len(frame)
        past = history[-(filter_.window - 1) :] if filter_.window > 1 else ()
        mask = filter_.mask(frame, past)
        if not mask.all():
            frame = frame.keep(mask)
        removals.append(Removal(name_of(filter_), count, count - len(frame)))
    return frame, removals
