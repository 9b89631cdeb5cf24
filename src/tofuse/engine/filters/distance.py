"""Filter by the distance to the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from tofuse.engine.arrays import Bool
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
        its distance is always that to its origin.
    """

    measure: Literal["z", "range"] = "z"

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        if isinstance(frame, RangeFrame):
            distance = frame.z if self.measure == "z" else frame.radial_range
        else:
            distance = np.linalg.norm(frame.points - frame.origin, axis=1)
        return self.contains(distance)
