"""Placement of the cameras of a rig without a guess: sets of poses from pairs, selected jointly.

Two cameras that look at an object from two sides overlap little, and a single pair seldom
determines which of many poses is right. All cameras do: the right pose of a pair is consistent with
the surfaces and the free space of every other camera. So each pair of views only proposes poses, by
an exhaustive search; sets are extended camera by camera by a beam search, and scored by the
agreement of all pairs at all instants. A camera is placed if no other place for it has a similar
score.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.kernels.threads import run_all
from tofuse.posegraph.view_store import SampledView
from tofuse.registration.agreement import AgreementOptions, Comparison
from tofuse.registration.base import PROBABLE
from tofuse.registration.pose_probability import ACCEPTED, Evidence
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.search import DISTINCT_M, Search, SearchOptions, differ
from tofuse.registration.verification import comparable
from tofuse.registration.view_pair import register_pair
from tofuse.rigs.joint import JointOptions, View, refined_poses

V = TypeVar("V")

# Numbers of instants that are searched, scored and refined; more of a moving scene are better.
_SEARCHED, _SCORED, _REFINED = 2, 4, 2
# Proposals of each pair; width of the beam, and number of sets in it that are refined.
_PROPOSALS, _BEAM, _POLISHED = 24, 12, 6
# Number of rivals from which the distribution of leads is estimated, and its significance level.
_RIVALS, _CHANCE = 10, 0.01
# Cameras around an object are on opposite sides of it, with any yaw; adjacent ones have large
# overlap, and may be tilted.
_AROUND = SearchOptions(mode="planar", yaw=float(np.pi), reach=1.8, planar_candidates=40)
_SIDE_BY_SIDE = SearchOptions(mode="full")
# Minimum difference of distinct places, as a fraction of the depth.
_DISTINCT = 0.04
_POINTS = 1500
_REFINING = JointOptions(offset_sigma_m=1e-4)


@dataclass(frozen=True, eq=False)
class Placement:
    """Poses of the cameras that can be placed.

    Attributes
    ----------
    poses
        T_first_camera (4, 4) by camera; the first one's is the identity.
    probability
        By camera but the first, placed or not: probability that its pose is correct.
    reasons
        By camera that is not placed: why not.
    """

    poses: dict[int, Float64]
    probability: dict[int, float]
    reasons: dict[int, str]


def place(cameras: Sequence[Sequence[PreparedView | None]]) -> Placement:
    """Estimate the relative poses of static cameras.

    Parameters
    ----------
    cameras
        For each camera its views, one for each instant, None where it has none.
    """
    return _Placer(cameras).placement()


@dataclass(frozen=True)
class _PairAgreement:
    """Agreement of the views of two cameras at a pose: means over instants, see `Agreement`."""

    score: float = 0.0
    support: float = 0.0
    overlap: float = 0.0
    against: float = 0.0


@dataclass(frozen=True, eq=False)
class _Set:
    """Poses T_first_camera of some cameras, and the score of all their pairs."""

    poses: dict[int, Float64]
    score: float


class _Placer:
    def __init__(self, cameras: Sequence[Sequence[PreparedView | None]]) -> None:
        self._views = cameras
        self._depth = {
            c: float(np.median([v.depth for v in views if v is not None]))
            for c, views in enumerate(cameras)
            if any(v is not None for v in views)
        }
        typical = min(1.0, float(np.median(list(self._depth.values()))) if self._depth else 1.0)
        self._distinct_m = min(DISTINCT_M, _DISTINCT * typical)
        usual = AgreementOptions()
        self._agreement = replace(usual, floor_m=usual.floor_m * typical)
        self._compared: dict[tuple[int, int], list[Comparison]] = {}
        self._proposals: dict[tuple[int, int], Float64] = {}
        self._kept = self._views_to_refine()
        for a, b in itertools.combinations(sorted(self._depth), 2):
            self._search(a, b)

    def _views_to_refine(self) -> list[View]:
        instants = range(max(map(len, self._views), default=0))
        full = [m for m in instants if all(self._views[c][m] is not None for c in self._depth)]
        some = _evenly(full or list(instants), _REFINED)
        return [
            View(c, m, SampledView.of(view, _POINTS))
            for m in some
            for c, views in enumerate(self._views)
            if (view := views[m]) is not None
        ]

    def _search(self, a: int, b: int) -> None:
        """Propose poses of camera b in the frame of a."""
        both = [
            (first, second)
            for first, second in zip(self._views[a], self._views[b], strict=True)
            if first is not None and second is not None and comparable(first.depth, second.depth)
        ]
        self._compared[a, b] = [
            Comparison.of(s, t, self._agreement) for t, s in _evenly(both, _SCORED)
        ]
        found = [self._found(t, s) for t, s in _evenly(both, _SEARCHED)]
        poses = np.concatenate([np.zeros((0, 4, 4)), *found])
        scores = np.array([self._at(a, b, T).score for T in poses])
        kept: list[Float64] = []
        for k in np.argsort(-scores, kind="stable"):
            if scores[k] > 0 and self._is_distinct(poses[k], kept):
                kept.append(poses[k])
        self._proposals[a, b] = np.array(kept[:_PROPOSALS]).reshape(-1, 4, 4)

    def _found(self, target: PreparedView, source: PreparedView) -> Float64:
        """Return the poses T_target_source (N, 4, 4) that a pair of views proposes."""
        near = register_pair(source, target)
        poses = [] if near is None else [near.T_target_source]
        around = Search.of(
            source, target, _AROUND, agreement=self._agreement, distinct_m=self._distinct_m
        )
        for search in (around, Search.of(source, target, _SIDE_BY_SIDE)):
            match = None if search is None else search.exhaustive()
            if match is not None:
                poses += [candidate.T_target_source for candidate in match.candidates]
        return np.array(poses).reshape(-1, 4, 4)

    def _at(self, a: int, b: int, T_a_b: Float64) -> _PairAgreement:
        """Return the mean agreement over instants at the pose of b in the frame of a."""
        if (a, b) not in self._compared:
            a, b, T_a_b = b, a, se3.inverse(T_a_b)
        agreements = [compared.at(T_a_b) for compared in self._compared[a, b]]
        if not agreements:
            return _PairAgreement()
        rows = [(s.score, s.support, s.overlap, s.violation + s.clash) for s in agreements]
        return _PairAgreement(*(float(mean) for mean in np.mean(rows, axis=0)))

    def _proposed(self, a: int, b: int) -> Float64:
        """Return the proposed poses (N, 4, 4) of b in the frame of a."""
        if a < b:
            return self._proposals[a, b]
        return np.asarray(se3.inverse(self._proposals[b, a]), np.float64)

    def _gain(self, poses: Mapping[int, Float64], camera: int, T: Float64) -> float:
        """Return the score of a camera at T (4, 4) against the placed ones."""
        return sum(
            self._at(c, camera, se3.inverse(at) @ T).score for c, at in poses.items() if c != camera
        )

    def _places(self, poses: Mapping[int, Float64], camera: int) -> list[Float64]:
        """Return candidate poses of a camera, from its proposals with each placed one."""
        return [poses[c] @ T for c in poses if c != camera for T in self._proposed(c, camera)]

    def _extended(self, sets: Sequence[_Set]) -> list[_Set]:
        """Return sets extended by one camera, the best first."""
        jobs = [
            (known, camera, T)
            for known in sets
            for camera in self._depth
            if camera not in known.poses
            for T in self._places(known.poses, camera)
        ]
        gains = run_all([partial(self._gain, known.poses, camera, T) for known, camera, T in jobs])
        extended = [
            _Set({**known.poses, camera: T}, known.score + gain)
            for (known, camera, T), gain in zip(jobs, gains, strict=True)
            if gain > 0
        ]
        best = self._distinct(extended, _BEAM)
        refined = run_all([partial(self._refined, one) for one in best[:_POLISHED]])
        return self._distinct([*refined, *best[_POLISHED:]], _BEAM)

    def _distinct(self, sets: Sequence[_Set], max_sets: int) -> list[_Set]:
        kept: list[_Set] = []
        for one in sorted(sets, key=lambda s: -s.score):
            if all(self._differ(one.poses, other.poses) for other in kept):
                kept.append(one)
                if len(kept) == max_sets:
                    break
        return kept

    def _differ(self, a: Mapping[int, Float64], b: Mapping[int, Float64]) -> bool:
        return a.keys() != b.keys() or any(differ(a[c], b[c], self._distinct_m) for c in a)

    def _is_distinct(self, T: Float64, others: Sequence[Float64]) -> bool:
        """Whether a pose (4, 4) differs from all others."""
        return all(differ(T, other, self._distinct_m) for other in others)

    def _refined(self, one: _Set) -> _Set:
        """Refine all cameras of a set jointly, if that improves its score."""
        refined = self._aligned(one.poses)
        score = self._score(refined)
        return _Set(refined, score) if score > one.score else one

    def _aligned(self, poses: Mapping[int, Float64]) -> dict[int, Float64]:
        """Return the jointly refined poses."""
        order = sorted(poses)
        row = {c: k for k, c in enumerate(order)}
        views = [replace(v, camera=row[v.camera]) for v in self._kept if v.camera in row]
        moved = refined_poses(views, np.stack([poses[c] for c in order]), _REFINING)
        return dict(zip(order, moved, strict=True))

    def _score(self, poses: Mapping[int, Float64]) -> float:
        return sum(
            self._at(a, b, se3.inverse(poses[a]) @ poses[b]).score
            for a, b in itertools.combinations(sorted(poses), 2)
        )

    def placement(self) -> Placement:
        """Search sets of poses, and keep the unambiguous poses of the best one."""
        sets = [_Set({0: np.eye(4)}, 0.0)] if 0 in self._depth else []
        probability: dict[int, float] = {}
        reasons: dict[int, str] = {}
        rivals: list[_Set] = sets
        while sets:
            rivals, sets = sets, self._extended(sets)
        best = rivals[0] if rivals else _Set({}, 0.0)
        poses = dict(best.poses)
        while len(poses) > 1:
            found = {c: self._pose_probability(poses, c, rivals) for c in poses if c}
            probability.update({c: belief for c, (belief, _) in found.items()})
            weakest = min(found, key=lambda c: found[c][0])
            if not found[weakest][1]:
                break
            reasons[weakest] = found[weakest][1]
            del poses[weakest]
        for c in range(len(self._views)):
            if c not in poses and c not in reasons:
                reasons[c] = "no other camera sees the same"
        return Placement(poses, probability, reasons)

    def _rivals(
        self, poses: Mapping[int, Float64], camera: int, found: Sequence[tuple[float, Float64]]
    ) -> list[float]:
        """Return scores of other places for a camera, descending.

        A place that converges to the present one is not another place.
        """
        at = poses[camera]
        apart: list[Float64] = [at]
        scores: list[float] = []
        for gain, T in sorted(found, key=lambda pair: -pair[0]):
            if len(scores) > _RIVALS or gain <= 0:
                break
            if not self._is_distinct(T, apart):
                continue
            apart.append(T)
            moved = self._aligned({**poses, camera: T})
            if differ(at, moved[camera], self._distinct_m):
                scores.append(gain)
        return scores

    def _pose_probability(
        self, poses: Mapping[int, Float64], camera: int, rivals: Sequence[_Set]
    ) -> tuple[float, str]:
        """Return the probability that a camera's pose is correct, and why it is rejected, if it is.

        Pairs see different surfaces, so that support and lead add up over pairs. The significance
        of a lead follows from the rivals: among wrong places the i-th best leads the next by an
        exponentially distributed gap with mean b / i, for any tail of the scores (Renyi, 1953;
        Weissman, 1978).
        """
        others = {c: T for c, T in poses.items() if c != camera}
        at = poses[camera]
        comparisons = [self._at(c, camera, se3.inverse(T) @ at) for c, T in others.items()]
        score = sum(s.score for s in comparisons)
        elsewhere = self._places(others, camera)
        gains = run_all([partial(self._gain, others, camera, T) for T in elsewhere])
        total = self._score(poses)
        found = list(zip(gains, elsewhere, strict=True)) + [
            (score - (total - other.score), other.poses[camera])
            for other in rivals
            if other.poses.keys() == poses.keys()
        ]
        scores = self._rivals({**others, camera: at}, camera, found)
        rival = scores[0] if scores else 0.0
        overlap = max(sum(s.overlap for s in comparisons), 1e-9)
        evidence = Evidence(
            support=min(sum(s.support for s in comparisons), 1.0),
            contradiction=sum(s.against for s in comparisons) / overlap,
            margin=score - rival,
        )
        gaps = -np.diff(scores[: _RIVALS + 1]) * np.arange(2, len(scores[: _RIVALS + 1]) + 1)
        usual = float(gaps.mean()) if len(gaps) else rival
        chance = float(np.exp(-max(score - rival, 0.0) / usual)) if usual > 0 else 0.0
        probability = min(evidence.probability, 1 - chance)
        if evidence.probability >= ACCEPTED:
            return evidence.probability, ""
        if evidence.probability < PROBABLE:
            return probability, evidence.rejection_reason()
        if chance > _CHANCE:
            return probability, (
                f"another pose fits nearly as well, with {max(score - rival, 0.0):.1%} fewer of "
                f"the points: the margin occurs by chance in {chance:.0%} of the cases"
            )
        return 1 - chance, ""


def _evenly(items: Sequence[V], count: int) -> list[V]:
    """Return at most `count` of the items, evenly spaced."""
    if len(items) <= count:
        return list(items)
    at = np.linspace(0, len(items) - 1, count).round().astype(int)
    return [items[k] for k in at]
