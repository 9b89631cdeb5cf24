"""Rejection of outlier pairs (section 2.9.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.clouds.icp_kernels import shortest_of_each_target
from tofuse.engine.clouds.interfaces import Alignment, Matches, Rejector
from tofuse.engine.parts import part


@part("rejector", "max-distance", label="validated")
@dataclass(frozen=True)
class MaxDistance(Bounded, Rejector):
    """Drops pairs further apart than ``tau = factor * res`` (section 3.2: 2 res).

    Attributes
    ----------
    factor
        In resolutions.
    """

    factor: Annotated[float, Bounds(0, exclusive=True)] = 2.0

    def reach(self, resolution: float) -> float:
        """See `Rejector.reach`."""
        return self.factor * resolution

    def reject(self, matches: Matches, alignment: Alignment) -> Matches:
        """See `Rejector.reject`."""
        return matches.keep(matches.distance <= self.reach(alignment.resolution))


@part("rejector", "unique", label="validated")
@dataclass(frozen=True)
class Unique(Rejector):
    """Of several pairs with the same target point only the shortest stays (Algorithm 1, line 7).

    Of equally short ones the one with the lowest index in the source stays.
    """

    def reject(self, matches: Matches, alignment: Alignment) -> Matches:
        """See `Rejector.reject`."""
        keep = shortest_of_each_target(matches.target, matches.distance, len(alignment.target))
        return matches.keep(keep)
