"""Filters by a threshold: of the distance, or of the camera's confidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from tofuse.engine.arrays import Bool
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters.base import Filter, Interval
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part


@part("filter", "distance")
@dataclass(frozen=True)
class Distance(Interval, Filter):
    """Keep points at a distance from `minimum` to `maximum` (section 2.8).

    Attributes
    ----------
    minimum, maximum
        Limits in m, inclusive; None for no upper limit.
    measure
        "z" for depth along the optical axis, "range" for radial range. A cloud has no optical axis:
        its distance is always that to its origin; map coordinates without one are refused.
    """

    measure: Literal["z", "range"] = "z"

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        if isinstance(frame, RangeFrame) and self.measure == "z":
            return self.contains(frame.z)
        return self.contains(frame.radial_range)


@part("filter", "confidence", label="validated")
@dataclass(frozen=True)
class Confidence(Bounded, Filter):
    """Keep points of at least a level of the camera's confidence map (section 2.8).

    The SR4000 gives levels 0 to 7; chapter 4 keeps level 7 only. For cameras with other levels see
    `on_scale`. Views without a confidence map are unchanged.

    Attributes
    ----------
    minimum
        Lowest level that is kept, 0 to `highest`.
    highest
        The camera's highest level, 1 to 255.
    """

    minimum: Annotated[int, Bounds(0)] = 7
    highest: Annotated[int, Bounds(1, 255)] = 7

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.minimum > self.highest:
            raise ValueError(f"minimum must be at most {self.highest}, not {self.minimum}")

    def on_scale(self, highest: int) -> Confidence:
        """Return the equivalent filter for a camera whose highest level is `highest`."""
        return Confidence(-(-self.minimum * highest // self.highest), highest)

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        if not isinstance(frame, RangeFrame) or frame.confidence_image is None:
            return np.ones(frame.valid.shape, bool)
        return frame.confidence_image >= self.minimum
