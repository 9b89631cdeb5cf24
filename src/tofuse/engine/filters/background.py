"""Background subtraction by depth, for moving objects in front of a static background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, ClassVar

from tofuse.engine.arrays import Bool
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import InputError
from tofuse.engine.filters.background_model import MovingObject, moving_object
from tofuse.engine.filters.base import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part


@part("filter", "background")
@dataclass(frozen=True)
class Background(Bounded, Filter):
    """Keep points in front of the background of a static camera.

    The background of a pixel is the farthest surface that it measures in several frames, sampled
    over the entire recording. Where the object always occludes the background, that surface belongs
    to the object: its depth differs from the surroundings, and continues the object at neighbouring
    pixels.

    Attributes
    ----------
    sigmas, fraction
        Smallest distance of a point in front of the background: the sum of this number of standard
        deviations of the background's depth, and this fraction of it.
    """

    sigmas: Annotated[float, Bounds(0, exclusive=True)] = 4.0
    fraction: Annotated[float, Bounds(0, 1)] = 0.02

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    @property
    def needs_fit(self) -> bool:
        """See `Filter.needs_fit`."""
        return True

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`; InputError, as the background has not been estimated."""
        raise InputError(
            "is not fitted to a recording",
            where="filter 'background'",
            remedy="use the filter that its `fit` returns, or tofuse.reconstruct",
        )

    def fit(self, frames: Sequence[Frame]) -> Filter:
        """See `Filter.fit`.

        Raises
        ------
        InputError
            If the camera moves, nothing moves, or the object can't be segmented from its support.
        """
        images = [frame for frame in frames if isinstance(frame, RangeFrame)]
        return FittedBackground(self, moving_object(images, self.sigmas, self.fraction))


class FittedBackground(Background):
    """A `Background` with an estimated background."""

    _found: MovingObject

    def __init__(self, options: Background, fitted: MovingObject) -> None:
        super().__init__(**{f.name: getattr(options, f.name) for f in fields(options)})
        object.__setattr__(self, "_found", fitted)

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
                remedy="use images of one size",
            )
        return self._found.mask(frame.z)
