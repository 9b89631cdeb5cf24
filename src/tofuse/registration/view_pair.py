"""Two range images that may be far apart: where one is seen from the other, and what is believed.

The pose is followed from the guess. Where both views then agree so well that it is as good as
certain, that is the answer. Else all poses are searched (`registration.search`), the best one is
aligned, and judged by what both images saw of it and by its lead over its rivals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceMap
from tofuse.registration.agreement import Agreement, AgreementOptions, agreement
from tofuse.registration.base import Registration
from tofuse.registration.confidence import CERTAIN, Evidence
from tofuse.registration.projective import (
    UNITS,
    Aligned,
    ProjectiveOptions,
    Target,
    align,
    registration_of,
)
from tofuse.registration.rough import with_rough_planes
from tofuse.registration.search import Candidate, Match, SearchOptions, search
from tofuse.registration.uncertainty import covariance
from tofuse.registration.verification import (
    COARSE,
    PATIENT,
    Belief,
    UsualFit,
    both_ways_agree,
    comparable,
)

Float64 = NDArray[np.float64]

# Near a guess few iterations do; else as many as a step of a third of the view needs.
_NEAR = ProjectiveOptions(prior_m=3.0, prior_rad=3.0)
_PATIENT = replace(_NEAR, levels=PATIENT)
_FAR = replace(_NEAR, levels=COARSE)
# Errors that the search leaves, m and rad, at depths of a metre and more.
_AFTER_SEARCH = 0.03
# Both ways of an alignment end no further apart: share of the depth, and rad.
_BOTH_WAYS = 0.03
# Score that is lost by noise alone when a pose is aligned.
_GIVEN_UP = 0.05
# Rival poses are further apart than this share of the depth, and lengths that are given for rooms
# shrink with depths below a metre.
_DISTINCT, _NEAR_M = 0.04, 1.0


@dataclass(frozen=True, eq=False)
class _Pose:
    """A pose T_target_source, how it was aligned, and what both views say of it."""

    T_target_source: Float64
    aligned: Aligned
    options: ProjectiveOptions
    agreement: Agreement

    @property
    def degenerate(self) -> int:
        return len(self.aligned.unobservable)

    @property
    def evidence(self) -> Evidence:
        """Without rivals to compare with."""
        return Evidence.of(self.agreement, degenerate=self.degenerate)

    def certain(self, belief: Belief) -> bool:
        """Whether it needs no search."""
        found = self.evidence
        held = not self.degenerate and found.contradiction <= belief.contradiction
        return held and found.probability >= CERTAIN


def register_pair(
    source: SurfaceMap,
    target: SurfaceMap,
    guess: Float64 | None = None,
    *,
    always_search: bool = False,
) -> Registration | None:
    """Register two prepared views.

    Parameters
    ----------
    guess
        (4, 4) T_target_source; the identity unless given.
    always_search
        Whether to search even if the pose that was followed from the guess is as good as certain.

    Returns
    -------
    Registration or None
        None where a view has too few surfaces to be searched with.

    Raises
    ------
    RegistrationError
        If the depths of the views are of different scale.
    """
    _check_scale(source, target)
    belief = _belief(source, target)
    near = _followed(source, target, np.eye(4) if guess is None else guess, belief)
    if near is not None and near.certain(belief) and not always_search:
        return _registration(source, target, near, near.evidence, None, belief)
    match = search(source, target, belief.search)
    if match is None:
        return None
    rough = with_rough_planes(source), with_rough_planes(target)
    best = _settled(source, target, rough, match, belief)
    if guess is not None and near is not None:
        best = _nearer(near, best, rough, belief)
    rival = _rival(best.T_target_source, match, belief.search)
    lead = best.agreement.score - (max(rival.score, 0.0) if rival else 0.0)
    evidence = Evidence.of(best.agreement, lead, best.degenerate)
    return _registration(source, target, best, evidence, rival, belief)


def follow(source: SurfaceMap, target: SurfaceMap, guess: Float64) -> Registration | None:
    """Register two prepared views from a guess (4, 4) alone; None where they don't fit there.

    Raises
    ------
    RegistrationError
        If the depths of the views are of different scale.
    """
    _check_scale(source, target)
    belief = _belief(source, target)
    near = _followed(source, target, guess, belief)
    if near is None:
        return None
    return _registration(source, target, near, near.evidence, None, belief)


def _check_scale(source: SurfaceMap, target: SurfaceMap) -> None:
    if not comparable(source.depth, target.depth):
        raise RegistrationError(
            f"has a median depth of {source.depth:.2g} m, and frame {target.index} of "
            f"{target.depth:.2g} m: views of so different a scale can't be compared",
            where=f"frame {source.index}",
            remedy="check the unit of depth",
        )


def _belief(source: SurfaceMap, target: SurfaceMap) -> Belief:
    """The usual one, with lengths that suit the depth of the views."""
    depth = 0.5 * (source.depth + target.depth)
    plain = Belief()
    compared = plain.search.agreement
    compared = replace(compared, floor_m=compared.floor_m * min(1.0, depth / _NEAR_M))
    distinct = min(plain.search.distinct_m, _DISTINCT * depth)
    return replace(plain, search=replace(plain.search, distinct_m=distinct, agreement=compared))


def _followed(
    source: SurfaceMap, target: SurfaceMap, guess: Float64, belief: Belief
) -> _Pose | None:
    """Align from a guess, first with few iterations; None where the views don't fit there."""
    options = belief.search.agreement
    found = _fitting(source, target, guess, _NEAR, options)
    if found is None or not found.certain(belief):
        coarse = align(source, _at(target), guess, _FAR)
        found = _fitting(source, target, coarse.T_world_source, _PATIENT, options) or found
    return found


