"""Keep what moves before a background that stands still, as it was learnt from the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

from tofuse.arrays import Bool
from tofuse.bounds import above, within
from tofuse.errors import InputError
from tofuse.filters.base import Filter
from tofuse.parts import part
from tofuse.recordings.background import MovingObject, moving_object
from tofuse.recordings.frames import Frame, RangeFrame


@part("filter", "background")
@dataclass(frozen=True)
class Background(Filter):
    """Keep what lies before the background of a camera that stands still.

    The background of a pixel is the farthest surface that it sees in several frames, sampled over
    the whole recording. Where the object always hides it, that surface is the object's own: it
    stands out in depth from what is around it, and continues what passes before its neighbours.

    Attributes
    ----------
    sigmas, fraction
        How far in front of the background a point must be: in standard deviations of the
        background's depth, and as a fraction of it; both together.
    """

    sigmas: float = 4.0
    fraction: float = 0.02

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def __post_init__(self) -> None:
        above("sigmas", self.sigmas, 0)
        within("fraction", self.fraction, 0, 1)

    @property
    def needs_fit(self) -> bool:
        """See `Filter.needs_fit`."""
        return True

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`; InputError, as nothing has been learnt yet."""
        raise InputError(
            "has not learnt the background",
            where="filter 'background'",
            remedy="use tofuse.reconstruct, or the filter that its `fit` returns",
        )

    def fit(self, frames: Sequence[Frame]) -> Filter:
        """See `Filter.fit`.

        Raises
        ------
        InputError
            If the camera moves, nothing moves, or the object can't be told from what it stands on.
        """
        images = [frame for frame in frames if isinstance(frame, RangeFrame)]
        return FittedBackground(self, moving_object(images, self.sigmas, self.fraction))


class FittedBackground(Background):
    """A `Background` that knows what the background is."""

    _found: MovingObject

    def __init__(self, options: Background, found: MovingObject) -> None:
        super().__init__(**{f.name: getattr(options, f.name) for f in fields(options)})
        object.__setattr__(self, "_found", found)

    @property
    def needs_fit(self) -> bool:
        """See `Filter.needs_fit`."""
        return False

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        assert isinstance(frame, RangeFrame)
        rows, columns = self._found.limit.shape
        if frame.depth.shape != (rows, columns):
            raise InputError(
                f"is {frame.depth.shape[1]} x {frame.depth.shape[0]}, the background "
                f"{columns} x {rows}",
                where=f"frame {frame.index}",
                remedy="give images of one size",
            )
        return self._found.mask(frame.z)
