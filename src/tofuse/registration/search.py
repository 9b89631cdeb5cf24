"""Large steps between two range images: an exhaustive search, settled by what both images saw.

Every pose of a coarse grid is scored on some hundred pixels of both images; the best ones are
settled by two-way projective ICP, and chosen by `agreement`. Where both views see the floor, the
grid is yaw and two translations; else it has all six dimensions. There is nothing random in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, get_args

import cv2
import numpy as np

from tofuse.arrays import Bool, Float32, Float64, Intp
from tofuse.geometry import se3
from tofuse.kernels import search as kernels
from tofuse.kernels.threads import run_all, run_chunks
from tofuse.registration.agreement import (
    Agreement,
    AgreementOptions,
    Comparison,
    nearest_depth,
)
from tofuse.registration.floor import Floor, FloorOptions, find_floors
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Level, ProjectiveOptions, Target, align
from tofuse.registration.rough import with_rough_planes
from tofuse.registration.view_points import ViewPoints

Mode = Literal["auto", "both", "planar", "full"]

# Patient, as albedo reaches no further than it is smooth; open directions are left to it.
_PHOTOMETRIC = ProjectiveOptions(
    levels=(Level(4, 15, 0.03, 0.1), Level(2, 8, 0.005, 0.02)), common_tilt=0.0, common_slope=0.0
)
# Best candidates that are settled once more, by so many pixels and as closely as noise allows.
_POLISHED, _POLISH_POINTS = 10, 2500
# Score that a candidate may lose by being aligned by albedo.
_GIVEN_UP = 0.05
# Width over which albedo is averaged before it scores coarse steps, in the plane z = 1, and the
# deviation in log albedo at which points that support a pose speak against it as much.
_BLUR, _ALBEDO = 0.04, 0.12
_NO_BORDER = cv2.BORDER_CONSTANT
# Nodes of the grid on which an image is looked up, along its wider side.
_GRID = 128
# Points without which a view is not searched.
_LEAST_POINTS = 50
# Points of a view of which the search takes its samples.
_SEEN = 3000
# The whole grid is scored on a sixth of the points, and the best so many times the candidates on
# all.
_COARSE_SHARE, _KEPT = 6, 200
# Of the grid of six dimensions first the middles of cells of eight translations are scored, with
# so many times the reach, and only the translations in this share of the cells, the best.
_WIDER, _PROMISING = 1.5, 0.1
_CHUNKS = 16
# Reaches of the two-way ICP, iteration by iteration, in those of the first.
_NARROWER = 0.85 ** np.arange(28)


@dataclass(frozen=True)
class SearchOptions:
    """How far and how finely is searched.

    Lengths are shares of the depth of the views (the mean of their medians), so that a room and a
    box on a table are searched alike.

    Attributes
    ----------
    mode
        "planar" (yaw, and translation along the floor), "full" (six dimensions), "both" (planar
        where both views see a floor, and full: slow, but the margin counts all rivals), or "auto"
        (full only where there is no floor, or what the planar search finds does not convince).
    yaw
        Largest rotation about the vertical in the planar search, rad.
    turn, roll
        Largest rotation in the full search, and largest one about the line of sight, rad.
    reach
        Largest translation.
    planar_yaw_step, planar_step
        Steps of the planar grid, rad and share.
    full_angle_step, full_step
        Steps of the full grid.
    planar_points, full_points
        Pixels of each image that score the poses of the grid.
    planar_candidates, full_candidates
        How many of the grid's poses are settled.
    settle_points
        Pixels of each image that settle a candidate.
    photo_candidates
        How many of the best candidates are aligned by albedo too, where both views have it.
    convincing
        Least score with which "auto" leaves it at the planar search.
    distinct_m, distinct_rad
        Poses that differ by more are different answers.
    floor, agreement
        How the floor is found, and the two images compared.
    """

    mode: Mode = "auto"
    yaw: float = 1.1
    turn: float = 0.9
    roll: float = 0.5
    reach: float = 0.6
    planar_yaw_step: float = 0.07
    planar_step: float = 0.06
    full_angle_step: float = 0.13
    full_step: float = 0.1
    planar_points: int = 200
    full_points: int = 150
    planar_candidates: int = 20
    full_candidates: int = 60
    settle_points: int = 700
    photo_candidates: int = 30
    convincing: float = 0.4
    distinct_m: float = 0.1
    distinct_rad: float = 0.0873
    floor: FloorOptions = field(default_factory=FloorOptions)
    agreement: AgreementOptions = field(default_factory=AgreementOptions)

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise ValueError(f"mode is {self.mode!r}, not one of {', '.join(get_args(Mode))}")
        for name in ("planar_yaw_step", "planar_step", "full_angle_step", "full_step"):
            if not 0.005 <= getattr(self, name) <= 3.2:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0.005 to 3.2")
        for name in ("yaw", "turn", "roll"):
            if not 0 <= getattr(self, name) <= 3.1416:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 to 3.1416")
        if not 0 <= self.reach <= 10:
            raise ValueError(f"reach is {self.reach}, not 0 to 10")
        for name in (
            "planar_points",
            "full_points",
            "planar_candidates",
            "full_candidates",
            "settle_points",
            "photo_candidates",
        ):
            if not 1 <= getattr(self, name) <= 1_000_000:
                raise ValueError(f"{name} is {getattr(self, name)}, not 1 or more")
        for name in ("convincing", "distinct_m", "distinct_rad"):
            if not 0 <= getattr(self, name) <= 1e3:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 or more")

    def differ(self, a: Float64, b: Float64) -> bool:
        """Whether two poses (4, 4) are different answers."""
        between = se3.inverse(a) @ b
        return bool(
            np.linalg.norm(between[:3, 3]) > self.distinct_m
            or se3.angle(between) > self.distinct_rad
        )


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose T_target_source (4, 4) and what both images say of it."""

    T_target_source: Float64
    agreement: Agreement

    @property
    def score(self) -> float:
        """Support less twice the free-space violation, as a share of the points."""
        return self.agreement.score


