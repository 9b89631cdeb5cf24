"""Exhaustive pose search between two range images with a wide baseline.

Every pose of a coarse grid is scored on some hundred pixels of both images; the best ones are
refined by two-way projective ICP and ranked by `agreement`. Where both views see the floor, the
grid is yaw and two translations; else it has all six dimensions. The search is deterministic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

import cv2
import numpy as np

from tofuse.arrays import Bool, Float32, Float64, Intp
from tofuse.bounds import Bounded, Bounds
from tofuse.geometry import se3
from tofuse.kernels import search as kernels
from tofuse.kernels.threads import run_all, run_chunks
from tofuse.registration.agreement import (
    Agreement,
    AgreementOptions,
    Comparison,
    nearest_depth,
)
from tofuse.registration.floor import Floor, find_floors
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Level, ProjectiveOptions, Target, align
from tofuse.registration.rough import with_rough_planes
from tofuse.registration.view_points import sampled_points

Mode = Literal["auto", "both", "planar", "full"]

# Many iterations, as the basin of photometric convergence is small; degenerate directions are
# constrained by albedo alone.
_PHOTOMETRIC = ProjectiveOptions(
    levels=(Level(4, 15, 0.03, 0.1), Level(2, 8, 0.005, 0.02)), common_tilt=0.0, common_slope=0.0
)
# Number of best candidates that are refined again down to the noise, and of the pixels used.
_POLISHED, _POLISH_POINTS = 10, 2500
# Maximum score that a candidate may lose in photometric alignment.
_GIVEN_UP = 0.05
# Poses that differ by more, m or rad, are distinct hypotheses: beyond the error of a coarse
# alignment (10 cm, 5 degrees).
DISTINCT_M, DISTINCT_RAD = 0.1, 0.0873
# Steps of the two grids: rad, and as a fraction of the depth. Projective ICP converges from
# neighbouring poses of either; six dimensions allow only a coarser one.
_PLANAR_ANGLE, _PLANAR_STEP = 0.07, 0.06
_FULL_ANGLE, _FULL_STEP = 0.13, 0.1
# Pixels of each image that score a pose of the grids, and that refine a candidate by ICP.
_PLANAR_POINTS, _FULL_POINTS, _ICP_POINTS = 200, 150, 700
# Minimum score of a planar result at which "auto" skips the full search.
_CONVINCING = 0.4
# Sigma of the albedo's low-pass filter for the coarse grid, in the plane z = 1, and difference in
# log albedo at which a point counts neither for nor against a pose.
_BLUR, _ALBEDO = 0.04, 0.12
_NO_BORDER = cv2.BORDER_CONSTANT
# Nodes of the lookup grid of an image, along its wider side.
_GRID = 128
# Minimum number of points of a view.
_MIN_POINTS = 50
# Points of a view from which the search draws its subsets.
_SEEN = 3000
# The whole grid is scored on a sixth of the points; the best poses, this many times the number of
# candidates, on all.
_COARSE_DIVISOR, _KEPT = 6, 200
# In six dimensions the centres of cells of eight translations are scored first, with the reach
# multiplied by the first number; the best fraction of the cells is then scored in full.
_WIDER, _PROMISING = 1.5, 0.1
_CHUNKS = 16
# Reach of the two-way ICP per iteration, relative to the first.
_NARROWER = 0.85 ** np.arange(28)


@dataclass(frozen=True)
class SearchOptions(Bounded):
    """Range and effort of the search.

    Attributes
    ----------
    mode
        "planar" (yaw, and translation along the floor), "full" (six dimensions), "both" (planar
        where both views see a floor, and full: slow, but the margin counts all rivals), or "auto"
        (full only if there is no floor, or the planar result scores low).
    yaw
        Maximum rotation about the vertical in the planar search, rad.
    turn, roll
        Maximum rotation in the full search, and about the optical axis, rad.
    reach
        Maximum translation, as a fraction of the depth of the views (the mean of their medians).
    planar_candidates, full_candidates
        Number of best poses of the planar and of the full grid that are refined by ICP.
    photometric_candidates
        Number of best candidates with photometric alignment, where both views have albedo.
    """

    mode: Mode = "both"
    yaw: Annotated[float, Bounds(0, 3.1416)] = 1.1
    turn: Annotated[float, Bounds(0, 3.1416)] = 0.9
    roll: Annotated[float, Bounds(0, 3.1416)] = 0.5
    reach: Annotated[float, Bounds(0, 10)] = 0.6
    planar_candidates: Annotated[int, Bounds(1, 1_000_000)] = 20
    full_candidates: Annotated[int, Bounds(1, 1_000_000)] = 60
    photometric_candidates: Annotated[int, Bounds(1, 1_000_000)] = 30


def differ(a: Float64, b: Float64, distinct_m: float = DISTINCT_M) -> bool:
    """Whether two poses (4, 4) are distinct hypotheses."""
    between = se3.inverse(a) @ b
    return bool(np.linalg.norm(between[:3, 3]) > distinct_m or se3.angle(between) > DISTINCT_RAD)


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
class _View:
    """A view resampled to a pinhole grid, with a subset of its points."""

    grid: Float32
    frame: Float64
    points: Float32
    normals: Float32
    albedo: Float32
    depth: float

    def some(self, count: int, less: Bool | None = None) -> kernels.Resampled:
        """Subset of `count` points with the grid, one in four of those marked `less`."""
        keep = np.arange(len(self.points))
        if less is not None:
            keep = np.concatenate([keep[~less], keep[less][::4]])
        keep = keep[np.linspace(0, len(keep) - 1, min(count, len(keep))).round().astype(int)]
        points = self.points[keep], self.normals[keep], self.albedo[keep]
        return kernels.Resampled(*points, self.grid, self.frame)


def search(
    source: PreparedView,
    target: PreparedView,
    options: SearchOptions | None = None,
    *,
    gravity: tuple[Float64, Float64] | None = None,
) -> Match | None:
    """Search the pose between two views with a wide baseline.

    Parameters
    ----------
    source, target
        Prepared views.
    gravity
        (3,) direction of gravity in the source's and in the target's frame, if known.

    Returns
    -------
    Match or None
        None if a view has too few planes.
    """
    prepared = Search.of(source, target, options)
    return None if prepared is None else prepared.everywhere(gravity)


@dataclass(frozen=True, eq=False)
class Search:
    """Two views prepared for the search.

    Attributes
    ----------
    source, target
        Views, with rough planes where there are no others.
    compared
        Comparison that evaluates poses.
    distinct_m
        Poses that differ by more are distinct candidates, m.
    """

    source: PreparedView
    target: PreparedView
    compared: Comparison
    options: SearchOptions
    distinct_m: float
    s: _View
    t: _View

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

        `agreement` evaluates poses; the tolerances are those of views some metres deep unless
        given.
        """
        options = SearchOptions() if options is None else options
        source, target = with_rough_planes(source), with_rough_planes(target)
        s, t = _prepare(source), _prepare(target)
        if min(len(s.points), len(t.points)) < _MIN_POINTS:
            return None
        compared = Comparison.of(source, target, agreement)
        return cls(source, target, compared, options, distinct_m, s, t)

    def everywhere(self, gravity: tuple[Float64, Float64] | None = None) -> Match | None:
        """Search the whole grid; see `search`."""
        s, t, options = self.s, self.t, self.options
        found: list[Candidate] = []
        if options.mode != "full":
            floors = find_floors((self.source, self.target), gravity)
            if floors is not None:
                found = self._refined(_planar(s, t, floors[0], floors[1], options))
            convinced = bool(found) and max(c.score for c in found) >= _CONVINCING
            if options.mode == "planar" or (options.mode == "auto" and convinced):
                return Match(self._ordered(found), "planar") if found else None
        found += self._refined(_full(s, t, options))
        return Match(self._ordered(found), "full")

    def among(self, poses: Float64, match: Match) -> Match:
        """Refine further poses T_target_source (N, 4, 4) and rank them among the candidates."""
        if not len(poses):
            return match
        return replace(match, candidates=self._ordered([*match.candidates, *self._refined(poses)]))

    def _refined(self, poses: Float64) -> list[Candidate]:
        """Refine poses (N, 4, 4) by two-way ICP and evaluate them."""
        s, t, options = self.s, self.t, self.compared.options
        poses = poses.copy()
        floor = _noise_floor(s, t, options)
        depth = 0.5 * (s.depth + t.depth)
        reaches = np.maximum(0.25 * depth * _NARROWER, 3 * floor)
        _refine(s, t, poses, reaches, _ICP_POINTS, options.max_angle)
        # Many converge to the same pose, which is evaluated once.
        R, x = poses[:, :3, :3].copy(), poses[:, :3, 3].copy()
        judged = self._evaluated(poses[kernels.select_distinct(R, x, depth, floor, len(poses))])
        best = sorted(judged, key=lambda candidate: -candidate.score)[:_POLISHED]
        finer = np.stack([candidate.T_target_source for candidate in best])
        reaches = np.maximum(8 * floor * _NARROWER, 1.3 * floor)
        _refine(s, t, finer, reaches, _POLISH_POINTS, options.max_angle)
        return judged + self._evaluated(finer)

    def _evaluated(self, poses: Sequence[Float64] | Float64) -> list[Candidate]:
        agreements = run_all([partial(self.compared.at, T) for T in poses])
        return [Candidate(T, agreement) for T, agreement in zip(poses, agreements, strict=True)]

    def _ordered(self, found: list[Candidate]) -> tuple[Candidate, ...]:
        """Rank candidates after photometric alignment of the best ones."""
        distinct = _distinct(found, self.distinct_m)
        if not (self.source.has_albedo and self.target.has_albedo):
            return distinct
        falloff = distinct[0].agreement.falloff
        source, target = (view.with_falloff(falloff) for view in (self.source, self.target))
        count = self.options.photometric_candidates
        best, rest = distinct[:count], distinct[count:]
        targets = [Target(target, np.eye(4))]
        moved = run_all(
            [
                partial(align, source, targets, candidate.T_target_source, _PHOTOMETRIC)
                for candidate in best
            ]
        )
        placed = self._evaluated([aligned.T_world_source for aligned in moved])
        # Along degenerate directions the geometric score may decrease slightly with photometric
        # alignment.
        kept = [
            new if new.score > old.score - _GIVEN_UP else old
            for old, new in zip(best, placed, strict=True)
        ]
        return _distinct([*kept, *rest], self.distinct_m)


