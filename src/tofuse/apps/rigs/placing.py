"""Placement of a rig's cameras without initial poses: hypotheses from pairs, selected jointly.

Two cameras on different sides of an object overlap little, and a single pair rarely determines
which of many poses is correct. All cameras do: the correct pose of a pair is consistent with the
surfaces and the free space of every other camera. So each pair of views only proposes poses, by an
exhaustive search; hypotheses are extended camera by camera in a beam search, and scored by the
agreement of all pairs at all instants. A camera is placed if no alternative pose has a similar
score.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tofuse.apps.rigs.joint import RigView, refined_poses
from tofuse.engine.alignment import PROBABLE
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import run_all
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
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
from tofuse.engine.stored_views import SampledView
from tofuse.engine.views import PreparedView

# Numbers of instants that are searched, scored and refined; more are better in a dynamic scene.
_SEARCHED, _SCORED, _REFINED = 2, 4, 2
# Proposals per pair; width of the beam, and number of its hypotheses that are refined.
_PROPOSALS, _BEAM, _REFINED_HYPOTHESES = 24, 12, 6
# Number of rivals from which the distribution of margins is estimated; significance level.
_RIVALS, _MAX_CHANCE = 10, 0.01
# Cameras around an object may have any yaw relative to each other; adjacent ones have a large
# overlap, and may be tilted.
_AROUND = SearchOptions(mode="planar", yaw=float(np.pi), reach=1.8, planar_candidates=40)
_SIDE_BY_SIDE = SearchOptions(mode="full")
# Minimum difference between distinct poses, as a fraction of the depth.
_DISTINCT = 0.04
_POINTS = 1500
_OFFSET_SIGMA_M = 1e-4  # depth offsets are not estimated yet


@dataclass(frozen=True, eq=False)
class Placement:
    """Poses of the cameras that can be placed.

    Attributes
    ----------
    poses
        T_first_camera (4, 4) by camera; the identity for the first one.
    reasons
        Why a camera is not placed, by camera.
    """

    poses: dict[int, Float64]
    reasons: dict[int, str]


def place(cameras: Sequence[Sequence[PreparedView | None]]) -> Placement:
    """Estimate the relative poses of static cameras.

    Parameters
    ----------
    cameras
        Views of each camera, one per instant; None where it has none.
    """
    return _Placer(cameras).placement()


# Rows of the agreement of two cameras' views at a pose: means over instants, see `Agreement`.
_SCORE, _SUPPORT, _OVERLAP, _CONTRADICTION = range(4)


@dataclass(frozen=True, eq=False)
class _Hypothesis:
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
        depth = min(1.0, float(np.median(list(self._depth.values()))) if self._depth else 1.0)
        self._distinct_m = min(DISTINCT_M, _DISTINCT * depth)
        default = pair_agreement.AgreementOptions()
        self._agreement = replace(default, floor_m=default.floor_m * depth)
        self._comparisons: dict[tuple[int, int], list[pair_agreement.Comparison]] = {}
        self._proposals: dict[tuple[int, int], Float64] = {}
        self._refinement_views = self._views_to_refine()
        for a, b in itertools.combinations(sorted(self._depth), 2):
            self._search(a, b)

    def _views_to_refine(self) -> list[RigView]:
        instants = range(max(map(len, self._views), default=0))
        full = [m for m in instants if all(self._views[c][m] is not None for c in self._depth)]
        return [
            RigView(c, m, SampledView.of(view, _POINTS))
            for m in evenly_spaced(full or instants, _REFINED)
            for c, views in enumerate(self._views)
            if (view := views[m]) is not None
        ]

    def _search(self, a: int, b: int) -> None:
        """Propose poses of camera b in the frame of a."""
        pairs = [
            (first, second)
            for first, second in zip(self._views[a], self._views[b], strict=True)
            if first is not None
            and second is not None
            and verification.comparable(first.depth, second.depth)
        ]
        self._comparisons[a, b] = [
            pair_agreement.Comparison.of(s, t, self._agreement)
            for t, s in evenly_spaced(pairs, _SCORED)
        ]
        proposals = [self._propose(t, s) for t, s in evenly_spaced(pairs, _SEARCHED)]
        poses = np.concatenate([np.zeros((0, 4, 4)), *proposals])
        scores = np.array([self._agreement_at(a, b, T)[_SCORE] for T in poses])
        order = [k for k in np.argsort(-scores, kind="stable") if scores[k] > 0]
        distinct = list(itertools.islice(self._distinct(poses[order]), _PROPOSALS))
        self._proposals[a, b] = poses[order][distinct]

    def _propose(self, target: PreparedView, source: PreparedView) -> Float64:
        """Return candidate poses T_target_source (N, 4, 4) for a pair of views."""
        registration = register_pair(source, target)
        poses = [] if registration is None else [registration.T_target_source]
        around = Search.of(
            source, target, _AROUND, agreement=self._agreement, distinct_m=self._distinct_m
        )
        for search in (around, Search.of(source, target, _SIDE_BY_SIDE)):
            match = None if search is None else search.exhaustive()
            if match is not None:
                poses += [candidate.T_target_source for candidate in match.candidates]
        return np.array(poses).reshape(-1, 4, 4)

    def _agreement_at(self, a: int, b: int, T_a_b: Float64) -> Float64:
        """Return the mean agreement (4,) over instants at the pose of b in the frame of a."""
        if (a, b) not in self._comparisons:
            a, b, T_a_b = b, a, se3.inverse(T_a_b)
        agreements = [comparison.at(T_a_b) for comparison in self._comparisons[a, b]]
        rows = [(s.score, s.support, s.overlap, s.violation + s.clash) for s in agreements]
        return np.mean(rows, axis=0) if rows else np.zeros(4)

    def _proposed(self, a: int, b: int) -> Float64:
        """Return the proposed poses (N, 4, 4) of b in the frame of a."""
        if a < b:
            return self._proposals[a, b]
        return np.asarray(se3.inverse(self._proposals[b, a]), np.float64)

    def _agreement_with(self, poses: Mapping[int, Float64], camera: int, T: Float64) -> Float64:
        """Return the sums (4,) of a camera's agreement at T (4, 4) with the other placed ones."""
        rows = [
            self._agreement_at(c, camera, se3.inverse(T_first_c) @ T)
            for c, T_first_c in poses.items()
            if c != camera
        ]
        return np.sum([np.zeros(4), *rows], axis=0)

    def _gains(self, jobs: Sequence[tuple[Mapping[int, Float64], int, Float64]]) -> list[float]:
        """Return the scores of cameras at poses (4, 4) against those of placed ones."""
        sums = run_all([partial(self._agreement_with, *job) for job in jobs])
        return [float(row[_SCORE]) for row in sums]

    def _candidates(self, poses: Mapping[int, Float64], camera: int) -> list[Float64]:
        """Return candidate poses of a camera, from its proposals with each placed camera."""
        return [poses[c] @ T for c in poses if c != camera for T in self._proposed(c, camera)]

    def _extend(self, hypotheses: Sequence[_Hypothesis]) -> list[_Hypothesis]:
        """Return hypotheses extended by one camera, the best first."""
        jobs = [
            (hypothesis, camera, T)
            for hypothesis in hypotheses
            for camera in self._depth
            if camera not in hypothesis.poses
            for T in self._candidates(hypothesis.poses, camera)
        ]
        gains = self._gains([(hypothesis.poses, camera, T) for hypothesis, camera, T in jobs])
        extended = [
            _Hypothesis({**hypothesis.poses, camera: T}, hypothesis.score + gain)
            for (hypothesis, camera, T), gain in zip(jobs, gains, strict=True)
            if gain > 0
        ]
        best = self._distinct_hypotheses(extended, _BEAM)
        refined = run_all(
            [partial(self._refine, candidate) for candidate in best[:_REFINED_HYPOTHESES]]
        )
        return self._distinct_hypotheses([*refined, *best[_REFINED_HYPOTHESES:]], _BEAM)

    def _distinct_hypotheses(
        self, hypotheses: Sequence[_Hypothesis], max_count: int
    ) -> list[_Hypothesis]:
        distinct: list[_Hypothesis] = []
        for hypothesis in sorted(hypotheses, key=lambda s: -s.score):
            a = hypothesis.poses
            if len(distinct) < max_count and not any(
                a.keys() == b.keys() and not any(self._differ(a[c], b[c]) for c in a)
                for b in (other.poses for other in distinct)
            ):
                distinct.append(hypothesis)
        return distinct

    def _differ(self, a: Float64, b: Float64) -> bool:
        return are_distinct_poses(a, b, self._distinct_m)

    def _distinct(self, poses: Iterable[Float64], *known: Float64) -> Iterator[int]:
        """Yield the positions of the poses (4, 4) that differ from all earlier and known ones."""
        earlier = list(known)
        for k, T in enumerate(poses):
            if all(self._differ(T, other) for other in earlier):
                earlier.append(T)
                yield k

    def _refine(self, hypothesis: _Hypothesis) -> _Hypothesis:
        """Refine all cameras of a hypothesis jointly, if that improves its score."""
        refined = self._align(hypothesis.poses)
        score = self._score(refined)
        return _Hypothesis(refined, score) if score > hypothesis.score else hypothesis

    def _align(self, poses: Mapping[int, Float64]) -> dict[int, Float64]:
        """Return the jointly refined poses."""
        order = sorted(poses)
        row = {c: k for k, c in enumerate(order)}
        views = [
            replace(v, camera=row[v.camera]) for v in self._refinement_views if v.camera in row
        ]
        refined = refined_poses(views, np.stack([poses[c] for c in order]), _OFFSET_SIGMA_M)
        return dict(zip(order, refined, strict=True))

    def _score(self, poses: Mapping[int, Float64]) -> float:
        return sum(
            self._agreement_at(a, b, se3.inverse(poses[a]) @ poses[b])[_SCORE]
            for a, b in itertools.combinations(sorted(poses), 2)
        )

    def placement(self) -> Placement:
        """Search hypotheses, and keep the unambiguous poses of the best one."""
        best = _Hypothesis({}, 0.0)
        rivals = [_Hypothesis({0: np.eye(4)}, 0.0)] if 0 in self._depth else []
        reasons: dict[int, str] = {}
        extended = rivals
        while extended:
            rivals, best, extended = extended, extended[0], self._extend(extended)
        poses = dict(best.poses)
        while len(poses) > 1:
            assessments = {c: self._pose_probability(poses, c, rivals) for c in poses if c}
            weakest = min(assessments, key=lambda c: assessments[c][0])
            if not assessments[weakest][1]:
                break
            reasons[weakest] = assessments[weakest][1]
            del poses[weakest]
        for c in range(len(self._views)):
            if c not in poses and c not in reasons:
                reasons[c] = "no other camera sees the same"
        return Placement(poses, reasons)

    def _rivals(
        self, poses: Mapping[int, Float64], camera: int, candidates: Sequence[tuple[float, Float64]]
    ) -> Iterator[float]:
        """Yield scores of alternative poses for a camera, descending.

        A pose that converges to the current one is not an alternative.
        """
        ranked = sorted((c for c in candidates if c[0] > 0), key=lambda pair: -pair[0])
        for k in self._distinct([T for _, T in ranked], poses[camera]):
            gain, T = ranked[k]
            refined = self._align({**poses, camera: T})
            if self._differ(poses[camera], refined[camera]):
                yield gain

    def _pose_probability(
        self, poses: Mapping[int, Float64], camera: int, rivals: Sequence[_Hypothesis]
    ) -> tuple[float, str]:
        """Return the probability that a camera's pose is correct, and the reason for a rejection.

        Pairs observe different surfaces, so that support and margin add up over pairs. The
        significance of a margin follows from the rivals: among wrong poses the i-th best exceeds
        the next by an exponentially distributed gap with mean b / i, for any tail of the scores
        (Renyi, 1953; Weissman, 1978).
        """
        others = {c: T for c, T in poses.items() if c != camera}
        agreement = self._agreement_with(others, camera, poses[camera])
        score, total = float(agreement[_SCORE]), self._score(poses)
        alternatives = self._candidates(others, camera)
        gains = self._gains([(others, camera, T) for T in alternatives])
        candidates = list(zip(gains, alternatives, strict=True)) + [
            (score - (total - other.score), other.poses[camera])
            for other in rivals
            if other.poses.keys() == poses.keys()
        ]
        rival_scores = self._rivals({**others, camera: poses[camera]}, camera, candidates)
        rival = next(rival_scores, 0.0)
        evidence = pose_probability.PoseEvidence(
            support=min(float(agreement[_SUPPORT]), 1.0),
            contradiction=float(agreement[_CONTRADICTION] / max(agreement[_OVERLAP], 1e-9)),
            margin=score - rival,
        )
        if evidence.probability >= pose_probability.ACCEPTED:
            return evidence.probability, ""
        # Only now the other rivals: each costs a joint refinement.
        scores = [rival, *itertools.islice(rival_scores, _RIVALS)]
        gaps = -np.diff(scores) * np.arange(2, len(scores) + 1)
        mean_gap = float(gaps.mean()) if len(gaps) else rival
        chance = float(np.exp(-max(score - rival, 0.0) / mean_gap)) if mean_gap > 0 else 0.0
        probability = min(evidence.probability, 1 - chance)
        if evidence.probability < PROBABLE:
            return probability, evidence.rejection_reason()
        if chance > _MAX_CHANCE:
            return probability, (
                f"another pose fits nearly as well, with {percent(max(score - rival, 0.0))} fewer "
                f"of the points: the margin occurs by chance in {percent(chance)} of the cases"
            )
        return 1 - chance, ""
