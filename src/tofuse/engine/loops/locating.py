"""Where views are in a finished map, without a guess, and the probability that the pose is right.

A view is aligned with the map views of different places that look most similar. From the best of
these alignments, or without one, its pose is searched relative to these map views, until it is
probable, and then in further places for rivals. All poses found compete: each is aligned with the
map views that overlap it, and its probability is that of a search whose rivals are all other poses
found and all alignments elsewhere, reduced by the number of tried places (multiple testing).
Several views of one clip, whose relative poses are known, share this evidence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.alignment import covariance, projective
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.loops.join_checks import JoinChecks
from tofuse.engine.loops.merged_components import DRIFT, MergedComponents, TrackedComponent, View
from tofuse.engine.search import (
    DISTINCT_M,
    SearchOptions,
    are_distinct_poses,
    pair_agreement,
    pose_probability,
    register_pair,
    verification,
)
from tofuse.engine.views import PreparedView, view_descriptors

# Largest shift of similar views, as a fraction of the width of their images.
_MAX_SHIFT = 0.5
# Most similar places with which a view is aligned; of these, places in which the pose of one view is
# searched, and further ones for each other view of a clip; and those in which rivals of a probable
# pose are, with less effort.
_CONSIDERED, _SEARCHED, _PER_VIEW, _RIVALS = 16, 8, 2, 2
_LESS_EFFORT = {"planar_candidates": 10, "full_candidates": 20, "photometric_candidates": 5}
# Score below which an alignment says nothing about the pose.
_MIN_SCORE = 0.25
# Candidates and compared map views differ by more: fraction of the depth plus rad.
_SPACING = 0.25
# Map views that a pose is compared with, and their smallest overlap.
_COMPARED, _MIN_OVERLAP = 4, 0.2
# Largest correction of a pose by its alignment: fraction of the depth, and rad.
_MAX_CORRECTION = 0.1
# Displacement along a degenerate direction in cm and degrees, and the loss of score by which the
# agreement distinguishes it.
_PROBE, _LEAD = 4.0, 0.05
_ALIGNMENT = projective.ProjectiveOptions(levels=verification.PATIENT, prior_m=3.0, prior_rad=3.0)
_COARSE_ALIGNMENT = replace(_ALIGNMENT, levels=verification.COARSE)


@dataclass(frozen=True, eq=False)
class Location:
    """The pose of a view in a map.

    Attributes
    ----------
    T_map_camera
        (4, 4).
    covariance
        (6, 6) of its right perturbation relative to the map views at that place, m and rad.
    unobservable
        (k, 6) directions of the right perturbation that they don't constrain.
    probability
        That the pose is right, given all poses that were tried in the map.
    reason
        Why it is not accepted; empty if it is.
    runner_up
        (4, 4) T_map_camera of the best other pose; None if no other one fits at all.
    """

    T_map_camera: Float64
    covariance: Float64
    unobservable: Float64
    probability: float
    reason: str
    runner_up: Float64 | None

    @property
    def accepted(self) -> bool:
        """Whether the pose is accepted."""
        return not self.reason

    def carried(self, T_view_other: Float64, depth: float) -> Location:
        """Return the location of another view of the clip, given its relative pose (4, 4).

        Its covariance includes the drift of tracking between views of this depth, m.
        """
        A = se3.adjoint(se3.inverse(T_view_other))
        shift, angle = se3.lengths(T_view_other[None])[0] * DRIFT
        sigma = np.repeat([shift + angle * depth, angle + shift / depth], 3)
        rival = self.runner_up
        return replace(
            self,
            T_map_camera=self.T_map_camera @ T_view_other,
            covariance=A @ self.covariance @ A.T + np.diag(sigma**2),
            unobservable=self.unobservable @ A.T,
            runner_up=None if rival is None else rival @ T_view_other,
        )


@dataclass(frozen=True, eq=False)
class _Place:
    """A view aligned with map view `k` without a guess: its pose (4, 4), and agreement there."""

    view: View
    k: int
    T_k_view: Float64
    score: float


@dataclass(frozen=True, eq=False)
class _Placed:
    """A view at a pose (4, 4) in the map: its alignment and its agreement with map views."""

    T_map_camera: Float64
    aligned: projective.Aligned
    near: tuple[int, ...]
    agreements: tuple[pair_agreement.Agreement, ...]

    @property
    def score(self) -> float:
        return max(a.score for a in self.agreements)

    @property
    def contradiction(self) -> float:
        """Contradiction of all compared map views together."""
        overlap = sum(a.overlap for a in self.agreements)
        return sum(a.violation + a.clash for a in self.agreements) / max(overlap, 1e-9)


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A pose (4, 4) of a clip in the map, and those of its views that overlap the map there."""

    T_map_clip: Float64
    placed: dict[int, _Placed]


