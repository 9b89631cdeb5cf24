"""Outlier removal by the distance to the nearest neighbours in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters.base import Filter
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import KdTree
from tofuse.engine.parts import part

# Upper limit of k, which bounds the memory.
MAX_NEIGHBOURS = 1000


@part("filter", "neighbour_fraction")
@dataclass(frozen=True)
class NeighbourFraction(Bounded, Filter):
    """Remove a fraction of the points: those with the largest mean distance to their neighbours.

    Chapter 4 removes half of them, with 3 neighbours. Of equal distances later points are removed
    first.

    Attributes
    ----------
    fraction
        Fraction of the points to remove, 0 to 1, rounded down to whole points.
    k
        Number of neighbours.
    """

    fraction: Annotated[float, Bounds(0, 1)] = 0.5
    k: Annotated[int, Bounds(1, MAX_NEIGHBOURS)] = 3

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        distance = mean_neighbour_distance(frame.points, self.k)
        # The small addition keeps 0.29 of 100 points at 29.
        kept = len(distance) - int(self.fraction * len(distance) + 1e-6)
        keep = np.zeros(len(distance), bool)
        keep[np.argsort(distance, kind="stable")[:kept]] = True
        mask = np.zeros(frame.valid.shape, bool)
        mask[frame.valid] = keep
        return mask


def mean_neighbour_distance(points: Float32, k: int) -> Float64:
    """Return the mean distance (N,) in m of points (N, 3) to their k nearest neighbours.

    If there are fewer than k other points, all are used; it is infinite for a single point.
    """
    n = len(points)
    if n < 2:
        return np.full(n, np.inf)
    k = min(k, n - 1)
    # The nearest neighbour is the point itself, or a duplicate of it, at distance 0.
    _, squares = KdTree(points).neighbours(points, k + 1)
    return np.sqrt(squares[:, 1:]).mean(1)