@dataclass(frozen=True, eq=False)
class Match:
    """What a search found.

    Attributes
    ----------
    candidates
        Distinct poses, the best first.
    mode
        Which search was made: "full" where the planar one did not suffice.
    """

    candidates: tuple[Candidate, ...]
    mode: Literal["planar", "full"]

    @property
    def T_target_source(self) -> Float64:
        """(4, 4) the best pose."""
        return self.candidates[0].T_target_source

    @property
    def agreement(self) -> Agreement:
        """What both images say of the best pose."""
        return self.candidates[0].agreement

    @property
    def score(self) -> float:
        """Of the best pose."""
        return self.candidates[0].score

    @property
    def runner_up(self) -> Candidate | None:
        """The second best distinct pose."""
        return self.candidates[1] if len(self.candidates) > 1 else None

    @property
    def margin(self) -> float:
        """By how much the best pose scores better than the runner-up.

        A symmetric scene leaves little of it, whatever the score.
        """
        return self.score - (max(self.candidates[1].score, 0.0) if self.runner_up else 0.0)


@dataclass(frozen=True, eq=False)
class _View:
    """A view as the search takes it."""

    grid: Float32
    frame: Float64
    points: Float32
    normals: Float32
    light: Float32
    depth: float

    def some(self, count: int, less: Bool | None = None) -> tuple[Float32, Float32, Float32]:
        """About so many points, their normals and light, of those marked `less` every fourth."""
        keep = np.arange(len(self.points))
        if less is not None:
            keep = np.concatenate([keep[~less], keep[less][::4]])
        keep = keep[np.linspace(0, len(keep) - 1, min(count, len(keep))).round().astype(int)]
        return self.points[keep], self.normals[keep], self.light[keep]


def search(
    source: PreparedView,
    target: PreparedView,
    options: SearchOptions | None = None,
    *,
    gravity: tuple[Float64, Float64] | None = None,
) -> Match | None:
    """Find the pose between two views that may be far apart.

    Parameters
    ----------
    gravity
        (3,) directions in which things fall in the source's and in the target's frame, if known.

    Returns
    -------
    Match or None
        None where a view has too few surfaces to be searched with.
    """
    prepared = Search.of(source, target, options)
    return None if prepared is None else prepared.everywhere(gravity)


