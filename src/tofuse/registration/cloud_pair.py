"""Global registration of two clouds, with a probability of being right.

The clouds are first aligned from the guess. If their agreement makes that pose practically
certain, it is returned. Else poses are proposed by feature matching (`registration.fpfh`); each is
aligned and evaluated by the agreement of both clouds (`registration.cloud_agreement`) and by its
lead over rival poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.registration.agreement import Agreement
from tofuse.registration.base import Registration
from tofuse.registration.cloud_agreement import NEIGHBOURS, CloudMap, cloud_agreement
from tofuse.registration.cloud_uncertainty import cloud_information, cloud_unobservable
from tofuse.registration.coarse_to_fine import CoarseToFine, spacing
from tofuse.registration.fpfh import Fpfh
from tofuse.registration.icp import Icp
from tofuse.registration.pose_probability import CERTAIN, CLOUDS, Evidence
from tofuse.registration.reduce import extent
from tofuse.registration.rejectors import MaxDistance
from tofuse.registration.remapping import Remapping
from tofuse.registration.sample_consensus import are_distinct
from tofuse.registration.selectors import All, Uniform
from tofuse.registration.stopping import SmallStep
from tofuse.registration.surface_metrics import PointToPlane

# Maximum number of points of each averaged view.
_POINTS = 10_000
# Number of proposals that are aligned at full resolution.
_POLISHED = 8
# Poses that differ by more resolutions, or rad, are distinct hypotheses.
_DISTINCT, _DISTINCT_RAD = 4.0, 0.0873
# A pose near the guess is preferred to one that leads by less than this fraction of the points.
_LEAD = 0.02
# Support below which the views are also aligned from the guess from coarse to fine.
_MIN_SUPPORT = 1 / 3
# Loss of score by noise when a pose is aligned again.
_GIVEN_UP = 0.02
# Points used to test whether a rival converges to the best pose.
_RIVAL_POINTS = 2500
# Finest resolution, in spacings of this number of points.
_FINER, _SPACED = 0.5, 5000


@dataclass(frozen=True, eq=False)
class _Pose:
    """A pose T_target_source (4, 4) and its agreement."""

    T_target_source: Float64
    agreement: Agreement
    # Start of its alignment; None for proposals.
    guess: Float64 | None = None


# Placeholder for the rival of a pose without one; nothing fits there.
_NOWHERE = _Pose(np.eye(4), Agreement(0.0, 0.0, 0.0, 0.0, np.inf, 0, 0.0))


@dataclass(frozen=True, eq=False)
class _Views:
    """Two clouds averaged to the same resolution."""

    source: Frame
    target: Frame
    there: CloudMap
    here: CloudMap
    rng: np.random.Generator

    @classmethod
    def of(cls, source: Frame, target: Frame, rng: np.random.Generator) -> _Views:
        size = max(_finest(source), _finest(target))
        size, data, model = CoarseToFine(points=_POINTS).finest(source, target, size)
        maps = CloudMap.of(data, size, source), CloudMap.of(model, size, target)
        return cls(source, target, *maps, rng)

    @property
    def size(self) -> float:
        return self.here.size

    @property
    def knows_free_space(self) -> bool:
        """Whether the viewpoint, and so the free space, is known for both views."""
        return self.there.viewpoint is not None and self.here.viewpoint is not None

    def judged(self, T: Float64) -> _Pose:
        return _Pose(T, cloud_agreement(self.there, self.here, T))

    def polished(self, T: Float64) -> _Pose:
        """Align with a subset of the averaged source's points; T (4, 4) if that scores lower."""
        before = self.judged(T)
        try:
            for icp in _polish(self.size):
                T = icp.register(self.there.view, self.here.view, T, self.rng).T_target_source
        except RegistrationError:
            return before
        after = self.judged(T)
        return after if after.agreement.score >= before.agreement.score else before

    def evidence(self, pose: _Pose, lead: float | None = None, degenerate: int = 0) -> Evidence:
        return Evidence.of(pose.agreement, lead, degenerate, CLOUDS)

    def measured(self, found: Registration) -> Registration:
        """Return a registration with its information matrix."""
        T, free = found.T_target_source, found.unobservable
        return replace(found, information=cloud_information(self.there, self.here, T, free))

    def differ(self, a: Float64, b: Float64) -> bool:
        """Whether two poses (4, 4) are distinct hypotheses."""
        points = self.there.view.points.astype(np.float64)
        return are_distinct(a, b, points, metres=_DISTINCT * self.size, rad=_DISTINCT_RAD)


