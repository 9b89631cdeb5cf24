"""Selection of a view's points (section 2.9.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Int64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.clouds.interfaces import Selector
from tofuse.engine.frames import Frame
from tofuse.engine.parts import part


@part("selector", "all", label="validated")
@dataclass(frozen=True)
class All(Selector):
    """Every valid point."""

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`; draws nothing."""
        return np.arange(len(view), dtype=np.int64)


@part("selector", "random", label="validated")
@dataclass(frozen=True)
class Random(Bounded, Selector):
    """A random subset, each point as likely as any other (section 3.3).

    Attributes
    ----------
    points
        Number of points; all points of a view with fewer.
    """

    points: Annotated[int, Bounds(1)] = 1000

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`."""
        size = len(view)
        if size <= self.points:
            return np.arange(size, dtype=np.int64)
        drawn = rng.choice(size, self.points, replace=False, shuffle=False)
        return np.sort(drawn.astype(np.int64))


def at_most(points: int | None) -> Selector:
    """Return the selector of `points` random points, or of all points for None."""
    return All() if points is None else Random(points)


@part("selector", "uniform", label="validated")
@dataclass(frozen=True)
class Uniform(Bounded, Selector):
    """Every k-th point (Turk and Levoy 1994): evenly spread over the pixels of a range image.

    Attributes
    ----------
    points
        k is the largest whole number that leaves this many points, or 1.
    """

    points: Annotated[int, Bounds(1)] = 1000

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`; draws nothing."""
        return np.arange(0, len(view), max(1, len(view) // self.points), dtype=np.int64)