@dataclass(frozen=True, eq=False)
class Search:
    """Two views, prepared to be searched.

    Attributes
    ----------
    source, target
        Their surfaces, with rough planes where there are no others.
    compared
        How they are judged.
    """

    source: PreparedView
    target: PreparedView
    compared: Comparison
    options: SearchOptions
    s: _View
    t: _View

    @classmethod
    def of(
        cls, source: PreparedView, target: PreparedView, options: SearchOptions | None = None
    ) -> Search | None:
        """Prepare two views; None where one has too few surfaces to be searched with."""
        options = SearchOptions() if options is None else options
        source, target = with_rough_planes(source), with_rough_planes(target)
        s, t = _prepare(source), _prepare(target)
        if min(len(s.points), len(t.points)) < _LEAST_POINTS:
            return None
        compared = Comparison.of(source, target, options.agreement)
        return cls(source, target, compared, options, s, t)

    def everywhere(self, gravity: tuple[Float64, Float64] | None = None) -> Match | None:
        """Search the whole grid; see `search`."""
        s, t, options = self.s, self.t, self.options
        found: list[Candidate] = []
        if options.mode != "full":
            floors = find_floors((self.source, self.target), options.floor, gravity)
            if floors is not None:
                found = self._settled(_planar(s, t, floors[0], floors[1], options))
            convinced = bool(found) and max(c.score for c in found) >= options.convincing
            if options.mode == "planar" or (options.mode == "auto" and convinced):
                return Match(self._ordered(found), "planar") if found else None
        found += self._settled(_full(s, t, options))
        return Match(self._ordered(found), "full")

    def among(self, poses: Float64, match: Match) -> Match:
        """Settle other poses T_target_source (N, 4, 4) too, and order them among those found."""
        if not len(poses):
            return match
        return replace(match, candidates=self._ordered([*match.candidates, *self._settled(poses)]))

    def _settled(self, poses: Float64) -> list[Candidate]:
        """Settle poses by two-way ICP, and judge them."""
        s, t, options = self.s, self.t, self.options
        poses = poses.copy()
        floor = _noise_floor(s, t, options)
        depth = 0.5 * (s.depth + t.depth)
        reaches = np.maximum(0.25 * depth * _NARROWER, 3 * floor)
        _settle(s, t, poses, reaches, options.settle_points, options)
        judged = self._judged(poses)
        best = sorted(judged, key=lambda candidate: -candidate.score)[:_POLISHED]
        finer = np.stack([candidate.T_target_source for candidate in best])
        reaches = np.maximum(8 * floor * _NARROWER, 1.3 * floor)
        _settle(s, t, finer, reaches, _POLISH_POINTS, options)
        return judged + self._judged(finer)

    def _judged(self, poses: Sequence[Float64] | Float64) -> list[Candidate]:
        said = run_all([partial(self.compared.at, T) for T in poses])
        return [Candidate(T, each) for T, each in zip(poses, said, strict=True)]

    def _ordered(self, found: list[Candidate]) -> tuple[Candidate, ...]:
        """Order candidates, after albedo has placed the best ones where geometry alone can't."""
        source, target, options = self.source, self.target, self.options
        distinct = _distinct(found, options)
        if not (source.has_albedo and target.has_albedo):
            return distinct
        best, rest = distinct[: options.photo_candidates], distinct[options.photo_candidates :]
        targets = [Target(target, np.eye(4))]
        moved = run_all(
            [
                partial(align, source, targets, candidate.T_target_source, _PHOTOMETRIC)
                for candidate in best
            ]
        )
        placed = self._judged([aligned.T_world_source for aligned in moved])
        # Where geometry leaves a pose open, it may fit better a little off the place that albedo
        # knows.
        kept = [
            new if new.score > old.score - _GIVEN_UP else old
            for old, new in zip(best, placed, strict=True)
        ]
        return _distinct([*kept, *rest], options)


def _prepare(view: PreparedView) -> _View:
    """Look a view up on a pinhole grid."""
    rays = view.rays[view.planes[..., 3] > 0]
    if len(rays) < _LEAST_POINTS:
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
    seen = ViewPoints.of(view, _SEEN)
    light = _around(np.where(known, view.albedo[v, u, 0], np.nan), _BLUR / spacing)
    at = seen.points[:, :2] / seen.points[:, 2:] - (x[0], y[0])
    j, i = (at / spacing).round().astype(int).T
    i, j = np.clip(i, 0, len(y) - 1), np.clip(j, 0, len(x) - 1)
    return _View(
        np.dstack([grid, light]).astype(np.float32),
        np.array([x[0], y[0], 1 / spacing, 1 / spacing]),
        seen.points,
        seen.normals,
        light[i, j],
        float(np.median(seen.points[:, 2])),
    )


