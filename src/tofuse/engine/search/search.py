"""Exhaustive pose search between two range images with a wide baseline.

Every pose of a coarse grid is scored on a few hundred pixels of both images; the best ones are
refined by two-way projective ICP and ranked by `agreement`. Where both views see the floor, the
grid is yaw and two translations; else it has all six dimensions. The search is deterministic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.search import search_kernels as kernels
from tofuse.engine.search.pair_agreement import Agreement, AgreementOptions, Comparison
from tofuse.engine.search.plane_detection import find_floors
from tofuse.engine.search.search_grid import (
    MIN_POINTS,
    ResampledView,
    SearchOptions,
    full_poses,
    planar_poses,
    refine_poses,
    resampled,
)
from tofuse.engine.views import PreparedView, with_rough_planes

# Many iterations, as the basin of photometric convergence is small; degenerate directions are
# constrained by albedo alone.
_PHOTOMETRIC = projective.ProjectiveOptions(
    levels=(projective.Level(4, 15, 0.03, 0.1), projective.Level(2, 8, 0.005, 0.02)),
    common_tilt=0.0,
    common_slope=0.0,
)
# Pixels of each image that refine a candidate by ICP.
_ICP_POINTS = 700
# Number of best candidates that are refined again down to the noise, at most those that are aligned
# photometrically, and of the pixels used.
_MAX_REFINED, _REFINEMENT_POINTS = 10, 2500
# Maximum score that a candidate may lose in photometric alignment.
_MAX_SCORE_LOSS = 0.05
# Poses that differ by more, m or rad, are distinct hypotheses: beyond the error of a coarse
# alignment (10 cm, 5 degrees).
DISTINCT_M, DISTINCT_RAD = 0.1, 0.0873
# Minimum score of a planar result at which "auto" skips the full search.
_SUFFICIENT_SCORE = 0.4
# Reach of the two-way ICP per iteration, relative to the first.
_REACH_DECAY = 0.85 ** np.arange(28)


def are_distinct_poses(a: Float64, b: Float64, distinct_m: float = DISTINCT_M) -> bool:
    """Whether two poses (4, 4) are distinct hypotheses."""
    return not se3.is_within(se3.inverse(a) @ b, distinct_m, DISTINCT_RAD)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose T_target_source (4, 4) and its agreement."""

    T_target_source: Float64
    agreement: Agreement

    @property
    def score(self) -> float:
        """Support less twice the free-space violation, as a fraction of the points."""
        return self.agreement.score


@dataclass(frozen=True, eq=False)
class Match:
    """Result of a search.

    Attributes
    ----------
    candidates
        Distinct poses, the best first.
    mode
        Kind of search: "full" where the planar one did not suffice.
    """

    candidates: tuple[Candidate, ...]
    mode: Literal["planar", "full"]

    @property
    def T_target_source(self) -> Float64:
        """Best pose (4, 4)."""
        return self.candidates[0].T_target_source

    @property
    def agreement(self) -> Agreement:
        """Agreement of the best pose."""
        return self.candidates[0].agreement

    @property
    def score(self) -> float:
        """Score of the best pose."""
        return self.candidates[0].score

    @property
    def runner_up(self) -> Candidate | None:
        """The second best distinct pose."""
        return self.candidates[1] if len(self.candidates) > 1 else None

    @property
    def margin(self) -> float:
        """Lead of the best pose's score over the runner-up's; small in symmetric scenes."""
        return self.score - (max(self.candidates[1].score, 0.0) if self.runner_up else 0.0)