def _finest(view: Frame) -> float:
    """Return a view's point spacing in m, bounded below by that of some thousand points."""
    fraction = min(1.0, _SPACED / max(len(view), 1))
    return spacing(view) * max(_FINER, float(np.sqrt(fraction)))


def register_clouds(
    source: Frame,
    target: Frame,
    guess: Float64 | None,
    rng: np.random.Generator,
    seen: Registration | None = None,
    *,
    always_search: bool = False,
) -> Registration:
    """Register two clouds, or a cloud and an image.

    Parameters
    ----------
    source, target
        Views; at least one is a cloud.
    guess
        (4, 4) T_target_source; the identity unless given.
    rng
        Source of the random samples.
    seen
        Result of the registration as images, if any: one more proposal.
    always_search
        Whether to search even if the pose aligned from the guess is practically certain.

    Returns
    -------
    The registration. If the views fit only with the source scaled by a power of ten from 0.001 to
    1000, the pose is that of the scaled source, not accepted, and `reason` states the scale.

    Raises
    ------
    RegistrationError
        If there are too few points, or no pose has enough correspondences.
    """
    power = _power_of_scale(source, target)
    if power and not always_search:
        scale = 10.0**power
        found = _registered_scaled(source, target, scale, rng)
        if found is not None:
            reason = f"the views fit with the source {scale:g} times as large: check its unit"
            return replace(found, believed=False, reason=reason)
    try:
        return _registered(source, target, guess, rng, seen, always_search=always_search)
    except RegistrationError as error:
        if not power:
            raise
        raise RegistrationError(
            f"its extent is about {10.0**-power:g} times that of the target, and it does not fit",
            where=f"frame {source.index}",
            remedy="check the units of both clouds",
        ) from error


def _registered(
    source: Frame,
    target: Frame,
    guess: Float64 | None,
    rng: np.random.Generator,
    seen: Registration | None = None,
    *,
    always_search: bool = False,
) -> Registration:
    views = _Views.of(source, target, rng)
    start = np.eye(4) if guess is None else guess
    near = replace(views.polished(start), guess=start)
    if views.evidence(near).probability >= CERTAIN and not always_search:
        found = _registration(views, near)
        if (found.probability or 0.0) >= CERTAIN and not len(found.unobservable):
            return views.measured(found)
    poses = [near] if seen is None else [near, views.judged(seen.T_target_source)]
    poses += _proposed(views, start)
    poses.sort(key=lambda pose: -pose.agreement.score)
    best = poses[0]
    if guess is not None:
        alike = [p for p in poses if p.agreement.score >= best.agreement.score - _LEAD]
        best = min(alike, key=lambda p: _apart(p.T_target_source, guess))
    found = _registration(views, best, poses)
    if guess is None or best.guess is not None or not len(found.unobservable):
        return views.measured(found)
    # Poses that differ along degenerate directions only: keep the guess there.
    remapping = Remapping.of(found.unobservable, views.there.view.points.astype(np.float64))
    across = remapping.across(se3.inverse(near.T_target_source) @ found.T_target_source)
    if views.differ(near.T_target_source, near.T_target_source @ across):
        return views.measured(found)
    return views.measured(_registration(views, near, [best]))


def _power_of_scale(source: Frame, target: Frame) -> int:
    """Power of ten (-3 to 3) of the ratio of the target's extent to the source's, else 0."""
    there, here = extent(source.points), extent(target.points)
    if there == 0 or here == 0:
        return 0
    power = round(float(np.log10(here / there)))
    return power if abs(power) <= 3 else 0


def _registered_scaled(
    source: Frame, target: Frame, scale: float, rng: np.random.Generator
) -> Registration | None:
    """Register the scaled source; None if the result is not accepted."""
    points = source.points * np.float32(scale)
    scaled = CloudFrame(source.index, source.timestamp, points, origin=scale * source.origin)
    try:
        found = _registered(scaled, target, None, rng)
    except RegistrationError:
        return None
    return found if found.believed else None