def _around(light: Float64, sigma: float) -> Float32:
    """Mean of an image around each pixel, NaN where it is: a coarse step must not matter."""
    known = np.isfinite(light)
    size = (0, 0)
    total = cv2.GaussianBlur(np.where(known, light, 0), size, sigma, borderType=_NO_BORDER)
    share = cv2.GaussianBlur(known.astype(float), size, sigma, borderType=_NO_BORDER)
    mean = total / np.maximum(share, 1e-9)
    return np.where(known, mean, np.nan).astype(np.float32)


def _planar(s: _View, t: _View, floor_s: Floor, floor_t: Floor, options: SearchOptions) -> Float64:
    """Best poses of the planar grid, (N, 4, 4)."""
    depth = 0.5 * (s.depth + t.depth)
    to_s, to_t = _upright(floor_s.normal), _upright(floor_t.normal)
    n = round(options.yaw / options.planar_yaw_step)
    yaws = np.zeros((2 * n + 1, 3))
    yaws[:, 1] = np.linspace(-n, n, 2 * n + 1) * options.planar_yaw_step
    rotations = to_t.T @ se3.so3_exp(yaws) @ to_s
    moves = _ball(options.planar_step * depth, options.reach * depth, (1.0, 0.0, 1.0))
    moves[:, 1] = floor_t.height - floor_s.height
    less = [
        np.abs(v.points @ f.normal - f.height) < 0.02 + 0.02 * v.points[:, 2]
        for v, f in ((s, floor_s), (t, floor_t))
    ]
    step = depth * max(options.planar_step, options.planar_yaw_step)
    return _best(
        _Scorer(s, t, less, step),
        rotations,
        moves @ to_t,
        options.planar_points,
        options.planar_candidates,
    )


