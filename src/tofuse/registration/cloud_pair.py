"""Two clouds that may be far apart: where one lies in the other, and what is believed.

The pose is followed from the guess. Where both clouds then agree so well that it is as good as
certain, that is the answer. Else poses are proposed by shapes that are alike (`registration.fpfh`);
each is aligned, and judged by what both clouds say of it (`registration.cloud_agreement`) and by
its lead over its rivals.
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
from tofuse.registration.confidence import CERTAIN, CLOUDS, Evidence
from tofuse.registration.fpfh import Fpfh
from tofuse.registration.hold import Hold
from tofuse.registration.icp import Icp
from tofuse.registration.reduce import extent
from tofuse.registration.rejectors import MaxDistance
from tofuse.registration.sample_consensus import are_distinct
from tofuse.registration.selectors import All, Uniform
from tofuse.registration.stopping import SmallStep
from tofuse.registration.surface_metrics import PointToPlane

# Points of either view at most, once they are averaged to be compared.
_POINTS = 10_000
# Proposals that are aligned closely.
_POLISHED = 8
# Poses that differ by more resolutions, or rad, are different answers.
_DISTINCT, _DISTINCT_RAD = 4.0, 0.0873
# Of a pose at the guess and one that leads by less than this share of the points, the first.
_LEAD = 0.02
# Support below which the guess is also followed from coarse to fine.
_LEAST_SUPPORT = 1 / 3
# Score that may be lost by noise alone when a pose is aligned once more.
_GIVEN_UP = 0.02
# Points that show whether a rival ends where the best pose does.
_RIVAL_POINTS = 2500
# Finest resolution in spacings of so many points.
_FINER, _SPACED = 0.5, 5000


@dataclass(frozen=True, eq=False)
class _Pose:
    """A pose T_target_source and what both views say of it."""

    T_target_source: Float64
    agreement: Agreement
    # Where it was followed from; None for poses that were searched.
    guess: Float64 | None = None


# Where nothing fits: the rival of a pose that has no other.
_NOWHERE = _Pose(np.eye(4), Agreement(0.0, 0.0, 0.0, 0.0, np.inf, 0, 0.0))


@dataclass(frozen=True, eq=False)
class _Views:
    """Two clouds that were averaged alike, ready to be compared."""

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
        """Whether the viewpoints of both, and so their free space, are known."""
        return self.there.viewpoint is not None and self.here.viewpoint is not None

    def judged(self, T: Float64) -> _Pose:
        return _Pose(T, cloud_agreement(self.there, self.here, T))

    def polished(self, T: Float64) -> _Pose:
        """Align by some of the points of the averaged source."""
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
        """A registration with what it knows of its errors."""
        T, free = found.T_target_source, found.unobservable
        return replace(found, information=cloud_information(self.there, self.here, T, free))

    def differ(self, a: Float64, b: Float64) -> bool:
        """Whether two poses take the middle of the source elsewhere, or turn it otherwise."""
        points = self.there.view.points.astype(np.float64)
        return are_distinct(a, b, points, metres=_DISTINCT * self.size, rad=_DISTINCT_RAD)


def _finest(view: Frame) -> float:
    """Spacing of a view's points in m, but not much finer than that of some thousand of them."""
    share = min(1.0, _SPACED / max(len(view), 1))
    return spacing(view) * max(_FINER, float(np.sqrt(share)))


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
    guess
        (4, 4) T_target_source; the identity is tried first unless given.
    seen
        What the images that they were seen as gave, if they were; one more proposal.
    always_search
        Whether to search even if the pose that was followed from the guess is as good as certain.

    Returns
    -------
    Where the views fit only with the source 10, 100 or 1000 times as large, or as small, the pose
    is of that, it is not believed, and the reason says so.

    Raises
    ------
    RegistrationError
        If there are too few points, or too few of them correspond anywhere.
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
    # What differs along degenerate directions alone stays as in the guess.
    hold = Hold.of(found.unobservable, views.there.view.points.astype(np.float64))
    across = hold.across(se3.inverse(near.T_target_source) @ found.T_target_source)
    if views.differ(near.T_target_source, near.T_target_source @ across):
        return views.measured(found)
    return views.measured(_registration(views, near, [best]))


def _power_of_scale(source: Frame, target: Frame) -> int:
    """Power of ten by which the target is larger than the source, -3 to 3; 0 if it is not."""
    there, here = extent(source.points), extent(target.points)
    if there == 0 or here == 0:
        return 0
    power = round(float(np.log10(here / there)))
    return power if abs(power) <= 3 else 0


def _registered_scaled(
    source: Frame, target: Frame, scale: float, rng: np.random.Generator
) -> Registration | None:
    """Register the source with its lengths scaled; None where that is not believed."""
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
    """A registration of the images of two clouds, with what the clouds say of its errors.

    Images of clouds have holes, and no noise that is known.
    """
    views = _Views.of(source, target, rng)
    free = cloud_unobservable(views.there, views.here, found.T_target_source)
    return views.measured(replace(found, unobservable=free))


def follow_clouds(
    source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
) -> Registration:
    """Register two clouds from a guess (4, 4) alone; see `register_clouds`."""
    views = _Views.of(source, target, rng)
    near = replace(views.polished(guess), guess=guess)
    if views.evidence(near).probability < CERTAIN:
        far = CoarseToFine().register(source, target, guess, rng)
        other = replace(views.judged(far.T_target_source), guess=guess)
        near = max(near, other, key=lambda pose: pose.agreement.score)
    return views.measured(_registration(views, near))


def _proposed(views: _Views, start: Float64) -> list[_Pose]:
    """Poses that shapes propose, and where a start leads at all scales.

    Raises
    ------
    RegistrationError
        If there is none.
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
    if any(pose.agreement.support > _LEAST_SUPPORT for pose in found):
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
    """Few iterations with a wide reach, then with a narrow one; reaches are in resolutions."""
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
    """The first of some poses that is another answer than the best one, which became T (4, 4).

    Where noise is large, poses end far apart that all points would lead to the same one.
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
    """Align all points from the best pose, and say what is believed of it.

    Its rival is one of the others, best first. Without any nothing was compared with it.
    """
    T = best.T_target_source
    averaged = views.there.view, views.here.view
    found = CoarseToFine().at(views.size, *averaged, T, T if best.guess is None else best.guess)
    after = views.judged(found.T_target_source)
    if after.agreement.score < best.agreement.score - _GIVEN_UP:
        found = replace(found, T_target_source=T)
        after = best
    said = after.agreement
    rival = None if poses is None else _rival(views, poses, best, after.T_target_source)
    lead = None if rival is None else said.score - max(rival.agreement.score, 0.0)
    if lead is not None and len(found.unobservable):
        lead = min(lead, 0.0)  # poses along these directions fit as well
    evidence = views.evidence(after, lead, len(found.unobservable))
    reason = evidence.objection()
    return replace(
        found,
        margin=lead,
        believed=not reason,
        probability=evidence.probability,
        reason=reason,
        runner_up=None if rival is None or rival is _NOWHERE else rival.T_target_source,
        overlap=said.overlap,
        support=said.support,
        contradiction=said.contradiction,
        violation=said.violation,
    )
