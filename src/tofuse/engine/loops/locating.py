"""Where views are in a finished map, without a guess, and the probability that the pose is right.

A view is aligned with the map views of different places that look most similar. From the best of
these alignments, or without one, its pose is searched relative to these map views, until it is
probable, and then in further places for rivals. All poses found compete: each is aligned with the
map views that overlap it, and its probability is that of a search whose rivals are all other poses
found and all alignments elsewhere, reduced by the number of tried places (multiple testing).
Several views of one clip, whose relative poses are known, share this evidence.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tofuse.engine.alignment import covariance, projective
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import one_blas_thread, run_all
from tofuse.engine.geometry import se3, unit_vectors
from tofuse.engine.loops.join_checks import JoinChecks
from tofuse.engine.loops.merged_components import DRIFT, MergedComponents, TrackedComponent, View
from tofuse.engine.quantities import percent
from tofuse.engine.search import (
    DISTINCT_M,
    Search,
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
# Most similar places with which a view is aligned. Of these: places in which the pose of one view
# is searched, further ones for each other view of a clip, and those in which rivals of a probable
# pose are searched, in the range in which views of one place look similar.
_CONSIDERED, _SEARCHED, _PER_VIEW, _RIVALS = 24, 8, 2, 2
_NARROW = SearchOptions(
    "full", turn=0.45, roll=0.25, reach=0.3, full_candidates=12, photometric_candidates=3
)
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
# Displacements along such a direction to where the agreement is best, each at most so many times.
_SLIDES, _MAX_SLIDES = (4.0, -4.0, 2.0, -2.0, 1.0, -1.0), 6
_ALIGNMENT = projective.ProjectiveOptions(levels=verification.PATIENT, prior_m=3.0, prior_rad=3.0)
# Points of each view in the alignments with these places, and in searches for rivals.
_FEW = 800


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

    def carried(self, T_view_other: Float64, free: Float64, depth: float) -> Location:
        """Return the location of another view of the clip, given its relative pose (4, 4).

        Its covariance includes the drift of tracking between views of this depth, m. `free` (k, 6)
        are directions that tracking did not constrain: with any, it is not accepted.
        """
        A = se3.adjoint(se3.inverse(T_view_other))
        shift, angle = se3.lengths(T_view_other) * DRIFT
        sigma = np.repeat([shift + angle * depth, angle + shift / depth], 3)
        rival = self.runner_up
        free = unit_vectors(free)
        drifted = "tracking from the nearest located frame does not constrain all directions"
        return replace(
            self,
            T_map_camera=self.T_map_camera @ T_view_other,
            covariance=A @ self.covariance @ A.T
            + np.diag(sigma**2)
            + _ALIGNMENT.prior_m**2 * free.T @ free,
            unobservable=np.concatenate([self.unobservable @ A.T, free]),
            reason=self.reason or (drifted if len(free) else ""),
            runner_up=None if rival is None else rival @ T_view_other,
        )


@dataclass(frozen=True, eq=False)
class _Place:
    """A view aligned with map view `k` alone: its pose (4, 4), and the score of the agreement."""

    view: View
    k: int
    T_map_view: Float64
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
    def total(self) -> float:
        """Sum of the scores of all compared map views."""
        return sum(a.score for a in self.agreements)

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

    @property
    def contradiction(self) -> float:
        """Contradiction of the view that the map contradicts least."""
        return min(placed.contradiction for placed in self.placed.values())


def _are_distinct(a: dict[int, _Placed], b: dict[int, _Placed]) -> bool:
    """Whether two hypotheses are distinct after their views were aligned, by index."""
    return all(
        are_distinct_poses(a[index].T_map_camera, b[index].T_map_camera) for index in a.keys() & b
    )


def _probability(log_odds: Sequence[float], searched: int) -> float:
    """Return the probability of the best hypothesis after a number of searches."""
    return pose_probability.logistic(max(log_odds) - float(np.log(searched))) if log_odds else 0.0


class Locator:
    """Finds views in a map.

    Parameters
    ----------
    views
        The views of the map, with poses T_map_camera.
    """

    def __init__(self, views: Sequence[View]) -> None:
        self._views = views
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
        self._few_points = replace(self._tolerances, points=_FEW)

    @one_blas_thread()
    def locate(self, views: Sequence[View]) -> dict[int, Location]:
        """Locate views of one clip, whose poses relative to each other are known.

        Returns
        -------
        By the index of each view that overlaps the map at the best pose.
        """
        places = self._places(views)
        aligned = {v.index: [place for place in places if place.view is v] for v in views}
        hypotheses: list[_Hypothesis] = []
        log_odds: list[float] = []
        searched = rivals = 0
        budget = _SEARCHED + _PER_VIEW * (len(views) - 1)
        for place in places:
            best = self._probable(hypotheses, log_odds, searched)
            if best is not None:
                if rivals == _RIVALS:
                    break
                if self._is_near(best.T_map_clip @ place.view.T_component_camera, place.k):
                    continue
                rivals += 1
            elif searched == budget:
                break
            searched += 1
            for found in self._searched(place) if best is None else self._rivals(place):
                aligned[place.view.index].append(found)
                if best is not None and found.score < _MIN_SCORE:
                    continue
                T = found.T_map_view @ se3.inverse(place.view.T_component_camera)
                placed = {v.index: p for v in views if (p := self._placed(v, T)) is not None}
                if placed and all(_are_distinct(placed, h.placed) for h in hypotheses):
                    hypotheses.append(_Hypothesis(T, placed))
            log_odds = [self._log_odds(h, hypotheses, aligned) for h in hypotheses]
        return self._locations(views, hypotheses, log_odds, searched)

    @one_blas_thread()
    def follow(self, view: View, near: Location) -> Location | None:
        """Align a view with the map from a pose nearby; None if it does not fit there.

        `near` is that pose, from other views of its clip.
        """
        T_map_clip = near.T_map_camera @ se3.inverse(view.T_component_camera)
        placed = self._placed(view, T_map_clip)
        if placed is None:
            return None
        hypothesis = _Hypothesis(T_map_clip, {view.index: placed})
        own = _probability([self._log_odds(hypothesis, [hypothesis], {view.index: ()})], 1)
        found = self._location(view, hypothesis, None, min(near.probability, own))
        return replace(found, runner_up=near.runner_up)

    def _probable(
        self, hypotheses: Sequence[_Hypothesis], log_odds: Sequence[float], searched: int
    ) -> _Hypothesis | None:
        """Return the best hypothesis if it is probable, and the map does not contradict it."""
        if _probability(log_odds, searched) < pose_probability.ACCEPTED:
            return None
        best = hypotheses[int(np.argmax(log_odds))]
        return best if best.contradiction <= self._max_contradiction else None

    def _places(self, views: Sequence[View]) -> list[_Place]:
        """Align views with the most similar map views.

        The best alignment is first, and the most similar place of each view if none is good.
        """
        places = []
        for view in views:
            few = pair_agreement.ComparedView.of(view.view, self._few_points)
            similar = self._similar(view.view)
            found = run_all([partial(self._aligned_place, view, few, k) for k in similar])
            places += list(enumerate(found))
        places.sort(key=lambda p: (-max(p[1].score, _MIN_SCORE), p[0]))
        return [place for _, place in places]

    def _aligned_place(self, view: View, few: pair_agreement.ComparedView, k: int) -> _Place:
        """Align a view, `few` of whose points are compared, with map view `k` from its pose."""
        stride = max(1, round(float(np.sqrt(few.view.planar_fraction * few.view.z.size / _FEW))))
        levels = tuple(replace(level, stride=stride) for level in verification.COARSE[:2])
        other, options = self._views[k].view, replace(_ALIGNMENT, levels=levels)
        scale = self._fit_statistics.noise_scale
        target = projective.Target(other)
        aligned = projective.align(few.view, [target], np.eye(4), options, usual_scale=scale)
        target_points = pair_agreement.ComparedView.of(other, self._few_points)
        comparison = pair_agreement.Comparison(few, target_points, self._few_points)
        T = aligned.T_world_source
        return _Place(view, k, self._poses[k] @ T, comparison.at(T).score)

    def _place(self, view: View, k: int, T_map_view: Float64) -> _Place:
        return _Place(view, k, T_map_view, self._agreements(view.view, T_map_view, [k])[k].score)

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
        """Return the changes of view from a pose (4, 4) to map views."""
        return se3.change_of_view(se3.inverse(T) @ self._poses[which], self._depths[which])

    def _is_near(self, T: Float64, k: int) -> bool:
        return bool(self._distances(T, [k])[0] < verification.MAX_OVERLAP_DISTANCE)

    def _searched(self, place: _Place) -> Iterator[_Place]:
        """Yield the best poses of a search relative to the map view of a place."""
        T_map_k = self._poses[place.k]
        registration = register_pair(
            place.view.view,
            self._views[place.k].view,
            se3.inverse(T_map_k) @ place.T_map_view if place.score > _MIN_SCORE else None,
            fit_statistics=self._fit_statistics,
            options=SearchOptions("auto"),
            rival_m=DISTINCT_M,
        )
        if registration is not None:
            for T in (registration.T_target_source, registration.runner_up):
                if T is not None:
                    yield self._place(place.view, place.k, T_map_k @ T)

    def _rivals(self, place: _Place) -> list[_Place]:
        """Return the best poses of a short search, or the alignment if that is good."""
        if place.score > _MIN_SCORE:
            return [place]
        search = Search.of(
            place.view.view,
            self._views[place.k].view,
            _NARROW,
            agreement=self._few_points,
            distinct_m=DISTINCT_M,
        )
        match = None if search is None else search.exhaustive()
        return [
            replace(place, T_map_view=self._poses[place.k] @ c.T_target_source, score=c.score)
            for c in (() if match is None else match.candidates[:2])
        ]

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
        log_odds: Sequence[float],
        searched: int,
    ) -> dict[int, Location]:
        """Return the poses of the most probable hypothesis."""
        if not hypotheses:
            return {}
        best, *others = np.argsort(-np.array(log_odds), kind="stable").tolist()
        rival = hypotheses[others[0]] if others else None
        probability = _probability(log_odds, searched)
        return {
            view.index: self._location(view, hypotheses[best], rival, probability)
            for view in views
            if view.index in hypotheses[best].placed
        }

    def _log_odds(
        self,
        hypothesis: _Hypothesis,
        all_: Sequence[_Hypothesis],
        aligned: Mapping[int, Sequence[_Place]],
    ) -> float:
        """Log odds of a hypothesis; those of views add as far as these are independent."""
        total = 0.0
        counted: list[tuple[Float64, Float64]] = []
        for index, placed in hypothesis.placed.items():
            rivals = [
                h.placed[index].score for h in all_ if h is not hypothesis and index in h.placed
            ]
            rivals += self._scores_elsewhere(placed.T_map_camera, aligned[index])
            lead = placed.score - max([0.0, *rivals])
            for k, agreement in zip(placed.near, placed.agreements, strict=True):
                evidence = pose_probability.PoseEvidence.of(
                    agreement, lead, len(placed.aligned.unobservable)
                )
                p = evidence.probability
                ends = placed.T_map_camera, self._poses[k]
                total += self._independence(ends, counted, k) * float(np.log(p / (1 - p)))
                counted.append(ends)
        return total

    def _scores_elsewhere(self, T_map_view: Float64, places: Sequence[_Place]) -> list[float]:
        """Return the scores of a view's poses in other places than a pose (4, 4)."""
        poses = np.array([place.T_map_view for place in places]).reshape(-1, 4, 4)
        depths = self._depths[[place.k for place in places]]
        change = se3.change_of_view(se3.inverse(T_map_view) @ poses, depths)
        elsewhere = change > verification.MAX_OVERLAP_DISTANCE
        return [p.score for p, other in zip(places, elsewhere, strict=True) if other]

    def _independence(
        self, ends: tuple[Float64, Float64], counted: Sequence[tuple[Float64, Float64]], k: int
    ) -> float:
        """Return how far views are apart from those of other comparisons, 1 without an overlap."""
        if not counted:
            return 1.0
        motions = se3.inverse(np.array(ends)) @ np.array(counted)
        change = se3.change_of_view(motions, self._depths[k])
        apart = change.reshape(-1, 2).max(1).min()
        return min(1.0, float(apart) / verification.MAX_OVERLAP_DISTANCE)

    def _location(
        self, view: View, best: _Hypothesis, rival: _Hypothesis | None, probability: float
    ) -> Location:
        placed = best.placed[view.index]
        if len(placed.aligned.unobservable):
            placed = self._slid(view, placed)
        reasons = []
        if probability < pose_probability.ACCEPTED:
            reasons.append("no pose in the map is probable enough")
        if placed.contradiction > self._max_contradiction:
            reasons.append(f"{percent(placed.contradiction)} of the overlap contradicts the map")
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
            unit_vectors(directions),
            probability,
            "; ".join(reasons),
            None if rival is None else rival.T_map_clip @ view.T_component_camera,
        )

    def _slid(self, view: View, placed: _Placed) -> _Placed:
        """Move a view along degenerate directions to where it agrees best, and align it again."""
        T, best = placed.T_map_camera, placed.total
        for direction, step in itertools.product(placed.aligned.unobservable, _SLIDES):
            for _ in range(_MAX_SLIDES):
                moved = T @ se3.exp(step * direction * projective.UNITS)
                total = self._total(view.view, moved, placed)
                if total <= best:
                    break
                T, best = moved, total
        return self._placed(view, T @ se3.inverse(view.T_component_camera)) or placed

    def _is_distinguished(self, view: PreparedView, placed: _Placed) -> bool:
        """Whether poses displaced along degenerate directions agree less with the map views.

        The errors of the scores add up like independent ones.
        """
        limit = placed.total - _LEAD * len(placed.near) ** 0.5
        return all(
            self._total(
                view,
                placed.T_map_camera @ se3.exp(sign * _PROBE * direction * projective.UNITS),
                placed,
            )
            < limit
            for direction in placed.aligned.unobservable
            for sign in (-1, 1)
        )

    def _total(self, view: PreparedView, T: Float64, placed: _Placed) -> float:
        """Return the total score at a pose (4, 4) instead of that of `placed`."""
        return sum(a.score for a in self._agreements(view, T, placed.near).values())

    def _agreements(
        self, view: PreparedView, T: Float64, which: Sequence[int]
    ) -> dict[int, pair_agreement.Agreement]:
        """Return the agreements of a view at a pose (4, 4) with map views."""
        T_views = se3.inverse(self._poses[list(which)]) @ T
        return {
            k: pair_agreement.agreement(view, self._views[k].view, T_view, self._tolerances)
            for k, T_view in zip(which, T_views, strict=True)
        }
