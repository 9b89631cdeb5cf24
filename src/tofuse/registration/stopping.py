"""Termination criteria of the iterations."""

from __future__ import annotations

from dataclasses import dataclass

from tofuse.parts import part
from tofuse.registration.interfaces import History, Stopping

_REPEATED = 1e-6


@part("stopping", "two-loops", label="validated")
@dataclass(frozen=True)
class TwoLoops(Stopping):
    """The two loops of Algorithm 1.

    The first (lines 1 to 15) runs until the number of corresponding points is the same in two
    iterations. The second (line 16) goes on until the change of E from one iteration to the next,
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

    epsilon: float = 1e-4
    k: int = 3
    max_iterations: int = 100

    def __post_init__(self) -> None:
        if not self.epsilon > 0:
            raise ValueError(f"epsilon is {self.epsilon}, not more than 0")
        if self.k < 1:
            raise ValueError(f"k is {self.k}, not 1 or more")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations is {self.max_iterations}, not 1 or more")

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
class SmallStep(Stopping):
    """Ends when the displacement of the points is below a fraction of the resolution.

    It also ends when the iterations oscillate between two sets of matches.

    Attributes
    ----------
    epsilon
        Threshold of the RMS displacement of the source's points, in resolutions.
    max_iterations
        Maximum number of iterations.
    """

    epsilon: float = 1e-3
    max_iterations: int = 50

    def __post_init__(self) -> None:
        if not self.epsilon > 0:
            raise ValueError(f"epsilon is {self.epsilon}, not more than 0")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations is {self.max_iterations}, not 1 or more")

    def met(self, history: History) -> bool:
        """See `Stopping.met`."""
        counts, errors = history.correspondences, history.errors
        if history.steps[-1] < self.epsilon:
            return True
        return (
            len(errors) >= 5
            and counts[-1] == counts[-3] == counts[-5]
            and abs(errors[-1] - errors[-3]) <= _REPEATED * errors[-1]
            and abs(errors[-3] - errors[-5]) <= _REPEATED * errors[-1]
        )
