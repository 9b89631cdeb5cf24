"""How probable it is that the pose between two views is right.

Two logistic models, fitted to simulated pairs by ``benchmarks/pairs.py fit``, which also prints
their calibration on pairs that took no part. What they are given are shares, free of units and of
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
# Coefficients of `Evidence.searched` and `Evidence.followed`, of 351 and 370 simulated poses. On
# scenes that took no part in the fit the area under the ROC curve is 0.99 and 0.91; of 108 poses
# that were believed after a search 2 were wrong, of 241 that were followed with 0.97 and more none.
_SEARCHED = np.array([0.19, 6.17, 0.30, -6.40, -4.21])
_FOLLOWED = np.array([0.55, 7.01, -6.02])

# Those of `CloudEvidence.searched` and `CloudEvidence.followed`, fitted to simulated poses by
# ``benchmarks/cloud_pairs.py fit``. On scenes and cameras that took no part the area under the ROC
# curve is 0.96 for both, and of 47 and 235 believed poses one each was wrong; of 228 on those that
# did take part, 10 were: rooms of one size behind each other, and slides along bare walls.
_CLOUDS_SEARCHED = np.array([-1.47, 4.33, 0.75, -1.03, -3.80, 0.63])
_CLOUDS_FOLLOWED = np.array([-2.29, 9.96, -2.94, -0.62])


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose and against it.

    Attributes
    ----------
    support, contradiction
        See `Agreement`.
    margin
        Lead over the best other pose, a share of the points; None if no other was looked for.
    degenerate
        Number of degenerate directions.
    """

    support: float
    contradiction: float
    margin: float | None = None
    degenerate: int = 0

    @classmethod
    def of(cls, said: Agreement, margin: float | None = None, degenerate: int = 0) -> Evidence:
        """What both views say of a pose, and its rivals."""
        return cls(said.support, said.contradiction, margin, degenerate)

    @property
    def searched(self) -> Float64:
        """(5,) regressors of a pose that was compared with others.

        Roots of the margin and of the contradiction: from 0 to 2 % they tell more than from 20 to
        40 %. Degenerate directions count the less the more the pose leads: poses along them would
        fit as well.
        """
        lead = max(self.margin or 0.0, 0.0)
        loose = max(1 - lead / _SMALL_LEAD, 0.0) if self.degenerate else 0.0
        return np.array([1, np.sqrt(lead), self.support, np.sqrt(self.contradiction), loose])

    @property
    def followed(self) -> Float64:
        """(3,) regressors of a pose that was followed from a guess, with nothing to compare."""
        return np.array([1, self.support, np.sqrt(self.contradiction)])

    @property
    def probability(self) -> float:
        """That the pose is right, 0 to 1."""
        if self.margin is None:
            return logistic(float(self.followed @ _FOLLOWED))
        return logistic(float(self.searched @ _SEARCHED))

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


@dataclass(frozen=True)
class CloudEvidence:
    """As `Evidence`, of clouds.

    Attributes
    ----------
    support, contradiction, margin, degenerate
        See `Evidence`.
    knows_free_space
        Whether the viewpoints of both clouds are known.
    """

    support: float
    contradiction: float
    margin: float | None
    degenerate: int
    knows_free_space: bool

    @property
    def searched(self) -> Float64:
        """(6,) regressors of a pose that was compared with others."""
        lead = np.sqrt(max(self.margin or 0.0, 0.0))
        unknown = not self.knows_free_space
        return np.array(
            [1, lead, self.support, self.contradiction, self.degenerate > 0, unknown], float
        )

    @property
    def followed(self) -> Float64:
        """(4,) regressors of a pose that was followed from a guess.

        Not how many directions are degenerate: along these it stays where the guess is.
        """
        return np.array([1, self.support, self.contradiction, not self.knows_free_space], float)

    @property
    def probability(self) -> float:
        """That the pose is right, 0 to 1."""
        if self.margin is None:
            return logistic(float(self.followed @ _CLOUDS_FOLLOWED))
        return logistic(float(self.searched @ _CLOUDS_SEARCHED))

    def objection(self) -> str:
        """Why the pose is not believed; empty if it is."""
        if self.probability >= BELIEVED:
            return ""
        said = [f"{self.support:.0%} of the points of both views support the pose"]
        if self.margin is not None:
            said.append(f"it leads the next one by {max(self.margin, 0.0):.1%} of them")
        if self.knows_free_space:
            said.append(f"{self.contradiction:.0%} of the overlap lie in free space")
        if self.degenerate:
            said.append(f"{self.degenerate} directions are degenerate")
        return f"right with a probability of {self.probability:.0%}: " + "; ".join(said)


def logistic(x: float) -> float:
    """1 / (1 + exp(-x)), for any x."""
    return float(0.5 * (1 + np.tanh(0.5 * x)))
