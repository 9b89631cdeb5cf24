"""Probability that the pose between two views is right.

Logistic models, one fitted to simulated pairs of images (``benchmarks/pairs.py fit``), one to
clouds (``benchmarks/cloud_pairs.py fit``). Both commands also
print the calibration on held-out pairs. The regressors are dimensionless fractions, independent of
the camera's noise, so that they transfer to other cameras. A pose is right within 5 % of the depth
and 4 degrees, which allows for systematic errors of the camera at large baselines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.quantities import percent, probability
from tofuse.engine.search.pair_agreement import Agreement

# Tolerances of a right pose: fraction of the depth, and rad.
RIGHT_FRACTION, RIGHT_RAD = 0.05, float(np.radians(4.0))
# Minimum probability of an accepted pose; the mean probability of accepted poses is much higher.
ACCEPTED = 0.9
# Minimum probability at which a pose aligned from a guess is accepted without a search, as it was
# not compared with rivals.
CERTAIN = 0.98
# Probabilities are not extrapolated beyond the data that their model was fitted to, a few hundred
# poses.
MAX_PROBABILITY = 0.998
# Usual limits of right poses: minimum support, minimum lead and maximum contradiction.
_MIN_SUPPORT, MIN_LEAD, CONTRADICTION = 0.25, 0.1, 0.08


@dataclass(frozen=True)
class ProbabilityModel:
    """Coefficients of `PoseEvidence.search_regressors` and `PoseEvidence.local_regressors`."""

    search: tuple[float, ...]
    local: tuple[float, ...]


# Fitted to images: 351 searched poses, 370 poses aligned from a guess. On held-out scenes the area
# under the ROC curve is 0.99 and 0.91.
IMAGES = ProbabilityModel(search=(0.34, 6.17, -6.40, -4.21), local=(0.55, 7.01, -6.02))
# Contradiction of clouds beyond which more is no stronger evidence, and the number of distinct
# surfaces by which that near each other is increased: a lead among few surfaces may be chance.
_MUCH_CONTRADICTION, FEW_SURFACES = 0.05, 50.0
# Of searched poses: fitted to 446 of clouds, equal in weight by the square root of their number of
# a kind (clips, views and scans of simulated flats; a dragon; lasers; cameras; random boxes;
# symmetric bodies), where right poses of a laser counted as wrong, and lone poses had no rival. So
# its log odds were scaled by 1.39, plus 0.60, which fits 280 later decisions of these kinds best.
CLOUDS = ProbabilityModel(search=(-0.38, 13.8, -2.85, -9.28), local=(-2.29, 9.96, -5.5))


@dataclass(frozen=True)
class PoseEvidence:
    """Evidence for and against a pose.

    Attributes
    ----------
    support, contradiction
        See `Agreement`. Without known free space the contradiction is 0.
    margin
        Lead over the best rival, a fraction of the points; None without a search.
    degenerate
        Number of degenerate directions.
    model
        Model of the kind of views.
    """

    support: float
    contradiction: float
    margin: float | None = None
    degenerate: int = 0
    model: ProbabilityModel = IMAGES

    @classmethod
    def of(
        cls,
        agreement: Agreement,
        margin: float | None = None,
        degenerate: int = 0,
        model: ProbabilityModel = IMAGES,
    ) -> PoseEvidence:
        """Return the evidence from the agreement of both views."""
        return cls(agreement.support, agreement.contradiction, margin, degenerate, model)

    def applied(
        self, registration: Registration, agreement: Agreement, runner_up: Float64 | None
    ) -> Registration:
        """Return a registration with its decision.

        Parameters
        ----------
        registration
            The registration that the evidence is about.
        agreement
            The agreement of both views at its pose.
        runner_up
            (4, 4) T_target_source of the best rival, if any.
        """
        reason = self.rejection_reason()
        return replace(
            registration,
            margin=self.margin,
            believed=not reason,
            probability=self.probability,
            reason=reason,
            remedy=" or ".join(self.remedies) if reason else "",
            runner_up=runner_up,
            overlap=agreement.overlap,
            support=agreement.support,
            contradiction=agreement.contradiction,
            violation=agreement.violation,
        )

    @property
    def search_regressors(self) -> Float64:
        """Regressors (4,) of a pose that was compared with rivals.

        Square roots of margin and contradiction, as the step from 0 to 2 % is more informative than
        that from 20 to 40 %. Degenerate directions count less with a larger lead, as poses along
        them would fit as well. Support enters by the lead.
        """
        lead = max(self.margin or 0.0, 0.0)
        degeneracy = max(1 - lead / MIN_LEAD, 0.0) if self.degenerate else 0.0
        return np.array([1, np.sqrt(lead), np.sqrt(self.contradiction), degeneracy])

    @property
    def local_regressors(self) -> Float64:
        """Regressors (3,) of a pose aligned from a guess, without rivals.

        Degenerate directions don't count, as they keep the guess.
        """
        return np.array([1, self.support, np.sqrt(self.contradiction)])

    @property
    def probability(self) -> float:
        """Probability that the pose is right, 0 to `MAX_PROBABILITY`."""
        if self.margin is None:
            log_odds = float(self.local_regressors @ self.model.local)
        else:
            log_odds = float(self.search_regressors @ self.model.search)
        return min(logistic(log_odds), MAX_PROBABILITY)

    @property
    def remedies(self) -> tuple[str, ...]:
        """What would decide about a rejected pose, in words: with it, this evidence would do."""
        near = replace(self, margin=None)
        if self.margin is not None and not self.degenerate and near.probability >= CERTAIN:
            return ("a guess near it",)
        return ("another view, which overlaps both more",)

    def rejection_reason(self) -> str:
        """Return the reason why the pose is rejected; empty if it is accepted."""
        if self.probability >= ACCEPTED:
            return ""
        return "; ".join(self.problems) or (
            f"the probability that the pose is right is {probability(self.probability)}, below "
            f"{percent(ACCEPTED)}"
        )

    @property
    def problems(self) -> list[str]:
        """What is unusual of a right pose, in words."""
        problems = []
        if self.support < _MIN_SUPPORT:
            problems.append(
                f"only {percent(self.support)} of the points of both views support the pose"
            )
        if self.margin is not None and self.margin < MIN_LEAD:
            comparison = "as well or better"
            if self.margin > 0:
                comparison = (
                    f"nearly as well, with a score lower by {percent(self.margin)} of the points"
                )
            problems.append(f"another pose fits {comparison}")
        if self.contradiction > CONTRADICTION:
            problems.append(f"{percent(self.contradiction)} of the overlap contradicts the pose")
        if self.degenerate:
            plural = "direction is" if self.degenerate == 1 else "directions are"
            problems.append(f"{self.degenerate} {plural} degenerate")
        return problems


@dataclass(frozen=True)
class CloudEvidence(PoseEvidence):
    """Evidence for and against a pose of two clouds.

    Attributes
    ----------
    surface_lead
        Number of distinct surfaces that coincide, less that of the best rival; of one at which as
        large a fraction coincides, less the number that would if as many were near each other.
    near_surfaces
        Number of distinct surfaces near each other, whether or not they coincide.
    free_space
        Whether the free space of both views is known.
    """

    surface_lead: float = 0.0
    near_surfaces: float = 0.0
    free_space: bool = True

    @property
    def search_regressors(self) -> Float64:
        """Regressors (4,) of a pose that was compared with rivals.

        Clouds overlap by any amount, so that their lead is relative to the overlap. Degenerate
        directions leave none, as poses along them fit as well. What cannot be contradicted, for
        want of free space, is less certain.
        """
        lead = 0.0 if self.degenerate else self._relative_lead
        contradiction = min(self.contradiction / _MUCH_CONTRADICTION, 1.0)
        return np.array([1, np.sqrt(lead), not self.free_space, contradiction])

    @property
    def _relative_lead(self) -> float:
        return max(self.surface_lead, 0.0) / (self.near_surfaces + FEW_SURFACES)

    @property
    def problems(self) -> list[str]:
        """See `PoseEvidence.problems`; also that a structure repeats."""
        problems = super().problems
        if (self.margin or 0.0) >= MIN_LEAD > self._relative_lead and not self.degenerate:
            problems.append("in another pose distinct surfaces coincide nearly as well")
        return problems

    @property
    def remedies(self) -> tuple[str, ...]:
        """See `PoseEvidence.remedies`; also free space, if nothing is in it."""
        seen = replace(self, free_space=True)
        if self.free_space or self.margin is None or seen.probability < ACCEPTED:
            return super().remedies
        return ("points in the frames of their cameras or scanners", *super().remedies)


def logistic(x: float) -> float:
    """1 / (1 + exp(-x)), for any x."""
    return float(0.5 * (1 + np.tanh(0.5 * x)))
