"""Global registration of two clouds, with a probability of being right.

The clouds are first aligned from the guess. If one is given, and their agreement makes that pose
practically certain, it is returned; if the clouds are symmetric, so that another pose fits as well,
it holds given the guess only. Else poses are proposed by feature matching
(`clouds.proposals`); each is aligned and evaluated by the agreement of both clouds
(`clouds.cloud_agreement`) and by its lead over rival poses. That is counted in points, and in
distinct surfaces, which decide whether the pose is believed. Without a guess rivals are
searched in any case: however well a symmetric body fits, it fits as well in another pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds.cloud_agreement import (
    NEIGHBOURS,
    CloudAgreement,
    CloudMap,
    are_oriented,
    cloud_agreement,
)
from tofuse.engine.clouds.cloud_uncertainty import cloud_information, cloud_unobservable
from tofuse.engine.clouds.fpfh import MATCH_WEIGHT, MAX_VIOLATION, candidates, log_matches
from tofuse.engine.clouds.proposals import Proposals, proposals
from tofuse.engine.clouds.repetition import shifts
from tofuse.engine.clouds.robust_motion import are_distinct
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp import (
    CoarseToFine,
    Icp,
    Remapping,
    averaged,
    extent,
    icp_parts,
    spacing,
    surface_metrics,
)
from tofuse.engine.search import pose_probability

# Maximum number of points of each averaged view.
_POINTS = 7_000
# Number of proposals that are aligned at full resolution, and if none of these is likely.
_MAX_REFINED, _MANY_REFINED = 3, 8
# Points of the source that align a pose.
_REFINED_POINTS = 1600
# Weight of the log of the matches in the rank of a pose, relative to that of its surfaces.
_MATCH_RANK = 0.5
# Poses that differ by more resolutions, or rad, are distinct hypotheses.
_DISTINCT, _DISTINCT_RAD = 4.0, 0.0873
# A pose near the guess is preferred to one with a lead below this fraction of the points.
_MIN_LEAD = 0.02
# Support below which the views are also aligned from the guess from coarse to fine.
_MIN_SUPPORT = 1 / 3
# Overlap of a turned pose before its alignment, relative to that of the pose, below which it is no
# rival.
_MIN_TURNED_OVERLAP = 0.5
# Probability below which all proposals are aligned, and evaluated again without free space.
_LIKELY = 0.7
# Points that describe a cloud to find its symmetries, and number of its motions that are aligned.
_SYMMETRY_POINTS, _MAX_SYMMETRIES = 1500, 6
# Cache: a view is registered to several others.
_symmetries: WeakKeyDictionary[Frame, Float64] = WeakKeyDictionary()
# Loss of score by noise when a pose is aligned again.
_MAX_SCORE_LOSS = 0.02
# Points used to test whether a rival converges to the best pose.
_RIVAL_POINTS = 2500
# Ratios of units: powers of ten, an inch and a foot in mm, and a metre in inches; and the largest
# log10 by which the ratio of the extents may differ from one of them.
_UNIT_RATIOS = np.array([1.0, 10.0, 25.4, 1e2, 304.8, 1e3, 1 / 0.0254])
_UNIT_RATIOS = np.concatenate([_UNIT_RATIOS, 1 / _UNIT_RATIOS[1:]])
_MAX_UNIT_LOG = 0.5
# Points of each view that decide whether its unit is wrong.
_UNIT_POINTS = 30_000
# Finest resolution, in spacings of this number of points.
_MIN_SPACING_RATIO, _SPACING_POINTS = 0.5, 5000


@dataclass(frozen=True, eq=False)
class _Pose:
    """A pose T_target_source (4, 4) and its agreement."""

    T_target_source: Float64
    agreement: CloudAgreement
    # Start of its alignment; None for proposals.
    guess: Float64 | None = None
    # MSAC score of the feature matches at the pose.
    matches: float = 0.0

    @property
    def score(self) -> float:
        """Score of the agreement, and of the matches."""
        return self.agreement.score + MATCH_WEIGHT * float(log_matches(self.matches))

    @property
    def rank(self) -> float:
        """Log of the distinct surfaces that coincide, less what contradicts them; and of matches.

        Walls and floors coincide in many poses, however many points are on them.
        """
        surfaces = self.agreement.uncontradicted_surfaces
        return float(np.log1p(surfaces) + _MATCH_RANK * log_matches(self.matches))


# Placeholder for the rival of a pose without one; it has no support.
_NO_RIVAL = _Pose(np.eye(4), CloudAgreement(0.0, 0.0, 0.0, 0.0, np.inf, 0, 0.0))


@dataclass(frozen=True, eq=False)
class _CloudViews:
    """Two clouds averaged to the same resolution.

    Each on a grid of its own: points averaged on parallel grids coincide better where these do, as
    at the identity, or at a quarter turn, than at the right pose of a cloud that was turned.
    """

    source: Frame
    target: Frame
    source_map: CloudMap
    target_map: CloudMap
    rng: np.random.Generator

    @classmethod
    def of(cls, source: Frame, target: Frame, rng: np.random.Generator) -> _CloudViews:
        size = max(_finest(source), _finest(target))
        size, _, model = CoarseToFine(points=_POINTS).finest(source, target, size)
        data = averaged(source, size, turned=True)
        maps = CloudMap.of(data, size, source), CloudMap.of(model, size, target)
        return cls(source, target, *maps, rng)

    @property
    def size(self) -> float:
        return self.target_map.size

    @property
    def has_free_space(self) -> bool:
        """Whether the viewpoint, and so the free space, is known for both views."""
        return self.source_map.viewpoint is not None and self.target_map.viewpoint is not None

    @property
    def has_assumed_viewpoint(self) -> bool:
        """Whether the free space of a view is that of a cloud whose viewpoint was detected."""
        maps = (self.source, self.source_map), (self.target, self.target_map)
        return any(m.viewpoint is not None and isinstance(v, CloudFrame) for v, m in maps)

    def without_free_space(self) -> _CloudViews:
        """Return the views without their viewpoints."""
        source, target = (
            replace(m, viewpoint=None, sphere=None) for m in (self.source_map, self.target_map)
        )
        return replace(self, source_map=source, target_map=target)

    @property
    def coarse_to_fine(self) -> CoarseToFine:
        """ICP with all points, of surfaces seen from the same side if their sides are known."""
        sided = are_oriented(self.source_map, self.target_map)
        return CoarseToFine(rejectors=(icp_parts.SameSide(),) if sided else ())

    @property
    def _refinement_stages(self) -> tuple[Icp, ...]:
        """ICP with few iterations, first with a wide reach, then with a narrow one."""
        sided = self.coarse_to_fine.rejectors
        wide = Icp(
            self.size,
            source=icp_parts.Uniform(_REFINED_POINTS),
            target=icp_parts.All(),
            rejectors=(icp_parts.MaxDistance(4.0), *sided),
            metric=surface_metrics.PointToPlane(loss="tukey"),
            stopping=icp_parts.SmallStep(1e-2, 8),
            neighbours=NEIGHBOURS,
        )
        return wide, replace(
            wide,
            rejectors=(icp_parts.MaxDistance(2.0), *sided),
            stopping=icp_parts.SmallStep(1e-3, 8),
        )

    def evaluated(self, T: Float64) -> _Pose:
        return _Pose(T, cloud_agreement(self.source_map, self.target_map, T))

    def refined(self, T: Float64, *, settled: bool = False) -> _Pose:
        """Align with a subset of the averaged source's points; T (4, 4) if that scores lower.

        Proposals have `settled` already.
        """
        initial = self.evaluated(T)
        try:
            for icp in self._refinement_stages[settled:]:
                T = icp.register(
                    self.source_map.view, self.target_map.view, T, self.rng
                ).T_target_source
        except RegistrationError:
            return initial
        aligned = self.evaluated(T)
        return aligned if aligned.agreement.score >= initial.agreement.score else initial

    def evidence(
        self,
        pose: _Pose,
        lead: float | None = None,
        degenerate: int = 0,
        rivals: Sequence[_Pose] = (),
    ) -> pose_probability.CloudEvidence:
        """Return the evidence for a pose."""
        agreement = pose.agreement
        most = max((_surfaces_of(rival.agreement, agreement) for rival in rivals), default=0.0)
        return pose_probability.CloudEvidence(
            agreement.support,
            agreement.contradiction,
            lead,
            degenerate,
            pose_probability.CLOUDS,
            surface_lead=agreement.surfaces - most,
            near_surfaces=agreement.near_surfaces,
            free_space=self.has_free_space,
        )

    def with_information(self, registration: Registration) -> Registration:
        """Return a registration with its information matrix."""
        T, unobservable = registration.T_target_source, registration.unobservable
        return replace(
            registration,
            information=cloud_information(self.source_map, self.target_map, T, unobservable),
        )

    def are_distinct_poses(self, a: Float64, b: Float64) -> bool:
        """Whether two poses (4, 4) are distinct hypotheses."""
        points = self.source_map.view.points.astype(np.float64)
        limits = {"metres": _DISTINCT * self.size, "rad": _DISTINCT_RAD}
        return bool(are_distinct(a[None], b, points, **limits)[0])


def _finest(view: Frame) -> float:
    """Return a view's point spacing in m, bounded below by that of some thousand points."""
    fraction = min(1.0, _SPACING_POINTS / max(len(view), 1))
    return spacing(view) * max(_MIN_SPACING_RATIO, float(np.sqrt(fraction)))


