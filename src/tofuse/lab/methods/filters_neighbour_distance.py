"""Outlier removal by a threshold on the distance to the nearest neighbours in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Bool
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters import MAX_NEIGHBOURS, Filter, mean_neighbour_distance
from tofuse.engine.frames import Frame
from tofuse.engine.parts import part


@part("filter", "neighbour_distance")
@dataclass(frozen=True)
class NeighbourDistance(Bounded, Filter):
    """Remove points whose k nearest neighbours are on average too far away (section 2.8).

    Attributes
    ----------
    threshold
        Largest mean distance that is kept, m.
    k
        Number of neighbours.
    """

    threshold: Annotated[float, Bounds(0, exclusive=True)] = 0.05
    k: Annotated[int, Bounds(1, MAX_NEIGHBOURS)] = 3

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        mask = np.zeros(frame.valid.shape, bool)
        mask[frame.valid] = mean_neighbour_distance(frame.points, self.k) <= self.threshold
        return mask
