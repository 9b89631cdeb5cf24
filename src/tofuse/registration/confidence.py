"""How probable it is that the pose between two views is right.

Logistic models of the same few regressors, one fitted to simulated pairs of images
(``benchmarks/pairs.py fit``), one to clouds (``benchmarks/cloud_pairs.py fit``). Both commands also
print the calibration on pairs that took no part. The regressors are shares, free of units and of
the camera's noise, so that they carry over to other cameras. A pose counts as right within 5 % of
the depth and 4 degrees: what a camera's systematic errors leave at large steps is not another
place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.registration.agreement import Agreement

# What counts as right: share of the depth, and rad.
RIGHT_SHARE, RIGHT_RAD = 0.05, float(np.radians(4.0))
# Of poses that are just believed one in ten is wrong, of all that are believed far fewer.
BELIEVED = 0.9
# Poses that were followed from a guess are believed without a search only if they are as good as
# certain, as nothing was compared with them.
CERTAIN = 0.98
# Less support, a smaller lead and a larger contradiction than right poses have as a rule.
_LITTLE_SUPPORT, _SMALL_LEAD, CONTRADICTION = 0.25, 0.1, 0.08


@dataclass(frozen=True)
class Model:
    """Coefficients of `Evidence.searched` and `Evidence.followed`."""

    searched: tuple[float, ...]
    followed: tuple[float, ...]


# Of images: 351 poses that were searched, 370 that were followed. On scenes that took no part in
# the fit the area under the ROC curve is 0.99 and 0.91.
IMAGES = Model(searched=(0.34, 6.17, -6.40, -4.21), followed=(0.55, 7.01, -6.02))
# Of clouds: 146 poses that were searched. On 226 of other frames and places, some of which share
# nothing, the area is 0.98; of 90 that were believed 2 were wrong, one by 0.13 m, one a room of
# the same size where no viewpoint is known.
CLOUDS = Model(searched=(-1.82, 6.08, -4.78, -0.69), followed=(-2.29, 9.96, -5.5))


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose and against it.

    Attributes
    ----------
    support, contradiction
        See `Agreement`. Without free space nothing can contradict a pose.
    margin
        Lead over the best other pose, a share of the points; None if no other was looked for.
    degenerate
        Number of degenerate directions.
    model
        That of the kind of views.
    """

    support: float
    contradiction: float
    margin: float | None = None
    degenerate: int = 0
    model: Model = IMAGES

    @classmethod
    def of(
        cls,
        said: Agreement,
        margin: float | None = None,
        degenerate: int = 0,
        model: Model = IMAGES,
    ) -> Evidence:
        """What both views say of a pose, and its rivals."""
        return cls(said.support, said.contradiction, margin, degenerate, model)

    @property
    def searched(self) -> Float64:
        """(4,) regressors of a pose that was compared with others.

        Roots of the margin and of the contradiction: from 0 to 2 % they tell more than from 20 to
        40 %. Degenerate directions count the less the more the pose leads: poses along them would
        fit as well. What supports the pose is in its lead.
        """
        lead = max(self.margin or 0.0, 0.0)
        loose = max(1 - lead / _SMALL_LEAD, 0.0) if self.degenerate else 0.0
        return np.array([1, np.sqrt(lead), np.sqrt(self.contradiction), loose])

    @property
    def followed(self) -> Float64:
        """(3,) regressors of a pose that was followed from a guess, with nothing to compare.

        Not how many directions are degenerate: along these it stays where the guess is.
        """
        return np.array([1, self.support, np.sqrt(self.contradiction)])

    @property
    def probability(self) -> float:
        """That the pose is right, 0 to 1."""
        if self.margin is None:
            return logistic(float(self.followed @ self.model.followed))
        return logistic(float(self.searched @ self.model.searched))

    def objection(self) -> str:
        """Why the pose is not believed; empty if it is."""
        if self.probability >= BELIEVED:
            return ""
        said = []
        if self.support < _LITTLE_SUPPORT:
            said.append(f"only {self.support:.0%} of the points of both views support the pose")
        if self.margin is not None and self.margin < _SMALL_LEAD:
            lead = max(self.margin, 0.0)
            said.append(f"another pose fits nearly as well, less {lead:.1%} of the points")
        if self.contradiction > CONTRADICTION:
            said.append(f"{self.contradiction:.0%} of the overlap contradicts the pose")
        if self.degenerate:
            said.append(f"{self.degenerate} directions are degenerate")
        return "; ".join(said) or f"the pose is right with a probability of {self.probability:.0%}"


def logistic(x: float) -> float:
    """1 / (1 + exp(-x)), for any x."""
    return float(0.5 * (1 + np.tanh(0.5 * x)))