def _prepare(view: PreparedView) -> _View:
    """Resample a view to a pinhole grid."""
    rays = view.rays[view.planes[..., 3] > 0]
    if len(rays) < _MIN_POINTS:
        nothing = np.zeros((0, 3), np.float32)
        none = np.zeros((1, 1, 5), np.float32)
        return _View(none, np.ones(4), nothing, nothing, nothing[:, 0], 1.0)
    rays = view.rays[view.z > 0]
    low, high = rays.min(0).astype(float), rays.max(0).astype(float)
    spacing = max(float((high - low).max()) / _GRID, 1e-6)
    x, y = (np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True))
    x0, y0, per_x, per_y = view.projection.frame
    lookup = view.projection.lookup
    fu = np.clip((x - x0) * per_x, 0, lookup.shape[1] - 1.001)[None, :]
    fv = np.clip((y - y0) * per_y, 0, lookup.shape[0] - 1.001)[:, None]
    i, j = fv.astype(int), fu.astype(int)
    au, av = (fu - j)[..., None], (fv - i)[..., None]
    pixel = (1 - av) * ((1 - au) * lookup[i, j] + au * lookup[i, j + 1]) + av * (
        (1 - au) * lookup[i + 1, j] + au * lookup[i + 1, j + 1]
    )
    rows, columns = view.z.shape
    pixel = np.rint(pixel)
    inside = (pixel >= 0).all(-1) & (pixel[..., 0] < columns) & (pixel[..., 1] < rows)
    u, v = np.where(inside[..., None], pixel, 0).astype(int).transpose(2, 0, 1)
    abc = view.planes[v, u, :3].astype(float)
    known = inside & (view.planes[v, u, 3] > 0)
    length = np.maximum(np.sqrt((abc * abc).sum(-1)), 1e-12)
    grid = np.where(known[..., None], np.dstack([abc / length[..., None], 1 / length]), 0)
    grid[..., 3] -= np.where(inside & ~known, nearest_depth(view)[v, u], 0)
    seen = sampled_points(view, _SEEN)
    albedo = _low_pass(np.where(known, view.albedo[v, u, 0], np.nan), _BLUR / spacing)
    at = seen.points[:, :2] / seen.points[:, 2:] - (x[0], y[0])
    j, i = (at / spacing).round().astype(int).T
    i, j = np.clip(i, 0, len(y) - 1), np.clip(j, 0, len(x) - 1)
    return _View(
        np.dstack([grid, albedo]).astype(np.float32),
        np.array([x[0], y[0], 1 / spacing, 1 / spacing]),
        seen.points,
        seen.normals,
        albedo[i, j],
        float(np.median(seen.points[:, 2])),
    )