def _are_distinct(a: dict[int, _Placed], b: dict[int, _Placed]) -> bool:
    """Whether two hypotheses are distinct after their views were aligned, by index."""
    return all(
        are_distinct_poses(a[index].T_map_camera, b[index].T_map_camera) for index in a.keys() & b
    )


class Locator:
    """Finds views in a map.

    Parameters
    ----------
    views
        The views of the map, with poses T_map_camera.
    search
        Range and effort of a search.
    """

    def __init__(self, views: Sequence[View], search: SearchOptions | None = None) -> None:
        self._views, self._search = views, search or SearchOptions("auto")
        self._less_effort = replace(self._search, **_LESS_EFFORT)
        self._poses = np.stack([v.T_component_camera for v in views])
        self._depths = np.array([v.depth for v in views])
        self._index = view_descriptors.DescriptorIndex(
            np.stack([view_descriptors.view_descriptor(v.view) for v in views])
        )
        rows, times = np.arange(len(views)), np.arange(len(views), dtype=np.float64)
        checks = JoinChecks(
            MergedComponents([TrackedComponent(0, rows, times, self._poses, tuple(views))])
        )
        self._fit_statistics = checks.fit_statistics
        self._max_contradiction = checks.max_contradiction
        self._tolerances = verification.usual_tolerances(checks.fit_statistics)

    def locate(self, views: Sequence[View]) -> dict[int, Location]:
        """Locate views of one clip, whose poses relative to each other are known.

        Returns
        -------
        By the index of each view that overlaps the map at the best pose.
        """
        places = self._places(views)
        hypotheses: list[_Hypothesis] = []
        best, log_odds = 0, -np.inf
        searched = rivals = 0
        budget = _SEARCHED + _PER_VIEW * (len(views) - 1)
        for place in places:
            is_probable = pose_probability.logistic(log_odds) >= pose_probability.ACCEPTED
            if is_probable:
                if rivals == _RIVALS:
                    break
                T_map_view = hypotheses[best].T_map_clip @ place.view.T_component_camera
                if self._distances(T_map_view, [place.k])[0] < verification.MAX_OVERLAP_DISTANCE:
                    continue
                rivals += 1
            elif searched == budget:
                break
            searched += 1
            for T_map_view in self._searched(place, self._less_effort if is_probable else None):
                T = T_map_view @ se3.inverse(place.view.T_component_camera)
                placed = {v.index: p for v in views if (p := self._placed(v, T)) is not None}
                if placed and all(_are_distinct(placed, h.placed) for h in hypotheses):
                    hypotheses.append(_Hypothesis(T, placed))
            if hypotheses:
                each = [self._log_odds(h, hypotheses, places) for h in hypotheses]
                best = int(np.argmax(each))
                log_odds = each[best] - float(np.log(searched))
        return self._locations(views, hypotheses, places, searched)

    def _places(self, views: Sequence[View]) -> list[_Place]:
        """Align views with the most similar map views; the best alignment first."""
        places = []
        for view in views:
            for rank, k in enumerate(self._similar(view.view)):
                target = [projective.Target(self._views[k].view, np.eye(4))]
                T = projective.align(
                    view.view,
                    target,
                    np.eye(4),
                    _COARSE_ALIGNMENT,
                    usual_scale=self._fit_statistics.noise_scale,
                ).T_world_source
                score = pair_agreement.agreement(
                    view.view, self._views[k].view, T, self._tolerances
                ).score
                places.append((rank, _Place(view, k, T, score)))
        # The most similar place of each view first, where no alignment says more.
        places.sort(key=lambda p: (-max(p[1].score, _MIN_SCORE), p[0]))
        return [place for _, place in places]

    def _similar(self, view: PreparedView) -> list[int]:
        """Return the most similar views of different places, the most similar first."""
        chosen: list[int] = []
        descriptor = view_descriptors.view_descriptor(view)
        for k in self._index.most_similar(descriptor, _MAX_SHIFT).tolist():
            if not verification.comparable(view.depth, self._depths[k]):
                continue
            if not chosen or self._distances(self._poses[k], chosen).min() > _SPACING:
                chosen.append(k)
            if len(chosen) == _CONSIDERED:
                break
        return chosen

    def _distances(self, T: Float64, which: Sequence[int] | slice = slice(None)) -> Float64:
        """Return the distances of map views from a pose: fraction of the depth plus rad."""
        motion = se3.inverse(T) @ self._poses[which]
        shift = np.linalg.norm(motion[:, :3, 3], axis=1) / self._depths[which]
        return np.asarray(shift + np.asarray(se3.angle(motion)), np.float64)

    def _searched(self, place: _Place, options: SearchOptions | None) -> Iterator[Float64]:
        """Yield the best poses T_map_view (4, 4) of a search relative to a map view."""
        registration = register_pair(
            place.view.view,
            self._views[place.k].view,
            place.T_k_view if place.score > _MIN_SCORE else None,
            fit_statistics=self._fit_statistics,
            options=options or self._search,
            rival_m=DISTINCT_M,
        )
        if registration is not None:
            yield self._poses[place.k] @ registration.T_target_source
            if registration.runner_up is not None:
                yield self._poses[place.k] @ registration.runner_up

    def _placed(self, view: View, T_map_clip: Float64) -> _Placed | None:
        """Align a view with the map views near a pose; None if it fits none there."""
        T = T_map_clip @ view.T_component_camera
        distances = self._distances(T)
        near: list[int] = []
        for k in np.argsort(distances, kind="stable").tolist():
            if distances[k] > verification.MAX_OVERLAP_DISTANCE or len(near) == _COMPARED:
                break
            if not near or self._distances(self._poses[k], near).min() > _SPACING:
                near.append(k)
        if not near:
            return None
        targets = self._targets(near)
        aligned = projective.align(
            view.view, targets, T, _ALIGNMENT, usual_scale=self._fit_statistics.noise_scale
        )
        moved = se3.inverse(T) @ aligned.T_world_source
        if not se3.is_within(moved, _MAX_CORRECTION * view.depth, _MAX_CORRECTION):
            return None
        agreements = self._agreements(view.view, aligned.T_world_source, near)
        compared = {k: a for k, a in agreements.items() if a.overlap >= _MIN_OVERLAP}
        if not compared:
            return None
        return _Placed(aligned.T_world_source, aligned, tuple(compared), tuple(compared.values()))

    def _targets(self, which: Sequence[int]) -> list[projective.Target]:
        return [projective.Target(self._views[k].view, se3.inverse(self._poses[k])) for k in which]

    def _locations(
        self,
        views: Sequence[View],
        hypotheses: Sequence[_Hypothesis],
        places: Sequence[_Place],
        searched: int,
    ) -> dict[int, Location]:
        """Return the poses of the most probable hypothesis."""
        if not hypotheses:
            return {}
        log_odds = [self._log_odds(h, hypotheses, places) for h in hypotheses]
        best = int(np.argmax(log_odds))
        probability = pose_probability.logistic(log_odds[best] - float(np.log(searched)))
        rival = max(
            (k for k in range(len(hypotheses)) if k != best), key=log_odds.__getitem__, default=None
        )
        return {
            view.index: self._location(
                view, hypotheses[best], None if rival is None else hypotheses[rival], probability
            )
            for view in views
            if view.index in hypotheses[best].placed
        }

    def _log_odds(
        self, hypothesis: _Hypothesis, all_: Sequence[_Hypothesis], places: Sequence[_Place]
    ) -> float:
        """Log odds of a hypothesis; those of views add as far as these are independent."""
        total = 0.0
        counted: list[tuple[Float64, Float64]] = []
        for index, placed in hypothesis.placed.items():
            rivals = [
                h.placed[index].score for h in all_ if h is not hypothesis and index in h.placed
            ]
            rivals += [
                place.score
                for place in places
                if place.view.index == index and self._is_elsewhere(place, placed.T_map_camera)
            ]
            lead = placed.score - max([0.0, *rivals])
            for k, agreement in zip(placed.near, placed.agreements, strict=True):
                evidence = pose_probability.PoseEvidence.of(
                    agreement, lead, len(placed.aligned.unobservable)
                )
                p = min(evidence.probability, pose_probability.MAX_PROBABILITY)
                ends = placed.T_map_camera, self._poses[k]
                independence = min([1.0, *(self._separation(ends, other, k) for other in counted)])
                total += independence * float(np.log(p / (1 - p)))
                counted.append(ends)
        return total

    def _is_elsewhere(self, place: _Place, T_map_view: Float64) -> bool:
        """Whether the pose of an alignment is in another place than a pose (4, 4)."""
        T = self._poses[place.k] @ place.T_k_view
        shift, angle = se3.lengths((se3.inverse(T) @ T_map_view)[None])[0]
        distance = shift / self._depths[place.k] + angle
        return bool(distance > verification.MAX_OVERLAP_DISTANCE)

    def _separation(self, a: tuple[Float64, Float64], b: tuple[Float64, Float64], k: int) -> float:
        """Return how far the views of two comparisons are apart, 1 where they don't overlap."""
        lengths = [se3.lengths((se3.inverse(p) @ q)[None])[0] for p, q in zip(a, b, strict=True)]
        return float(
            max(m / self._depths[k] + rad for m, rad in lengths) / verification.MAX_OVERLAP_DISTANCE
        )

    def _location(
        self, view: View, best: _Hypothesis, rival: _Hypothesis | None, probability: float
    ) -> Location:
        placed = best.placed[view.index]
        reasons = []
        if probability < pose_probability.ACCEPTED:
            reasons.append("no pose in the map is probable enough")
        if placed.contradiction > self._max_contradiction:
            reasons.append(f"{placed.contradiction:.0%} of the overlap contradicts the map")
        directions = placed.aligned.unobservable * projective.UNITS
        alignment = _ALIGNMENT
        if len(directions):
            if self._is_distinguished(view.view, placed):
                alignment = replace(alignment, prior_m=_PROBE * 0.01, prior_rad=_PROBE * 0.0175)
                directions = directions[:0]
            else:
                reasons.append("the map does not constrain all directions of the pose")
        C = covariance(view.view, self._targets(placed.near), placed.aligned, alignment)
        return Location(
            placed.T_map_camera,
            C,
            directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12),
            probability,
            "; ".join(reasons),
            None if rival is None else rival.T_map_clip @ view.T_component_camera,
        )

    def _is_distinguished(self, view: PreparedView, placed: _Placed) -> bool:
        """Whether poses displaced along degenerate directions agree less with the map views."""

        def score(step: Float64) -> float:
            return max(
                a.score
                for a in self._agreements(view, placed.T_map_camera @ step, placed.near).values()
            )

        return all(
            score(se3.exp(sign * _PROBE * direction * projective.UNITS)) < placed.score - _LEAD
            for direction in placed.aligned.unobservable
            for sign in (-1, 1)
        )

    def _agreements(
        self, view: PreparedView, T: Float64, which: Sequence[int]
    ) -> dict[int, pair_agreement.Agreement]:
        """Return the agreements of a view at a pose (4, 4) with map views."""
        T_views = se3.inverse(self._poses[list(which)]) @ T
        return {
            k: pair_agreement.agreement(view, self._views[k].view, T_view, self._tolerances)
            for k, T_view in zip(which, T_views, strict=True)
        }
