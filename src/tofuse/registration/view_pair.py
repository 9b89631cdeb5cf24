"""Registration of two range images with a wide baseline, with a probability of being right.

The views are first aligned from the guess. If their agreement makes that pose practically certain,
it is returned. Else all poses are searched (`registration.search`); the best one is aligned and
evaluated by the agreement of both images and by its lead over rival poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.registration.agreement import Agreement, AgreementOptions, agreement
from tofuse.registration.base import Registration
from tofuse.registration.pose_probability import CERTAIN, CONTRADICTION, Evidence
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import (
    UNITS,
    Aligned,
    ProjectiveOptions,
    Target,
    align,
    registration_of,
)
from tofuse.registration.search import (
    Candidate,
    Match,
    Search,
    SearchOptions,
    differ,
)
from tofuse.registration.uncertainty import UncertaintyOptions, covariance
from tofuse.registration.verification import (
    COARSE,
    PATIENT,
    FitStatistics,
    both_ways_agree,
    comparable,
    self_scaled,
)

# Few iterations near a guess; else enough for a step of a third of the view.
_NEAR = ProjectiveOptions(prior_m=3.0, prior_rad=3.0)
_PATIENT = replace(_NEAR, levels=PATIENT)
_FAR = replace(_NEAR, levels=COARSE)
# Residual error of the search, m and rad, at depths of a metre and more.
_AFTER_SEARCH = 0.03
# Maximum inconsistency of forward and backward alignment: relative to the depth, and rad.
_BOTH_WAYS = 0.03
# Loss of score by noise when a pose is aligned, and lead that is not significant.
_GIVEN_UP, _TIE = 0.05, 0.025
# Minimum distance of rival poses relative to the depth (less than the error of a right pose), and
# depth in m below which tolerances are reduced in proportion.
_DISTINCT, _NEAR_M = 0.04, 1.0
# Exponent of the natural vignetting of a lens.
_VIGNETTING = 4.0


@dataclass(frozen=True, eq=False)
class _Pose:
    """A pose T_target_source with its alignment and agreement.

    `views` are the source and the target as they were aligned, with compensated falloff.
    """

    views: tuple[PreparedView, PreparedView]
    T_target_source: Float64
    aligned: Aligned
    options: ProjectiveOptions
    agreement: Agreement

    @property
    def degenerate(self) -> int:
        return len(self.aligned.unobservable)

    @property
    def evidence(self) -> Evidence:
        """Evidence without a comparison with rivals."""
        return Evidence.of(self.agreement, degenerate=self.degenerate)

    @property
    def is_certain(self) -> bool:
        """Whether it needs no search."""
        found = self.evidence
        agrees = not self.degenerate and found.contradiction <= CONTRADICTION
        return agrees and found.probability >= CERTAIN


def register_pair(
    source: PreparedView,
    target: PreparedView,
    guess: Float64 | None = None,
    *,
    usual: FitStatistics | None = None,
    options: SearchOptions | None = None,
    always_search: bool = False,
    proposals: Callable[[], Float64] | None = None,
    uncertainty: UncertaintyOptions | None = None,
    rival_m: float = math.inf,
) -> Registration | None:
    """Register two prepared views.

    Parameters
    ----------
    source, target
        Prepared views.
    guess
        (4, 4) T_target_source; the identity unless given.
    usual
        Fit statistics of this camera, if known.
    options
        Range and effort of the search.
    always_search
        Whether to search even if the pose aligned from the guess is practically certain.
    proposals
        Returns poses (N, 4, 4) beyond the reach of the search, evaluated if its result is not
        accepted.
    uncertainty
        Constants of the covariance; those of views without multipath unless given.
    rival_m
        Poses further apart than this, or 4 % of the depth if that is less, are rivals.

    Returns
    -------
    Registration or None
        None if a view has too few planes, or the depths of the views differ in scale.
    """
    if not comparable(source.depth, target.depth):
        return None
    pair = _Pair.of(source, target, usual, uncertainty, rival_m)
    near = pair.followed(np.eye(4) if guess is None else guess)
    if near is not None and near.is_certain and not always_search:
        return pair.registration(near, near.evidence, None)
    prepared = Search.of(
        pair.source, pair.target, options, agreement=pair.compared, distinct_m=pair.distinct_m
    )
    match = None if prepared is None else prepared.everywhere()
    if prepared is None or match is None:
        return None
    found = pair.chosen(near, match, prepared, guess is not None)
    if found.believed or proposals is None:
        return found
    return pair.chosen(near, prepared.among(proposals(), match), prepared, guess is not None)


def follow(
    source: PreparedView,
    target: PreparedView,
    guess: Float64,
    *,
    usual: FitStatistics | None = None,
    uncertainty: UncertaintyOptions | None = None,
) -> Registration | None:
    """Register two prepared views from a guess (4, 4) without a search; None if they don't fit.

    For `usual` and `uncertainty` see `register_pair`.
    """
    if not comparable(source.depth, target.depth):
        return None
    pair = _Pair.of(source, target, usual, uncertainty)
    near = pair.followed(guess)
    return None if near is None else pair.registration(near, near.evidence, None)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two views and the tolerances of their comparison.

    Attributes
    ----------
    compared
        Options of the agreement of the two images.
    distinct_m
        Poses that differ by more are distinct hypotheses, m.
    """

    source: PreparedView
    target: PreparedView
    usual: FitStatistics
    compared: AgreementOptions
    distinct_m: float
    uncertainty: UncertaintyOptions | None

    @classmethod
    def of(
        cls,
        source: PreparedView,
        target: PreparedView,
        usual: FitStatistics | None,
        uncertainty: UncertaintyOptions | None,
        rival_m: float = math.inf,
    ) -> _Pair:
        """Adapt the tolerances to the depth of the views and the usual errors of the camera.

        An unknown falloff of the amplitude is taken for that of a lens at first.
        """
        source, target = (
            view.with_falloff(_VIGNETTING) if view.unknown_falloff else view
            for view in (source, target)
        )
        usual = usual or FitStatistics()
        depth = 0.5 * (source.depth + target.depth)
        compared = self_scaled(usual)
        compared = replace(compared, floor_m=compared.floor_m * min(1.0, depth / _NEAR_M))
        distinct_m = min(rival_m, _DISTINCT * depth)
        return cls(source, target, usual, compared, distinct_m, uncertainty)

    def followed(self, guess: Float64) -> _Pose | None:
        """Align from a guess (4, 4), first with few iterations; None if the views don't fit."""
        views = self.source, self.target
        found = self._fitting(views, guess, _NEAR)
        if found is None or not found.is_certain:
            coarse = self._aligned(views, guess, _FAR)
            found = self._fitting(views, coarse.T_world_source, _PATIENT) or found
        if found is not None and found.agreement.falloff:
            views = self._compensated(found.agreement.falloff)
            found = self._fitting(views, found.T_target_source, _PATIENT) or found
        return found

    def _compensated(self, falloff: float) -> tuple[PreparedView, PreparedView]:
        return self.source.with_falloff(falloff), self.target.with_falloff(falloff)

    def _aligned(
        self, views: tuple[PreparedView, PreparedView], guess: Float64, options: ProjectiveOptions
    ) -> Aligned:
        source, target = views
        return align(source, _at(target), guess, options, usual_scale=self.usual.noise_scale)

    def _fitting(
        self, views: tuple[PreparedView, PreparedView], guess: Float64, options: ProjectiveOptions
    ) -> _Pose | None:
        """Align forwards and backwards; None if inconsistent, or if the fit is unusual."""
        there = self._aligned(views, guess, options)
        if not there.converged or not self.usual.assess(there).usual:
            return None
        T = there.T_world_source
        back = self._aligned((views[1], views[0]), se3.inverse(T), options)
        far_m = _BOTH_WAYS * self.source.depth
        same = both_ways_agree(T, back.T_world_source, far_m, _BOTH_WAYS)
        if not same or not self.usual.assess(back).usual:
            return None
        agreed = agreement(self.source, self.target, T, self.compared)
        return _Pose(views, T, there, options, agreed) if agreed.score > 0 else None

    def chosen(
        self, near: _Pose | None, match: Match, prepared: Search, guessed: bool
    ) -> Registration:
        """Select between the poses of a search and the pose aligned from the start.

        The latter is preferred if `guessed`, that is if the start was given by the caller.
        """
        best = self.refined(match, prepared)
        confirmed = near is not None and not near.degenerate and self.same(near, best)
        if guessed and near is not None:
            best = self.nearer(near, best, prepared)
        rival = self.rival(best, match)
        lead = best.agreement.score - (max(rival.score, 0.0) if rival else 0.0)
        evidence = Evidence.of(best.agreement, lead, best.degenerate)
        return replace(self.registration(best, evidence, rival), confirmed=confirmed)

    def refined(self, match: Match, prepared: Search) -> _Pose:
        """Align the best pose of a search, unless its agreement decreases significantly."""
        error_m = _AFTER_SEARCH * min(1.0, self.source.depth / _NEAR_M)
        options = replace(_PATIENT, prior_m=error_m, prior_rad=_AFTER_SEARCH)
        views = self._compensated(match.agreement.falloff)
        aligned = self._aligned(views, match.T_target_source, options)
        agreed = prepared.compared.at(aligned.T_world_source)
        if agreed.score >= match.score - _GIVEN_UP:
            return _Pose(views, aligned.T_world_source, aligned, options, agreed)
        return _Pose(views, match.T_target_source, aligned, options, match.agreement)

    def nearer(self, near: _Pose, best: _Pose, prepared: Search) -> _Pose:
        """Select between the pose aligned from the guess and the best one.

        An insignificant lead does not outweigh the guess, and neither does one along directions
        that are degenerate for both: there the pose with the largest overlap leads.
        """
        agreed = prepared.compared.at(near.T_target_source)
        near = replace(near, agreement=agreed)
        if agreed.score >= best.agreement.score - _TIE:
            return near
        gap = se3.log(se3.inverse(near.T_target_source) @ best.T_target_source) / UNITS
        weak = near.aligned.unobservable
        across = se3.exp((gap - weak.T @ (weak @ gap)) * UNITS)
        same = not differ(np.eye(4), across, self.distinct_m)
        return near if near.degenerate and best.degenerate and same else best

    def same(self, a: _Pose, b: _Pose) -> bool:
        """Whether two poses are the same hypothesis."""
        return not differ(a.T_target_source, b.T_target_source, self.distinct_m)

    def rival(self, pose: _Pose, match: Match) -> Candidate | None:
        """Return the best candidate of a search that is distinct from `pose`."""
        T, least = pose.T_target_source, self.distinct_m
        others = (c for c in match.candidates if differ(T, c.T_target_source, least))
        return next(others, None)

    def registration(
        self, pose: _Pose, evidence: Evidence, rival: Candidate | None
    ) -> Registration:
        """Return a pose as a registration."""
        reason = evidence.rejection_reason()
        found = registration_of(pose.aligned, pose.T_target_source, self._covariance(pose))
        return replace(
            found,
            margin=evidence.margin,
            believed=not reason,
            probability=evidence.probability,
            reason=reason,
            runner_up=None if rival is None else rival.T_target_source,
            overlap=pose.agreement.overlap,
            support=evidence.support,
            contradiction=evidence.contradiction,
            violation=pose.agreement.violation,
        )

    def _covariance(self, pose: _Pose) -> Float64:
        # The search result constrains no degenerate direction.
        loose = replace(pose.options, prior_m=_NEAR.prior_m, prior_rad=_NEAR.prior_rad)
        source, target = pose.views
        C = covariance(source, _at(target), pose.aligned, loose, self.uncertainty)
        if pose.T_target_source is not pose.aligned.T_world_source:
            # Not aligned: add the residual error of the search.
            o = pose.options
            C = C + np.diag(np.array([o.prior_m] * 3 + [o.prior_rad] * 3) ** 2)
        return C


def _at(view: PreparedView) -> list[Target]:
    return [Target(view, np.eye(4))]
