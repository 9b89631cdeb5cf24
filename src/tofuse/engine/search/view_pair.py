"""Registration of two range images with a wide baseline, with a probability of being right.

The views are first aligned from the guess. If their agreement makes that pose practically certain,
it is returned. Else all poses are searched (`search.search`); the best one is aligned and
evaluated by the agreement of both images and by its lead over rival poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.alignment import Registration, UncertaintyOptions, covariance, projective
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.search.pair_agreement import Agreement, AgreementOptions, agreement
from tofuse.engine.search.pose_probability import CERTAIN, CONTRADICTION, PoseEvidence
from tofuse.engine.search.search import Candidate, Match, Search, are_distinct_poses
from tofuse.engine.search.search_grid import SearchOptions
from tofuse.engine.search.verification import (
    COARSE,
    PATIENT,
    FitStatistics,
    comparable,
    usual_tolerances,
)
from tofuse.engine.views import PreparedView

# Few iterations near a guess; otherwise enough for a step of a third of the view.
_FEW_ITERATIONS = projective.ProjectiveOptions(prior_m=3.0, prior_rad=3.0)
_PATIENT = replace(_FEW_ITERATIONS, levels=PATIENT)
_COARSE_START = replace(_FEW_ITERATIONS, levels=COARSE)
# Error of a pose after the search, m and rad, at depths of a metre and more.
_SEARCH_ERROR = 0.03
# Maximum inconsistency of forward and backward alignment: relative to the depth, and rad.
_MAX_INCONSISTENCY = 0.03
# Loss of score by noise when a pose is aligned, and lead that is not significant.
_MAX_SCORE_LOSS, _TIE = 0.05, 0.025
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
    aligned: projective.Aligned
    options: projective.ProjectiveOptions
    agreement: Agreement

    @property
    def degenerate(self) -> int:
        return len(self.aligned.unobservable)

    @property
    def evidence(self) -> PoseEvidence:
        """Evidence without a comparison with rivals."""
        return PoseEvidence.of(self.agreement, degenerate=self.degenerate)

    @property
    def is_certain(self) -> bool:
        """Whether it needs no search."""
        evidence = self.evidence
        is_consistent = not self.degenerate and evidence.contradiction <= CONTRADICTION
        return is_consistent and evidence.probability >= CERTAIN


def register_pair(
    source: PreparedView,
    target: PreparedView,
    guess: Float64 | None = None,
    *,
    fit_statistics: FitStatistics | None = None,
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
    fit_statistics
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
    pair = _Pair.of(source, target, fit_statistics, uncertainty, rival_m)
    local = pair.local_pose(np.eye(4) if guess is None else guess)
    if local is not None and local.is_certain and not always_search:
        return replace(pair.registration(local, local.evidence, None), given_guess=True)
    search = Search.of(
        pair.source,
        pair.target,
        options,
        agreement=pair.agreement_options,
        distinct_m=pair.distinct_m,
    )
    match = None if search is None else search.exhaustive()
    if search is None or match is None:
        return None
    registration = pair.selected(local, match, search, guess is not None)
    if registration.believed or proposals is None:
        return registration
    return pair.selected(
        local, search.with_proposals(proposals(), match), search, guess is not None
    )


def follow(
    source: PreparedView,
    target: PreparedView,
    guess: Float64,
    *,
    fit_statistics: FitStatistics | None = None,
    uncertainty: UncertaintyOptions | None = None,
) -> Registration | None:
    """Register two prepared views from a guess (4, 4) without a search; None if they don't fit.

    For `fit_statistics` and `uncertainty` see `register_pair`.
    """
    if not comparable(source.depth, target.depth):
        return None
    pair = _Pair.of(source, target, fit_statistics, uncertainty)
    local = pair.local_pose(guess)
    if local is None:
        return None
    return replace(pair.registration(local, local.evidence, None), given_guess=True)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two views and the tolerances of their comparison.

    Attributes
    ----------
    agreement_options
        Options of the agreement of the two images.
    distinct_m
        Poses that differ by more are distinct hypotheses, m.
    """

    source: PreparedView
    target: PreparedView
    fit_statistics: FitStatistics
    agreement_options: AgreementOptions
    distinct_m: float
    uncertainty: UncertaintyOptions | None

    @classmethod
    def of(
        cls,
        source: PreparedView,
        target: PreparedView,
        fit_statistics: FitStatistics | None,
        uncertainty: UncertaintyOptions | None,
        rival_m: float = math.inf,
    ) -> _Pair:
        """Adapt the tolerances to the depth of the views and the usual errors of the camera.

        An unknown falloff of the amplitude is initially assumed to be that of a lens.
        """
        source, target = (
            view.with_falloff(_VIGNETTING) if view.unknown_falloff else view
            for view in (source, target)
        )
        fit_statistics = fit_statistics or FitStatistics()
        depth = 0.5 * (source.depth + target.depth)
        agreement_options = usual_tolerances(fit_statistics)
        agreement_options = replace(
            agreement_options, floor_m=agreement_options.floor_m * min(1.0, depth / _NEAR_M)
        )
        distinct_m = min(rival_m, _DISTINCT * depth)
        return cls(source, target, fit_statistics, agreement_options, distinct_m, uncertainty)

    def local_pose(self, guess: Float64) -> _Pose | None:
        """Align from a guess (4, 4), first with few iterations; None if the views don't fit."""
        views = self.source, self.target
        pose = self._consistent_pose(views, guess, _FEW_ITERATIONS)
        if pose is None or not pose.is_certain:
            coarse = self._aligned(views, guess, _COARSE_START)
            pose = self._consistent_pose(views, coarse.T_world_source, _PATIENT) or pose
        if pose is not None and pose.agreement.falloff:
            views = self._compensated(pose.agreement.falloff)
            pose = self._consistent_pose(views, pose.T_target_source, _PATIENT) or pose
        return pose

    def _compensated(self, falloff: float) -> tuple[PreparedView, PreparedView]:
        return self.source.with_falloff(falloff), self.target.with_falloff(falloff)

    def _aligned(
        self,
        views: tuple[PreparedView, PreparedView],
        guess: Float64,
        options: projective.ProjectiveOptions,
    ) -> projective.Aligned:
        source, target = views[0], [projective.Target(views[1])]
        scale = self.fit_statistics.noise_scale
        return projective.align(source, target, guess, options, usual_scale=scale)

    def _consistent_pose(
        self,
        views: tuple[PreparedView, PreparedView],
        guess: Float64,
        options: projective.ProjectiveOptions,
    ) -> _Pose | None:
        """Align forwards and backwards; None if inconsistent, or if the fit is unusual."""
        forward = self._aligned(views, guess, options)
        if not forward.converged or not self.fit_statistics.assess(forward).is_usual:
            return None
        T = forward.T_world_source
        backward = self._aligned((views[1], views[0]), se3.inverse(T), options)
        max_gap_m = _MAX_INCONSISTENCY * self.source.depth
        consistent = se3.is_within(T @ backward.T_world_source, max_gap_m, _MAX_INCONSISTENCY)
        if not consistent or not self.fit_statistics.assess(backward).is_usual:
            return None
        pose_agreement = agreement(self.source, self.target, T, self.agreement_options)
        return (
            _Pose(views, T, forward, options, pose_agreement) if pose_agreement.score > 0 else None
        )

    def selected(
        self, local: _Pose | None, match: Match, search: Search, has_guess: bool
    ) -> Registration:
        """Select between the poses of a search and the pose aligned from the start.

        The latter is preferred if the caller passed the start.
        """
        best = self.refined(match, search)
        confirmed = local is not None and not local.degenerate and self.are_same(local, best)
        if has_guess and local is not None:
            best = self.preferred(local, best, search)
        rival = self.rival(best, match)
        lead = best.agreement.score - (max(rival.score, 0.0) if rival else 0.0)
        evidence = PoseEvidence.of(best.agreement, lead, best.degenerate)
        return replace(self.registration(best, evidence, rival), confirmed=confirmed)

    def refined(self, match: Match, search: Search) -> _Pose:
        """Align the best pose of a search, unless its agreement decreases significantly."""
        error_m = _SEARCH_ERROR * min(1.0, self.source.depth / _NEAR_M)
        options = replace(_PATIENT, prior_m=error_m, prior_rad=_SEARCH_ERROR)
        views = self._compensated(match.agreement.falloff)
        aligned = self._aligned(views, match.T_target_source, options)
        pose_agreement = search.comparison.at(aligned.T_world_source)
        if pose_agreement.score >= match.score - _MAX_SCORE_LOSS:
            return _Pose(views, aligned.T_world_source, aligned, options, pose_agreement)
        return _Pose(views, match.T_target_source, aligned, options, match.agreement)

    def preferred(self, local: _Pose, best: _Pose, search: Search) -> _Pose:
        """Select between the pose aligned from the guess and the best one.

        An insignificant lead does not outweigh the guess, and neither does one along directions
        that are degenerate for both: there the pose with the largest overlap leads.
        """
        pose_agreement = search.comparison.at(local.T_target_source)
        local = replace(local, agreement=pose_agreement)
        if pose_agreement.score >= best.agreement.score - _TIE:
            return local
        difference = (
            se3.log(se3.inverse(local.T_target_source) @ best.T_target_source) / projective.UNITS
        )
        weak = local.aligned.unobservable
        across = se3.exp((difference - weak.T @ (weak @ difference)) * projective.UNITS)
        is_same = not are_distinct_poses(np.eye(4), across, self.distinct_m)
        return local if local.degenerate and best.degenerate and is_same else best

    def are_same(self, a: _Pose, b: _Pose) -> bool:
        """Whether two poses are the same hypothesis."""
        return not are_distinct_poses(a.T_target_source, b.T_target_source, self.distinct_m)

    def rival(self, pose: _Pose, match: Match) -> Candidate | None:
        """Return the best candidate of a search that is distinct from `pose`."""
        T, distinct_m = pose.T_target_source, self.distinct_m
        rivals = (
            c for c in match.candidates if are_distinct_poses(T, c.T_target_source, distinct_m)
        )
        return next(rivals, None)

    def registration(
        self, pose: _Pose, evidence: PoseEvidence, rival: Candidate | None
    ) -> Registration:
        """Return a pose as a registration."""
        registration = projective.registration_of(
            pose.aligned, pose.T_target_source, self._covariance(pose)
        )
        runner_up = None if rival is None else rival.T_target_source
        return evidence.applied(registration, pose.agreement, runner_up)

    def _covariance(self, pose: _Pose) -> Float64:
        # The result of a search constrains no degenerate direction.
        wide_prior = replace(
            pose.options, prior_m=_FEW_ITERATIONS.prior_m, prior_rad=_FEW_ITERATIONS.prior_rad
        )
        source, target = pose.views[0], [projective.Target(pose.views[1])]
        C = covariance(source, target, pose.aligned, wide_prior, self.uncertainty)
        if pose.T_target_source is not pose.aligned.T_world_source:
            # Not aligned: add the residual error of the search.
            options = pose.options
            C = C + np.diag(np.array([options.prior_m] * 3 + [options.prior_rad] * 3) ** 2)
        return C