def _low_pass(albedo: Float64, sigma: float) -> Float32:
    """Low-pass filter an image (H, W), ignoring NaN, to match the step of the coarse grid."""
    known = np.isfinite(albedo)
    size = (0, 0)
    total = cv2.GaussianBlur(np.where(known, albedo, 0), size, sigma, borderType=_NO_BORDER)
    density = cv2.GaussianBlur(known.astype(float), size, sigma, borderType=_NO_BORDER)
    mean = total / np.maximum(density, 1e-9)
    return np.where(known, mean, np.nan).astype(np.float32)


def _planar(s: _View, t: _View, floor_s: Floor, floor_t: Floor, options: SearchOptions) -> Float64:
    """Return the best poses (N, 4, 4) of the planar grid."""
    depth = 0.5 * (s.depth + t.depth)
    to_s, to_t = _upright(floor_s.normal), _upright(floor_t.normal)
    n = round(options.yaw / _PLANAR_ANGLE)
    yaws = np.zeros((2 * n + 1, 3))
    yaws[:, 1] = np.linspace(-n, n, 2 * n + 1) * _PLANAR_ANGLE
    rotations = to_t.T @ se3.so3_exp(yaws) @ to_s
    moves = _ball(_PLANAR_STEP * depth, options.reach * depth, (1.0, 0.0, 1.0))
    moves[:, 1] = floor_t.height - floor_s.height
    less = [
        np.abs(v.points @ f.normal - f.height) < 0.02 + 0.02 * v.points[:, 2]
        for v, f in ((s, floor_s), (t, floor_t))
    ]
    step = depth * max(_PLANAR_STEP, _PLANAR_ANGLE)
    return _best(
        _Scorer(s, t, less, step),
        rotations,
        moves @ to_t,
        _PLANAR_POINTS,
        options.planar_candidates,
    )