def _full(s: _View, t: _View, options: SearchOptions) -> Float64:
    """Best poses of the grid of six dimensions, (N, 4, 4)."""
    depth = 0.5 * (s.depth + t.depth)
    flat = options.roll / options.turn if options.turn else 1.0
    rotations = se3.so3_exp(_ball(options.full_angle_step, options.turn, (1.0, 1.0, flat)))
    moves = _ball(options.full_step * depth, options.reach * depth, (1.0, 1.0, 1.0))
    step = depth * max(options.full_step, options.full_angle_step)
    scorer = _Scorer(s, t, [None, None], step)
    turns, shifts = _promising(scorer, rotations, moves, options.full_step * depth, options)
    few = max(1, options.full_points // _COARSE_SHARE)
    scores = scorer(rotations[turns], moves[shifts][:, None], few)[:, 0]
    top = _highest(scores, _KEPT * options.full_candidates)
    return _thinned(
        scorer,
        rotations[turns[top]],
        moves[shifts[top]],
        options.full_points,
        options.full_candidates,
    )


def _promising(
    scorer: _Scorer, rotations: Float64, moves: Float64, step: float, options: SearchOptions
) -> tuple[Intp, Intp]:
    """Which rotations and which translations go together in the cells that score best."""
    cells, cell = np.unique(np.floor(moves / (2 * step) + 0.25), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    middles = np.stack([np.bincount(cell, axis) for axis in moves.T], 1) / count[:, None]
    wider = replace(scorer, reach=_WIDER * scorer.reach)
    few = max(1, options.full_points // _COARSE_SHARE)
    scores = wider(rotations, middles[None], few).ravel()
    best = _highest(scores, max(options.full_candidates, round(_PROMISING * len(scores))))
    turns, at = np.divmod(best, len(cells))
    order, first = np.argsort(cell, kind="stable"), np.cumsum(count) - count
    # All translations of each of these cells, one after the other.
    several = count[at]
    within = np.arange(several.sum()) - np.repeat(np.cumsum(several) - several, several)
    return np.repeat(turns, several), order[np.repeat(first[at], several) + within]


def _highest(scores: Float32, count: int) -> Intp:
    """Positions of the highest scores (n,), at most so many, in order of position."""
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
        """(A, B) scores of each rotation with each translation; (A, 1) if there are as many."""
        s, t = self.source, self.target
        some = (*s.some(points, self.less[0]), *t.some(points, self.less[1]))
        rotations, translations = (
            np.ascontiguousarray(rotations),
            np.ascontiguousarray(translations),
        )
        scores = np.empty((len(rotations), translations.shape[-2]), np.float32)
        run_chunks(
            lambda a, b: kernels.score_grid(
                *some,
                s.grid,
                s.frame,
                t.grid,
                t.frame,
                rotations,
                translations,
                self.reach,
                _ALBEDO,
                scores,
                a,
                b,
            ),
            len(rotations),
            _CHUNKS,
        )
        return scores


def _best(
    scorer: _Scorer, rotations: Float64, translations: Float64, points: int, count: int
) -> Float64:
    """Score a grid and return its `count` best poses, (N, 4, 4); of neighbours only the best."""
    scores = scorer(rotations, translations[None], max(1, points // _COARSE_SHARE)).ravel()
    turns, shifts = np.divmod(_highest(scores, _KEPT * count), len(translations))
    return _thinned(scorer, rotations[turns], translations[shifts], points, count)


def _thinned(scorer: _Scorer, R: Float64, x: Float64, points: int, count: int) -> Float64:
    """Of poses (N, 3, 3) and (N, 3) the `count` best, (M, 4, 4); of neighbours only the best."""
    finer = scorer(R, x[:, None], points)[:, 0]
    order = np.argsort(-finer, kind="stable")
    R, x = R[order], x[order]
    depth = 0.5 * (scorer.source.depth + scorer.target.depth)
    chosen = kernels.select_distinct(R, x, depth, 1.5 * scorer.reach, count)
    poses = np.tile(np.eye(4), (len(chosen), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R[chosen], x[chosen]
    return poses


def _noise_floor(s: _View, t: _View, options: SearchOptions) -> float:
    """Distance that errors of the sensor explain at the depth of the views, m."""
    a = options.agreement
    return a.floor_m + a.floor_share * 0.5 * (s.depth + t.depth)


def _settle(
    s: _View, t: _View, poses: Float64, reaches: Float64, points: int, options: SearchOptions
) -> None:
    """Settle poses (N, 4, 4) in place by two-way ICP."""
    some = (*s.some(points)[:2], *t.some(points)[:2])
    cosine = float(np.cos(options.agreement.max_angle))
    depth = 0.5 * (s.depth + t.depth)
    run_chunks(
        lambda i, j: kernels.refine_poses(
            *some, s.grid, s.frame, t.grid, t.frame, reaches, cosine, depth, poses, i, j
        ),
        len(poses),
        _CHUNKS,
    )


def _distinct(found: Sequence[Candidate], options: SearchOptions) -> tuple[Candidate, ...]:
    """Order candidates, the best first, and leave out those that are nearly a better one."""
    found = sorted(found, key=lambda candidate: -candidate.score)
    poses = np.array([candidate.T_target_source for candidate in found]).reshape(-1, 4, 4)
    # Of a turn by less than that the cosine is more, and so is the trace.
    least = 1 + 2 * np.cos(min(options.distinct_rad, np.pi))
    kept: list[int] = []
    for k, T in enumerate(poses):
        better = poses[kept]
        far = np.linalg.norm(better[:, :3, 3] - T[:3, 3], axis=1) > options.distinct_m
        turned = (better[:, :3, :3] * T[:3, :3]).sum((1, 2)) < least
        if (far | turned).all():
            kept.append(k)
    return tuple(found[k] for k in kept)


def _upright(down: Float64) -> Float64:
    """(3, 3) the smallest rotation that turns `down` to +y."""
    y = np.array([0.0, 1.0, 0.0])
    axis = np.cross(down, y)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return se3.so3_exp(axis / sine * np.arctan2(sine, float(down @ y)))


def _ball(step: float, radius: float, shape: tuple[float, float, float]) -> Float64:
    """(N, 3) nodes of a cubic grid in a ball that is squeezed by `shape` along each axis."""
    axes = []
    for squeeze in shape:
        n = int(radius * squeeze / step + 1e-9)
        axes.append(np.arange(-n, n + 1) * step)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    half = [max(radius * squeeze, step) for squeeze in shape]
    return nodes[((nodes / half) ** 2).sum(1) <= 1 + 1e-9]