def register_clouds(
    source: Frame,
    target: Frame,
    guess: Float64 | None,
    rng: np.random.Generator,
    image_registration: Registration | None = None,
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
    image_registration
        Result of the registration as images, if any: an additional proposal.
    always_search
        Whether to search even if the pose aligned from the guess is practically certain.

    Returns
    -------
    The registration. If the views fit only with the source scaled from one unit to another, the
    pose is roughly that of the scaled source, not accepted; `reason` states the scale.

    Raises
    ------
    RegistrationError
        If there are too few points, or no pose has enough correspondences.
    """
    scale = _unit_ratio(source, target)
    if scale != 1 and not always_search:
        registration = _registered_scaled(source, target, scale, rng)
        if registration is not None:
            reason = f"the views fit with the source {scale:.4g} times as large: check its unit"
            remedy = f"the source at that scale (--factor {scale:.9g}; in Python scale=...)"
            # Of the source as it is, any pose is wrong.
            return replace(
                registration, believed=False, probability=0.0, reason=reason, remedy=remedy
            )
    try:
        views = _CloudViews.of(source, target, rng)
        return _registered(views, guess, image_registration, always_search=always_search)
    except RegistrationError as error:
        if scale == 1:
            raise
        ratio = float(f"{extent(source.points) / extent(target.points):.2g}")
        raise RegistrationError(
            f"its extent is about {ratio:g} times that of the target, and it does not fit",
            where=f"frame {source.index}",
            remedy="check the units of both clouds, and scale them to metres",
        ) from error


def _registered(
    views: _CloudViews,
    guess: Float64 | None,
    image_registration: Registration | None = None,
    *,
    always_search: bool = False,
) -> Registration:
    start = np.eye(4) if guess is None else guess
    local = replace(views.refined(start), guess=start)
    certain = None if always_search else _certain(views, local)
    if certain is not None and guess is not None:
        return views.with_information(_given_guess(views, certain))
    poses = [local]
    if image_registration is not None:
        poses.append(views.evaluated(image_registration.T_target_source))
    proposed, found = _proposed(views, start, guessed=guess is not None)
    poses += proposed
    poses += [views.refined(T, settled=True) for T in _others(views, poses, found)]
    registration = views.with_information(_best(views, poses, found, local, guess, certain))
    likely = (registration.probability or 0.0) > _LIKELY
    if registration.believed or likely or not views.has_assumed_viewpoint:
        return registration
    views = views.without_free_space()
    poses = [replace(views.evaluated(p.T_target_source), guess=p.guess) for p in poses]
    other = views.with_information(_best(views, poses, found, poses[0], guess, None))
    if other.believed:  # nothing shows which of the two is wrong: the pose or the viewpoint
        reason = "its free space contradicts it, if a cloud was seen from its origin"
        other = replace(other, believed=False, probability=_LIKELY, reason=reason)
    return max(registration, other, key=lambda found: found.probability or 0.0)


def _others(views: _CloudViews, poses: list[_Pose], found: Proposals | None) -> Sequence[Float64]:
    """Return the proposals to align beside the first.

    That is all of them if none of the poses can be likely, else the strongest rival of the best.
    """
    if found is None:
        return []
    more = list(found.motions[_MAX_REFINED:_MANY_REFINED])
    best, *others = _ranked(poses, found)
    is_rival = partial(views.are_distinct_poses, best.T_target_source)
    known = [pose for pose in others if is_rival(pose.T_target_source)]
    if views.evidence(best, 1.0, rivals=known).probability < _LIKELY:
        return more
    rivals = [views.evaluated(T) for T in more if is_rival(T)]
    rivals.sort(key=lambda rival: -_surfaces_of(rival.agreement, best.agreement))
    return [rival.T_target_source for rival in rivals[:1]]


def _best(
    views: _CloudViews,
    poses: list[_Pose],
    found: Proposals | None,
    local: _Pose,
    guess: Float64 | None,
    certain: Registration | None,
) -> Registration:
    """Return the registration at the best of the poses.

    `local` is the pose reached from the guess, and `certain` the registration there, if it is.
    """
    poses = _ranked(poses, found)
    if guess is None:
        moved = *_turned(views, poses[0]), *_shifted(views, poses[0])
        poses = _ranked([*poses, *moved], found)
    best = poses[0]
    if guess is not None:
        least = best.agreement.score - _MIN_LEAD
        tied = [p for p in poses if p.agreement.score >= least]
        best = min(tied, key=lambda p: _pose_distance(p.T_target_source, guess))
    registration = _registration(views, best, poses)
    if certain is not None and registration.believed:
        T = registration.T_target_source
        if not views.are_distinct_poses(T, certain.T_target_source):
            return certain
    if guess is None or best.guess is not None or not len(registration.unobservable):
        return registration
    # If the poses differ along degenerate directions only, these keep the guess.
    remapping = Remapping.of(
        registration.unobservable, views.source_map.view.points.astype(np.float64)
    )
    across = remapping.across(se3.inverse(local.T_target_source) @ registration.T_target_source)
    if views.are_distinct_poses(local.T_target_source, local.T_target_source @ across):
        return registration
    return _registration(views, local, [best])


def _certain(views: _CloudViews, local: _Pose) -> Registration | None:
    """Return the registration at a pose whose agreement makes it practically certain, or None."""
    if views.evidence(local).probability < pose_probability.CERTAIN:
        return None
    registration = _registration(views, local)
    if (registration.probability or 0.0) < pose_probability.CERTAIN:
        return None
    return None if len(registration.unobservable) else registration


def _unit_ratio(source: Frame, target: Frame) -> float:
    """Return the ratio of units nearest to that of the target's extent to the source's; or 1."""
    source_extent, target_extent = extent(source.points), extent(target.points)
    if source_extent == 0 or target_extent == 0:
        return 1.0
    off = np.abs(np.log10(_UNIT_RATIOS * source_extent / target_extent))
    return float(_UNIT_RATIOS[off.argmin()]) if off.min() <= _MAX_UNIT_LOG else 1.0


def _registered_scaled(
    source: Frame, target: Frame, scale: float, rng: np.random.Generator
) -> Registration | None:
    """Register the scaled source, with few points; None if the result is not accepted."""
    try:
        views = _CloudViews.of(_thinned(source, scale), _thinned(target, 1.0), rng)
        registration = _registered(views, None)
    except RegistrationError:
        return None
    return registration if registration.believed else None


def _thinned(view: Frame, scale: float) -> CloudFrame:
    """Return a view as a scaled cloud of few points."""
    step = -(-len(view) // _UNIT_POINTS)
    return scaled(view, scale).keep(np.arange(len(view)) % step == 0)


def scaled(view: Frame, scale: float) -> CloudFrame:
    """Return the points of a view, scaled about the origin of their coordinates."""
    points = view.points * np.float32(scale)
    return CloudFrame(
        view.index,
        view.timestamp,
        points,
        normals=view.normals if isinstance(view, CloudFrame) else None,
        color=view.color,
        amplitude=view.amplitude,
        origin=scale * view.origin,
        shift=scale * view.shift,
    )


def with_cloud_information(
    source: Frame, target: Frame, registration: Registration, rng: np.random.Generator
) -> Registration:
    """Return a registration of two clouds' images with the information matrix of the clouds.

    Images of clouds have holes, and their noise is unknown. If the clouds are symmetric, the pose
    holds given the guess.
    """
    views = _CloudViews.of(source, target, rng)
    unobservable = cloud_unobservable(
        views.source_map, views.target_map, registration.T_target_source
    )
    registration = replace(registration, unobservable=unobservable, given_guess=False)
    return views.with_information(_given_guess(views, registration))


def follow_clouds(
    source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
) -> Registration:
    """Register two clouds from a guess (4, 4) without a search; see `register_clouds`."""
    views = _CloudViews.of(source, target, rng)
    local = replace(views.refined(guess), guess=guess)
    if views.evidence(local).probability < pose_probability.CERTAIN:
        coarse = views.coarse_to_fine.register(source, target, guess, rng)
        alternative = replace(views.evaluated(coarse.T_target_source), guess=guess)
        local = max(local, alternative, key=lambda pose: pose.agreement.score)
    return views.with_information(replace(_registration(views, local), given_guess=True))


def _proposed(
    views: _CloudViews, start: Float64, *, guessed: bool
) -> tuple[list[_Pose], Proposals | None]:
    """Return the poses of feature matching; without any, or if they don't support more than a
    guess might, also that of coarse-to-fine ICP.

    Raises
    ------
    RegistrationError
        If there is no pose.
    """
    poses, found, failure = [], None, None
    try:
        found = proposals(views.source, views.target, signed=views.has_free_space)
        poses += [views.refined(T, settled=True) for T in found.motions[:_MAX_REFINED]]
    except RegistrationError as error:
        failure = error
    supported = any(pose.agreement.support > _MIN_SUPPORT for pose in poses)
    if supported or (poses and not guessed):
        return poses, found
    try:
        registration = views.coarse_to_fine.register(views.source, views.target, start, views.rng)
        poses.append(replace(views.evaluated(registration.T_target_source), guess=start))
    except RegistrationError as error:
        failure = error
    if not poses and failure is not None:
        raise failure
    return poses, found


def _ranked(poses: list[_Pose], found: Proposals | None) -> list[_Pose]:
    """Return poses with the feature matches that agree with them, the highest rank first."""
    if found is not None:
        matches = found.pair.matches_at(np.array([pose.T_target_source for pose in poses]))
        poses = [replace(p, matches=float(count)) for p, count in zip(poses, matches, strict=True)]
    return sorted(poses, key=lambda pose: -pose.rank)


def _turned(views: _CloudViews, pose: _Pose) -> list[_Pose]:
    """Return a pose after half and quarter turns about the principal axes of the source.

    A symmetric body fits in some of them, also one without distinct features; others are left out.
    """
    points = views.source_map.view.points.astype(np.float64)
    _, axes = np.linalg.eigh(np.cov(points.T))
    turns = [[0.0, 0.0, 0.0, *(angle * axis)] for axis in axes.T for angle in (np.pi / 2, np.pi)]
    centre = points.mean(0)
    turned = [views.evaluated(pose.T_target_source @ se3.about(centre, se3.exp(w))) for w in turns]
    least = _MIN_TURNED_OVERLAP * pose.agreement.overlap
    return [views.refined(p.T_target_source) for p in turned if p.agreement.overlap > least]


def _shifted(views: _CloudViews, pose: _Pose) -> list[_Pose]:
    """Return a pose after the translations at which a repeated structure fits as well."""
    T, distinct_m = pose.T_target_source, _DISTINCT * views.size
    found = shifts(views.source_map, views.target_map, T, distinct_m)
    poses = [views.refined(se3.translation(shift) @ T) for shift in found]
    return [shifted for shifted in poses if _fits_as_well(shifted.agreement, pose.agreement)]


def _fits_as_well(rival: CloudAgreement, agreement: CloudAgreement) -> bool:
    """Whether as large a fraction of the surfaces that are near each other coincides."""
    return rival.coincidence >= agreement.coincidence - _MAX_SCORE_LOSS


def _surfaces_of(rival: CloudAgreement, agreement: CloudAgreement) -> float:
    """Return the surfaces that coincide at a rival pose.

    Where a structure repeats, the clouds fit as well one repetition further, only over less of it.
    That less overlaps is no evidence against that pose: its surfaces are counted as if as many were
    near each other. A fraction of few surfaces may be chance, and is taken for a smaller one. Where
    a smaller fraction coincides, or free space contradicts it beyond doubt, that counts as well.
    """
    is_refuted = rival.violation - agreement.violation > MAX_VIOLATION
    if is_refuted or not _fits_as_well(rival, agreement):
        return rival.uncontradicted_surfaces
    few = pose_probability.FEW_SURFACES
    nearby = min(rival.near_surfaces, agreement.near_surfaces) + few
    return rival.surfaces * (agreement.near_surfaces + few) / nearby


def symmetries(view: Frame) -> Float64:
    """Return motions (k, 4, 4), except the identity, after which a cloud fits itself.

    One half of its points is registered to the other, by features and about its axes.
    """
    if view not in _symmetries:
        _symmetries[view] = _found_symmetries(view)
    return _symmetries[view]


def _found_symmetries(view: Frame) -> Float64:
    odd = np.arange(len(view)) % 2 == 1
    cloud = CloudFrame(view.index, view.timestamp, view.points, origin=view.origin)
    views = _CloudViews.of(cloud.keep(odd), cloud.keep(~odd), np.random.default_rng(0))
    views = views.without_free_space()
    same = views.evaluated(np.eye(4))
    try:
        found = candidates(views.source, views.target, points=_SYMMETRY_POINTS).poses
    except RegistrationError:
        found = ()
    proposals = [
        c.T_target_source
        for c in found
        if views.are_distinct_poses(c.T_target_source, same.T_target_source)
    ]
    poses = [views.refined(T) for T in proposals[:_MAX_SYMMETRIES]] + _turned(views, same)
    fitting = [
        pose.T_target_source
        for pose in poses
        if pose.agreement.support > _MIN_TURNED_OVERLAP * same.agreement.support
        and views.are_distinct_poses(pose.T_target_source, same.T_target_source)
    ]
    return np.array(fitting).reshape(-1, 4, 4)


def _given_guess(views: _CloudViews, registration: Registration) -> Registration:
    """Compare an accepted pose with those that fit nearly as well if a view is symmetric.

    With such a rival it holds given the guess only.
    """
    T = registration.T_target_source
    own = (*(T @ S for S in symmetries(views.source)), *(S @ T for S in symmetries(views.target)))
    views = replace(views, rng=np.random.default_rng(0))
    rivals = [
        pose
        for T_rival in own
        if views.are_distinct_poses((pose := views.refined(T_rival)).T_target_source, T)
    ]
    if not rivals:
        return registration
    rival = max(rivals, key=lambda rival: rival.agreement.score)
    lead = views.evaluated(T).agreement.score - max(rival.agreement.score, 0.0)
    if lead >= pose_probability.MIN_LEAD:
        return registration
    return replace(registration, margin=lead, runner_up=rival.T_target_source, given_guess=True)


def _pose_distance(a: Float64, b: Float64) -> float:
    return float(np.linalg.norm(se3.log(se3.inverse(a) @ b)))


def _rival(views: _CloudViews, poses: Sequence[_Pose], best: _Pose, aligned: _Pose) -> _Pose:
    """Return the first pose distinct from the best one, which was `aligned` with all points.

    With large noise, subsets of the points may converge to different poses, but all points to the
    same one; so rivals that score nearly as high are aligned with more points before.
    """
    averaged = views.source_map.view, views.target_map.view
    for pose in poses:
        start = pose.T_target_source
        if not views.are_distinct_poses(start, best.T_target_source):
            continue
        if aligned.agreement.score - pose.agreement.score >= pose_probability.MIN_LEAD:
            return pose
        try:
            converged = views.coarse_to_fine.approximate_pose(
                views.size, *averaged, start, _RIVAL_POINTS
            )
        except RegistrationError:
            converged = start
        if views.are_distinct_poses(converged, aligned.T_target_source):
            return pose
    return _NO_RIVAL


def _registration(
    views: _CloudViews, best: _Pose, poses: Sequence[_Pose] | None = None
) -> Registration:
    """Align all points from the best pose and evaluate its evidence.

    The rival is one of `poses`, the best first; None if the pose is not compared with others.
    """
    T = best.T_target_source
    averaged = views.source_map.view, views.target_map.view
    registration = views.coarse_to_fine.at(
        views.size, *averaged, T, T if best.guess is None else best.guess
    )
    pose = views.evaluated(registration.T_target_source)
    if pose.agreement.score < best.agreement.score - _MAX_SCORE_LOSS:
        registration = replace(registration, T_target_source=T)
        pose = best
    agreement = pose.agreement
    rival = None if poses is None else _rival(views, poses, best, pose)
    lead = None if rival is None else agreement.score - max(rival.agreement.score, 0.0)
    if lead is not None and len(registration.unobservable):
        lead = min(lead, 0.0)  # poses along these directions fit as well
    rivals = [
        p for p in poses or () if views.are_distinct_poses(p.T_target_source, pose.T_target_source)
    ]
    evidence = views.evidence(pose, lead, len(registration.unobservable), rivals)
    by_score = max(poses or [best], key=lambda p: p.score).T_target_source
    if views.are_distinct_poses(by_score, best.T_target_source):
        evidence = replace(evidence, surface_lead=0.0)  # the measures contradict each other
    runner_up = None if rival is None or rival is _NO_RIVAL else rival.T_target_source
    return evidence.applied(registration, agreement, runner_up)