@dataclass(frozen=True, eq=False)
class Search:
    """Two views prepared for the search.

    Attributes
    ----------
    source, target
        Views, with rough planes where there are no others.
    comparison
        Comparison that evaluates poses.
    distinct_m
        Poses that differ by more are distinct candidates, m.
    """

    source: PreparedView
    target: PreparedView
    comparison: Comparison
    options: SearchOptions
    distinct_m: float
    resampled_source: ResampledView
    resampled_target: ResampledView

    @classmethod
    def of(
        cls,
        source: PreparedView,
        target: PreparedView,
        options: SearchOptions | None = None,
        *,
        agreement: AgreementOptions | None = None,
        distinct_m: float = DISTINCT_M,
    ) -> Search | None:
        """Prepare two views; None if one has too few planes.

        `agreement` evaluates poses; by default its tolerances are for depths of a few metres.
        """
        options = SearchOptions() if options is None else options
        source, target = with_rough_planes(source), with_rough_planes(target)
        s, t = resampled(source), resampled(target)
        if min(len(s.points), len(t.points)) < MIN_POINTS:
            return None
        comparison = Comparison.of(source, target, agreement)
        return cls(source, target, comparison, options, distinct_m, s, t)

    def exhaustive(self) -> Match | None:
        """Search the grids of the mode; None if that is "planar" and a view shows no floor."""
        s, t, options = self.resampled_source, self.resampled_target, self.options
        candidates: list[Candidate] = []
        if options.mode != "full":
            floors = find_floors(self.source, self.target)
            if floors is not None:
                candidates = self._refined(planar_poses(s, t, floors, options))
            sufficient = bool(candidates) and max(c.score for c in candidates) >= _SUFFICIENT_SCORE
            if options.mode == "planar" or (options.mode == "auto" and sufficient):
                return Match(self._ranked(candidates), "planar") if candidates else None
        candidates += self._refined(full_poses(s, t, options))
        return Match(self._ranked(candidates), "full")

    def with_proposals(self, poses: Float64, match: Match) -> Match:
        """Refine further poses T_target_source (N, 4, 4) and rank them among the candidates."""
        if not len(poses):
            return match
        return replace(match, candidates=self._ranked([*match.candidates, *self._refined(poses)]))

    def _refined(self, poses: Float64) -> list[Candidate]:
        """Refine poses (N, 4, 4) by two-way ICP and evaluate them."""
        s, t = self.resampled_source, self.resampled_target
        poses = poses.copy()
        floor = _noise_floor(s, t, self.comparison.options)
        depth = 0.5 * (s.depth + t.depth)
        reaches = np.maximum(0.25 * depth * _REACH_DECAY, 3 * floor)
        refine_poses(s, t, poses, reaches, _ICP_POINTS)
        # Poses that converge to the same one are evaluated once.
        R, x = poses[:, :3, :3].copy(), poses[:, :3, 3].copy()
        evaluated = self._evaluated(poses[kernels.select_distinct(R, x, depth, floor, len(poses))])
        count = min(_MAX_REFINED, self.options.photometric_candidates)
        best = sorted(evaluated, key=lambda candidate: -candidate.score)[:count]
        refined = np.stack([candidate.T_target_source for candidate in best])
        reaches = np.maximum(8 * floor * _REACH_DECAY, 1.3 * floor)
        refine_poses(s, t, refined, reaches, _REFINEMENT_POINTS)
        return evaluated + self._evaluated(refined)

    def _evaluated(self, poses: Sequence[Float64] | Float64) -> list[Candidate]:
        agreements = run_all([partial(self.comparison.at, T) for T in poses])
        return [Candidate(T, agreement) for T, agreement in zip(poses, agreements, strict=True)]

    def _ranked(self, candidates: list[Candidate]) -> tuple[Candidate, ...]:
        """Rank candidates after photometric alignment of the best ones."""
        distinct = _distinct(candidates, self.distinct_m)
        if not (self.source.has_albedo and self.target.has_albedo):
            return distinct
        falloff = distinct[0].agreement.falloff
        source, target = (view.with_falloff(falloff) for view in (self.source, self.target))
        count = self.options.photometric_candidates
        best, remaining = distinct[:count], distinct[count:]
        targets = [projective.Target(target)]
        alignments = run_all(
            [
                partial(projective.align, source, targets, candidate.T_target_source, _PHOTOMETRIC)
                for candidate in best
            ]
        )
        realigned = self._evaluated([aligned.T_world_source for aligned in alignments])
        # Along degenerate directions the geometric score may decrease slightly with photometric
        # alignment.
        kept = [
            after if after.score > before.score - _MAX_SCORE_LOSS else before
            for before, after in zip(best, realigned, strict=True)
        ]
        return _distinct([*kept, *remaining], self.distinct_m)


def _noise_floor(s: ResampledView, t: ResampledView, options: AgreementOptions) -> float:
    """Sensor error tolerance at the depth of the views, m."""
    return options.floor_m + options.floor_fraction * 0.5 * (s.depth + t.depth)


def _distinct(candidates: Sequence[Candidate], distinct_m: float) -> tuple[Candidate, ...]:
    """Return the distinct candidates, the best first."""
    candidates = sorted(candidates, key=lambda candidate: -candidate.score)
    poses = np.array([candidate.T_target_source for candidate in candidates]).reshape(-1, 4, 4)
    # The trace of a rotation decreases with its angle.
    min_trace = 1 + 2 * np.cos(DISTINCT_RAD)
    kept: list[int] = []
    for k, T in enumerate(poses):
        accepted = poses[kept]
        distant = np.linalg.norm(accepted[:, :3, 3] - T[:3, 3], axis=1) > distinct_m
        rotated = (accepted[:, :3, :3] * T[:3, :3]).sum((1, 2)) < min_trace
        if (distant | rotated).all():
            kept.append(k)
    return tuple(candidates[k] for k in kept)