def _full(s: _View, t: _View, options: SearchOptions) -> Float64:
    """Return the best poses (N, 4, 4) of the grid of six dimensions."""
    depth = 0.5 * (s.depth + t.depth)
    flat = options.roll / options.turn if options.turn else 1.0
    rotations = se3.so3_exp(_ball(_FULL_ANGLE, options.turn, (1.0, 1.0, flat)))
    moves = _ball(_FULL_STEP * depth, options.reach * depth, (1.0, 1.0, 1.0))
    step = depth * max(_FULL_STEP, _FULL_ANGLE)
    scorer = _Scorer(s, t, [None, None], step)
    turns, shifts = _promising(scorer, rotations, moves, _FULL_STEP * depth, options)
    few = max(1, _FULL_POINTS // _COARSE_DIVISOR)
    scores = scorer(rotations[turns], moves[shifts][:, None], few)[:, 0]
    top = _highest(scores, _KEPT * options.full_candidates)
    return _thinned(
        scorer,
        rotations[turns[top]],
        moves[shifts[top]],
        _FULL_POINTS,
        options.full_candidates,
    )


def _promising(
    scorer: _Scorer, rotations: Float64, moves: Float64, step: float, options: SearchOptions
) -> tuple[Intp, Intp]:
    """Return the indices of rotations and translations in the best-scoring cells."""
    cells, cell = np.unique(np.floor(moves / (2 * step) + 0.25), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    middles = np.stack([np.bincount(cell, axis) for axis in moves.T], 1) / count[:, None]
    wider = replace(scorer, reach=_WIDER * scorer.reach)
    few = max(1, _FULL_POINTS // _COARSE_DIVISOR)
    scores = wider(rotations, middles[None], few).ravel()
    best = _highest(scores, max(options.full_candidates, round(_PROMISING * len(scores))))
    turns, at = np.divmod(best, len(cells))
    order, first = np.argsort(cell, kind="stable"), np.cumsum(count) - count
    # Concatenate the translations of these cells.
    several = count[at]
    within = np.arange(several.sum()) - np.repeat(np.cumsum(several) - several, several)
    return np.repeat(turns, several), order[np.repeat(first[at], several) + within]


def _highest(scores: Float32, count: int) -> Intp:
    """Return the positions of the `count` highest scores (n,), ascending."""
    count = min(len(scores), count)
    return np.sort(np.argpartition(-scores, count - 1)[:count])


@dataclass(frozen=True, eq=False)
class _Scorer:
    """Scores the poses of a grid whose steps move points by about `reach`, m."""

    source: _View
    target: _View
    less: Sequence[Bool | None]
    reach: float

    def __call__(self, rotations: Float64, translations: Float64, points: int) -> Float32:
        """Scores (A, B) of rotations (A, 3, 3) with translations (1, B, 3), or (A, 1) pairwise."""
        source = self.source.some(points, self.less[0])
        target = self.target.some(points, self.less[1])
        rotations, translations = (
            np.ascontiguousarray(rotations),
            np.ascontiguousarray(translations),
        )
        scores = np.empty((len(rotations), translations.shape[-2]), np.float32)
        run_chunks(
            lambda a, b: kernels.score_grid(
                source, target, rotations, translations, self.reach, _ALBEDO, scores, a, b
            ),
            len(rotations),
            _CHUNKS,
        )
        return scores


def _best(
    scorer: _Scorer, rotations: Float64, translations: Float64, points: int, count: int
) -> Float64:
    """Score a grid and return its `count` best poses (N, 4, 4) after non-maximum suppression."""
    scores = scorer(rotations, translations[None], max(1, points // _COARSE_DIVISOR)).ravel()
    turns, shifts = np.divmod(_highest(scores, _KEPT * count), len(translations))
    return _thinned(scorer, rotations[turns], translations[shifts], points, count)


def _thinned(scorer: _Scorer, R: Float64, x: Float64, points: int, count: int) -> Float64:
    """Return the `count` best of poses R (N, 3, 3), x (N, 3), with non-maximum suppression."""
    finer = scorer(R, x[:, None], points)[:, 0]
    order = np.argsort(-finer, kind="stable")
    R, x = R[order], x[order]
    depth = 0.5 * (scorer.source.depth + scorer.target.depth)
    chosen = kernels.select_distinct(R, x, depth, 1.5 * scorer.reach, count)
    poses = np.tile(np.eye(4), (len(chosen), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R[chosen], x[chosen]
    return poses


def _noise_floor(s: _View, t: _View, options: AgreementOptions) -> float:
    """Sensor error tolerance at the depth of the views, m."""
    return options.floor_m + options.floor_fraction * 0.5 * (s.depth + t.depth)


def _refine(
    s: _View, t: _View, poses: Float64, reaches: Float64, points: int, max_angle: float
) -> None:
    """Refine poses (N, 4, 4) in place by two-way ICP, with normals within `max_angle`, rad."""
    source, target = s.some(points), t.some(points)
    cosine = float(np.cos(max_angle))
    depth = 0.5 * (s.depth + t.depth)
    run_chunks(
        lambda i, j: kernels.refine_poses(source, target, reaches, cosine, depth, poses, i, j),
        len(poses),
        _CHUNKS,
    )


def _distinct(found: Sequence[Candidate], distinct_m: float) -> tuple[Candidate, ...]:
    """Return the distinct candidates, the best first."""
    found = sorted(found, key=lambda candidate: -candidate.score)
    poses = np.array([candidate.T_target_source for candidate in found]).reshape(-1, 4, 4)
    # The trace of a rotation decreases with its angle.
    least = 1 + 2 * np.cos(DISTINCT_RAD)
    kept: list[int] = []
    for k, T in enumerate(poses):
        better = poses[kept]
        far = np.linalg.norm(better[:, :3, 3] - T[:3, 3], axis=1) > distinct_m
        turned = (better[:, :3, :3] * T[:3, :3]).sum((1, 2)) < least
        if (far | turned).all():
            kept.append(k)
    return tuple(found[k] for k in kept)


def _upright(down: Float64) -> Float64:
    """Return the smallest rotation (3, 3) from `down` (3,) to +y."""
    y = np.array([0.0, 1.0, 0.0])
    axis = np.cross(down, y)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return se3.so3_exp(axis / sine * np.arctan2(sine, float(down @ y)))


def _ball(step: float, radius: float, shape: tuple[float, float, float]) -> Float64:
    """Return the nodes (N, 3) of a cubic grid in an ellipsoid of axes `radius` times `shape`."""
    axes = []
    for squeeze in shape:
        n = int(radius * squeeze / step + 1e-9)
        axes.append(np.arange(-n, n + 1) * step)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    half = [max(radius * squeeze, step) for squeeze in shape]
    return nodes[((nodes / half) ** 2).sum(1) <= 1 + 1e-9]