def _fitting(
    source: SurfaceMap,
    target: SurfaceMap,
    guess: Float64,
    options: ProjectiveOptions,
    compared: AgreementOptions,
) -> _Pose | None:
    """Align both ways; None where they end apart, or don't fit as views of any camera do."""
    usual = UsualFit()
    there = align(source, _at(target), guess, options)
    if not there.converged or not usual.assess(there).usual:
        return None
    T = there.T_world_source
    back = align(target, _at(source), se3.inverse(T), options)
    far_m = _BOTH_WAYS * source.depth
    same = both_ways_agree(T, back.T_world_source, far_m, _BOTH_WAYS)
    if not same or not usual.assess(back).usual:
        return None
    said = agreement(source, target, T, compared)
    return _Pose(T, there, options, said) if said.score > 0 else None


def _settled(
    source: SurfaceMap,
    target: SurfaceMap,
    rough: tuple[SurfaceMap, SurfaceMap],
    match: Match,
    belief: Belief,
) -> _Pose:
    """Align the best pose of a search, unless the views agree clearly less with that."""
    slack = _AFTER_SEARCH * min(1.0, source.depth / _NEAR_M)
    options = replace(_PATIENT, prior_m=slack, prior_rad=_AFTER_SEARCH)
    aligned = align(source, _at(target), match.T_target_source, options)
    said = agreement(*rough, aligned.T_world_source, belief.search.agreement)
    if said.score >= match.score - _GIVEN_UP:
        return _Pose(aligned.T_world_source, aligned, options, said)
    return _Pose(match.T_target_source, aligned, options, match.agreement)


def _nearer(
    near: _Pose, best: _Pose, rough: tuple[SurfaceMap, SurfaceMap], belief: Belief
) -> _Pose:
    """Of the pose that was followed from the guess and the best one, the one to take.

    A lead that is no evidence does not outweigh the guess, and neither does one along directions
    that are degenerate: there the pose with the largest overlap leads.
    """
    said = agreement(*rough, near.T_target_source, belief.search.agreement)
    near = replace(near, agreement=said)
    if said.score >= best.agreement.score - belief.margin:
        return near
    gap = se3.log(se3.inverse(near.T_target_source) @ best.T_target_source) / UNITS
    weak = near.aligned.unobservable
    across = se3.exp((gap - weak.T @ (weak @ gap)) * UNITS)
    same = not belief.search.differ(np.eye(4), across)
    return near if near.degenerate and same else best


def _rival(T: Float64, match: Match, options: SearchOptions) -> Candidate | None:
    """The best pose of a search that is not this one."""
    others = (c for c in match.candidates if options.differ(T, c.T_target_source))
    return next(others, None)


def _at(view: SurfaceMap) -> list[Target]:
    return [Target(view, np.eye(4))]


def _registration(
    source: SurfaceMap,
    target: SurfaceMap,
    pose: _Pose,
    evidence: Evidence,
    rival: Candidate | None,
    belief: Belief,
) -> Registration:
    reason = evidence.objection(belief)
    found = registration_of(pose.aligned, pose.T_target_source, _covariance(source, target, pose))
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
    )


def _covariance(source: SurfaceMap, target: SurfaceMap, pose: _Pose) -> Float64:
    C = covariance(source, _at(target), pose.aligned, pose.options)
    if pose.T_target_source is not pose.aligned.T_world_source:
        # It is known as well as the search leaves it.
        o = pose.options
        C = C + np.diag(np.array([o.prior_m] * 3 + [o.prior_rad] * 3) ** 2)
    return C