def measured_as_clouds(
    source: Frame, target: Frame, found: Registration, rng: np.random.Generator
) -> Registration:
    """Return a registration of two clouds' images with the information matrix of the clouds.

    Images of clouds have holes, and their noise is unknown.
    """
    views = _Views.of(source, target, rng)
    free = cloud_unobservable(views.there, views.here, found.T_target_source)
    return views.measured(replace(found, unobservable=free))


def follow_clouds(
    source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
) -> Registration:
    """Register two clouds from a guess (4, 4) without a search; see `register_clouds`."""
    views = _Views.of(source, target, rng)
    near = replace(views.polished(guess), guess=guess)
    if views.evidence(near).probability < CERTAIN:
        far = CoarseToFine().register(source, target, guess, rng)
        other = replace(views.judged(far.T_target_source), guess=guess)
        near = max(near, other, key=lambda pose: pose.agreement.score)
    return views.measured(_registration(views, near))


def _proposed(views: _Views, start: Float64) -> list[_Pose]:
    """Return the poses of feature matching, and of coarse-to-fine ICP if they lack support.

    Raises
    ------
    RegistrationError
        If there is no pose.
    """
    found, failure = [], None
    try:
        candidates = (
            Fpfh(signed=views.knows_free_space)
            .candidates(views.source, views.target, views.rng)
            .poses
        )
        found += [views.polished(c.T_target_source) for c in candidates[:_POLISHED]]
    except RegistrationError as error:
        failure = error
    if any(pose.agreement.support > _MIN_SUPPORT for pose in found):
        return found
    try:
        near = CoarseToFine().register(views.source, views.target, start, views.rng)
        found.append(replace(views.judged(near.T_target_source), guess=start))
    except RegistrationError as error:
        failure = error
    if not found and failure is not None:
        raise failure
    return found


def _apart(a: Float64, b: Float64) -> float:
    return float(np.linalg.norm(se3.log(se3.inverse(a) @ b)))


def _polish(size: float) -> tuple[Icp, ...]:
    """Return ICP with few iterations at a wide reach, then at a narrow one, in resolutions."""
    plain = Icp(
        size,
        source=Uniform(800),
        target=All(),
        rejectors=(MaxDistance(4.0),),
        metric=PointToPlane(loss="tukey"),
        stopping=SmallStep(1e-2, 8),
        neighbours=NEIGHBOURS,
    )
    return plain, replace(plain, rejectors=(MaxDistance(2.0),), stopping=SmallStep(1e-3, 8))


def _rival(views: _Views, poses: Sequence[_Pose], best: _Pose, T: Float64) -> _Pose:
    """Return the first pose distinct from the best one, whose alignment is T (4, 4).

    With large noise, subsets of the points converge to different poses where all points converge to
    the same one, so rivals are aligned with more points before they are compared.
    """
    averaged = views.there.view, views.here.view
    for pose in poses:
        start = pose.T_target_source
        if not views.differ(start, best.T_target_source):
            continue
        try:
            end = CoarseToFine().roughly(views.size, *averaged, start, _RIVAL_POINTS)
        except RegistrationError:
            end = start
        if views.differ(end, T):
            return pose
    return _NOWHERE


def _registration(views: _Views, best: _Pose, poses: Sequence[_Pose] | None = None) -> Registration:
    """Align all points from the best pose and evaluate its evidence.

    The rival is one of `poses`, the best first; None if the pose was not compared with others.
    """
    T = best.T_target_source
    averaged = views.there.view, views.here.view
    found = CoarseToFine().at(views.size, *averaged, T, T if best.guess is None else best.guess)
    after = views.judged(found.T_target_source)
    if after.agreement.score < best.agreement.score - _GIVEN_UP:
        found = replace(found, T_target_source=T)
        after = best
    agreement = after.agreement
    rival = None if poses is None else _rival(views, poses, best, after.T_target_source)
    lead = None if rival is None else agreement.score - max(rival.agreement.score, 0.0)
    if lead is not None and len(found.unobservable):
        lead = min(lead, 0.0)  # poses along these directions fit as well
    evidence = views.evidence(after, lead, len(found.unobservable))
    reason = evidence.rejection_reason()
    return replace(
        found,
        margin=lead,
        believed=not reason,
        probability=evidence.probability,
        reason=reason,
        runner_up=None if rival is None or rival is _NOWHERE else rival.T_target_source,
        overlap=agreement.overlap,
        support=agreement.support,
        contradiction=agreement.contradiction,
        violation=agreement.violation,
    )
