"""Grids of poses between two views, scored on a subset of points and refined by two-way ICP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import cv2
import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.compute import run_chunks
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.search import search_kernels as kernels
from tofuse.engine.search.pair_agreement import nearest_depth, sampled_points
from tofuse.engine.search.plane_detection import Floor
from tofuse.engine.views import PreparedView

Mode = Literal["auto", "both", "planar", "full"]

# Steps of the two grids: rad, and as a fraction of the depth. Projective ICP converges from
# neighbouring poses of either; six dimensions allow only a coarser one.
_PLANAR_ANGLE, _PLANAR_STEP = 0.07, 0.06
_FULL_ANGLE, _FULL_STEP = 0.13, 0.1
# Pixels of each image that score a pose of the grids.
_PLANAR_POINTS, _FULL_POINTS = 200, 150
# Sigma of the albedo's low-pass filter for the coarse grid, in the plane z = 1, and difference in
# log albedo at which a point counts neither for nor against a pose.
_ALBEDO_BLUR, _ALBEDO_TOLERANCE = 0.04, 0.12
_NO_BORDER = cv2.BORDER_CONSTANT
# Nodes of the lookup grid of an image, along its wider side.
_GRID_NODES = 128
# Minimum number of points of a view.
MIN_POINTS = 50
# Points of a view from which the search draws its subsets.
_SAMPLED_POINTS = 3000
# The full grid is scored on a sixth of the points; the best poses, this many times the number of
# candidates, on all.
_COARSE_DIVISOR, _KEPT_PER_CANDIDATE = 6, 200
# In six dimensions the centres of cells of eight translations are scored first, with the reach
# multiplied by this factor; the best fraction of the cells is then scored in full.
_CELL_REACH_FACTOR, _PROMISING_FRACTION = 1.5, 0.1
_CHUNKS = 16


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


@dataclass(frozen=True, eq=False)
class ResampledView:
    """A view resampled to a pinhole grid, with a subset of its points.

    Attributes
    ----------
    grid
        (H, W, 5) normal and distance of the plane of each node, and its log albedo.
    frame
        (4,) ray coordinates of the first node, and nodes per unit of them.
    points, normals, albedo
        (N, 3), (N, 3) and (N,) of the subset; log albedo, NaN where unknown.
    depth
        Median z of the points, m.
    """

    grid: Float32
    frame: Float64
    points: Float32
    normals: Float32
    albedo: Float32
    depth: float

    def subset(self, count: int, thinned: Bool | None = None) -> kernels.Resampled:
        """Return `count` points with the grid, only one in four of the `thinned` ones (N,)."""
        keep = np.arange(len(self.points))
        if thinned is not None:
            keep = np.concatenate([keep[~thinned], keep[thinned][::4]])
        keep = evenly_spaced(keep, count)
        points = self.points[keep], self.normals[keep], self.albedo[keep]
        return kernels.Resampled(*points, self.grid, self.frame)


def resampled(view: PreparedView) -> ResampledView:
    """Resample a view to a pinhole grid."""
    rays = view.rays[view.planes[..., 3] > 0]
    if len(rays) < MIN_POINTS:
        no_points = np.zeros((0, 3), np.float32)
        no_nodes = np.zeros((1, 1, 5), np.float32)
        return ResampledView(no_nodes, np.ones(4), no_points, no_points, no_points[:, 0], 1.0)
    rays = view.rays[view.z > 0]
    low, high = rays.min(0).astype(float), rays.max(0).astype(float)
    spacing = max(float((high - low).max()) / _GRID_NODES, 1e-6)
    x, y = (np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(x, y), -1)
    pixel = view.projection.pixels(nodes.reshape(-1, 2)).round().reshape(nodes.shape)
    rows, columns = view.z.shape
    inside = (pixel >= 0).all(-1) & (pixel[..., 0] < columns) & (pixel[..., 1] < rows)
    u, v = np.where(inside[..., None], pixel, 0).astype(int).transpose(2, 0, 1)
    abc = view.planes[v, u, :3].astype(float)
    has_plane = inside & (view.planes[v, u, 3] > 0)
    length = np.maximum(np.sqrt((abc * abc).sum(-1)), 1e-12)
    grid = np.where(has_plane[..., None], np.dstack([abc / length[..., None], 1 / length]), 0)
    grid[..., 3] -= np.where(inside & ~has_plane, nearest_depth(view)[v, u], 0)
    sampled = sampled_points(view, _SAMPLED_POINTS)
    albedo = _low_pass(np.where(has_plane, view.albedo[v, u, 0], np.nan), _ALBEDO_BLUR / spacing)
    ray = sampled.points[:, :2] / sampled.points[:, 2:] - (x[0], y[0])
    j, i = (ray / spacing).round().astype(int).T
    i, j = np.clip(i, 0, len(y) - 1), np.clip(j, 0, len(x) - 1)
    return ResampledView(
        np.dstack([grid, albedo]).astype(np.float32),
        np.array([x[0], y[0], 1 / spacing, 1 / spacing]),
        sampled.points,
        sampled.normals,
        albedo[i, j],
        float(np.median(sampled.points[:, 2])),
    )


def _low_pass(albedo: Float64, sigma: float) -> Float32:
    """Low-pass filter an image (H, W), ignoring NaN, to match the step of the coarse grid."""
    valid = np.isfinite(albedo)
    size = (0, 0)
    total = cv2.GaussianBlur(np.where(valid, albedo, 0), size, sigma, borderType=_NO_BORDER)
    density = cv2.GaussianBlur(valid.astype(float), size, sigma, borderType=_NO_BORDER)
    mean = total / np.maximum(density, 1e-9)
    return np.where(valid, mean, np.nan).astype(np.float32)


def planar_poses(
    s: ResampledView, t: ResampledView, floors: tuple[Floor, Floor], options: SearchOptions
) -> Float64:
    """Return the best T_target_source (N, 4, 4) of the planar grid of a source and a target."""
    floor_s, floor_t = floors
    depth = 0.5 * (s.depth + t.depth)
    upright_s, upright_t = _upright(floor_s.normal), _upright(floor_t.normal)
    n = round(options.yaw / _PLANAR_ANGLE)
    yaws = np.zeros((2 * n + 1, 3))
    yaws[:, 1] = np.linspace(-n, n, 2 * n + 1) * _PLANAR_ANGLE
    rotations = upright_t.T @ se3.so3_exp(yaws) @ upright_s
    translations = _ellipsoid_nodes(_PLANAR_STEP * depth, options.reach * depth, (1.0, 0.0, 1.0))
    translations[:, 1] = floor_t.height - floor_s.height
    thinned = [
        np.abs(v.points @ f.normal - f.height) < 0.02 + 0.02 * v.points[:, 2]
        for v, f in ((s, floor_s), (t, floor_t))
    ]
    scorer = _Scorer(s, t, thinned, depth * max(_PLANAR_STEP, _PLANAR_ANGLE))
    translations, count = translations @ upright_t, options.planar_candidates
    coarse_points = max(1, _PLANAR_POINTS // _COARSE_DIVISOR)
    scores = scorer(rotations, translations[None], coarse_points).ravel()
    i, j = np.divmod(_highest(scores, _KEPT_PER_CANDIDATE * count), len(translations))
    return _non_maximum_suppression(scorer, rotations[i], translations[j], _PLANAR_POINTS, count)


def full_poses(s: ResampledView, t: ResampledView, options: SearchOptions) -> Float64:
    """Return the best T_target_source (N, 4, 4) of the grid of six dimensions."""
    turn, count = options.turn, options.full_candidates
    depth = 0.5 * (s.depth + t.depth)
    roll_ratio = options.roll / turn if turn else 1.0
    rotations = se3.so3_exp(_ellipsoid_nodes(_FULL_ANGLE, turn, (1.0, 1.0, roll_ratio)))
    translations = _ellipsoid_nodes(_FULL_STEP * depth, options.reach * depth, (1.0, 1.0, 1.0))
    scorer = _Scorer(s, t, [None, None], depth * max(_FULL_STEP, _FULL_ANGLE))
    rotation_index, translation_index = _promising(
        scorer, rotations, translations, _FULL_STEP * depth, count
    )
    coarse_points = max(1, _FULL_POINTS // _COARSE_DIVISOR)
    scores = scorer(
        rotations[rotation_index], translations[translation_index][:, None], coarse_points
    )[:, 0]
    best = _highest(scores, _KEPT_PER_CANDIDATE * count)
    return _non_maximum_suppression(
        scorer,
        rotations[rotation_index[best]],
        translations[translation_index[best]],
        _FULL_POINTS,
        count,
    )


def _promising(
    scorer: _Scorer, rotations: Float64, translations: Float64, step: float, count: int
) -> tuple[Intp, Intp]:
    """Return the indices of rotations and translations in the best-scoring cells."""
    cells, cell_of = np.unique(
        np.floor(translations / (2 * step) + 0.25), axis=0, return_inverse=True
    )
    cell_of = cell_of.ravel()
    sizes = np.bincount(cell_of)
    centres = np.stack([np.bincount(cell_of, axis) for axis in translations.T], 1) / sizes[:, None]
    wide_scorer = replace(scorer, reach=_CELL_REACH_FACTOR * scorer.reach)
    coarse_points = max(1, _FULL_POINTS // _COARSE_DIVISOR)
    scores = wide_scorer(rotations, centres[None], coarse_points).ravel()
    best = _highest(scores, max(count, round(_PROMISING_FRACTION * len(scores))))
    rotation_index, cell_index = np.divmod(best, len(cells))
    order, start = np.argsort(cell_of, kind="stable"), np.cumsum(sizes) - sizes
    # Concatenate the translations of these cells.
    counts = sizes[cell_index]
    offset = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(rotation_index, counts), order[np.repeat(start[cell_index], counts) + offset]


def _highest(scores: Float32, count: int) -> Intp:
    """Return the positions of the `count` highest scores (n,), ascending."""
    count = min(len(scores), count)
    return np.sort(np.argpartition(-scores, count - 1)[:count])


@dataclass(frozen=True, eq=False)
class _Scorer:
    """Scores the poses of a grid whose steps move points by about `reach`, m."""

    source: ResampledView
    target: ResampledView
    thinned: Sequence[Bool | None]
    reach: float

    def __call__(self, rotations: Float64, translations: Float64, points: int) -> Float32:
        """Scores (A, B) of rotations (A, 3, 3) with translations (1, B, 3), or (A, 1) pairwise."""
        source = self.source.subset(points, self.thinned[0])
        target = self.target.subset(points, self.thinned[1])
        rotations = np.ascontiguousarray(rotations)
        translations = np.ascontiguousarray(translations)
        scores = np.empty((len(rotations), translations.shape[-2]), np.float32)
        run_chunks(
            lambda a, b: kernels.score_grid(
                source, target, rotations, translations, self.reach, _ALBEDO_TOLERANCE, scores, a, b
            ),
            len(rotations),
            _CHUNKS,
        )
        return scores


def _non_maximum_suppression(
    scorer: _Scorer, R: Float64, x: Float64, points: int, count: int
) -> Float64:
    """Return the `count` best of poses R (N, 3, 3), x (N, 3), with non-maximum suppression."""
    order = np.argsort(-scorer(R, x[:, None], points)[:, 0], kind="stable")
    R, x = R[order], x[order]
    depth = 0.5 * (scorer.source.depth + scorer.target.depth)
    chosen = kernels.select_distinct(R, x, depth, 1.5 * scorer.reach, count)
    return se3.pose(R[chosen], x[chosen])


def refine_poses(
    s: ResampledView, t: ResampledView, poses: Float64, reaches: Float64, points: int
) -> None:
    """Refine poses (N, 4, 4) in place by two-way ICP."""
    source, target = s.subset(points), t.subset(points)
    cosine = projective.MIN_COSINE
    depth = 0.5 * (s.depth + t.depth)
    run_chunks(
        lambda i, j: kernels.refine_poses(source, target, reaches, cosine, depth, poses, i, j),
        len(poses),
        _CHUNKS,
    )


def _upright(down: Float64) -> Float64:
    """Return the smallest rotation (3, 3) from `down` (3,) to +y."""
    y = np.array([0.0, 1.0, 0.0])
    axis = np.cross(down, y)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return se3.so3_exp(axis / sine * np.arctan2(sine, float(down @ y)))


def _ellipsoid_nodes(step: float, radius: float, shape: tuple[float, float, float]) -> Float64:
    """Return the nodes (N, 3) of a cubic grid in an ellipsoid of axes `radius` times `shape`."""
    axes = []
    for factor in shape:
        n = int(radius * factor / step + 1e-9)
        axes.append(np.arange(-n, n + 1) * step)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    semi_axes = [max(radius * factor, step) for factor in shape]
    return nodes[((nodes / semi_axes) ** 2).sum(1) <= 1 + 1e-9]
