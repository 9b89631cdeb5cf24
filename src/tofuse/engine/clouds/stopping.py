"""Termination criteria of the iterations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.clouds.interfaces import History, Stopping
from tofuse.engine.parts import part

_REPETITION_TOLERANCE = 1e-6


@part("stopping", "two-loops", label="validated")
@dataclass(frozen=True)
class TwoLoops(Bounded, Stopping):
    """The two loops of Algorithm 1.

    The first (lines 1 to 15) runs until the number of corresponding points is the same in two
    iterations. The second (line 16) continues until the change of E from one iteration to the next,
    ``|E_i - E_(i-1)|``, has been below `epsilon` in `k` iterations in a row; its first change is
    that from the last E of the first loop.

    Attributes
    ----------
    epsilon
        Threshold of the change of E; dimensionless.
    k
        Number of consecutive iterations below the threshold.
    max_iterations
        Maximum number of iterations of both loops together.
    """

    epsilon: Annotated[float, Bounds(0, exclusive=True)] = 1e-4
    k: Annotated[int, Bounds(1)] = 3
    max_iterations: Annotated[int, Bounds(1)] = 100

    def met(self, history: History) -> bool:
        """See `Stopping.met`."""
        counts, errors = history.correspondences, history.errors
        last = len(errors) - 1
        first = last - self.k
        if first < 1 or any(
            abs(errors[i] - errors[i - 1]) >= self.epsilon for i in range(first + 1, last + 1)
        ):
            return False
        # The first loop must have ended at `first` or before.
        return any(counts[i] == counts[i - 1] for i in range(1, first + 1))


@part("stopping", "small-step", label="validated")
@dataclass(frozen=True)
class SmallStep(Bounded, Stopping):
    """Ends when the displacement of the points is below a fraction of the resolution.

    It also ends when the iterations oscillate between two sets of matches.

    Attributes
    ----------
    epsilon
        Threshold of the RMS displacement of the source's points, in resolutions.
    max_iterations
        Maximum number of iterations.
    """

    epsilon: Annotated[float, Bounds(0, exclusive=True)] = 1e-3
    max_iterations: Annotated[int, Bounds(1)] = 50

    def met(self, history: History) -> bool:
        """See `Stopping.met`."""
        counts, errors = history.correspondences, history.errors
        if history.steps[-1] < self.epsilon:
            return True
        return (
            len(errors) >= 5
            and counts[-1] == counts[-3] == counts[-5]
            and abs(errors[-1] - errors[-3]) <= _REPETITION_TOLERANCE * errors[-1]
            and abs(errors[-3] - errors[-5]) <= _REPETITION_TOLERANCE * errors[-1]
        )
