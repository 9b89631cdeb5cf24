"""Bundle adjustment of planes: all poses of overlapping clouds and the planes that they share.

The maximum likelihood of eq 2.8 for an unknown surface (Liu and Zhang 2021, "BALM"). The points of
all views together are divided into cells, each with a plane, and the poses minimise the distances
of the points from these planes. The planes are unknowns too, and are eliminated from the normal
equations. Points are then reassigned to cells, and cells shrink from coarse to fine as long as
the noise leaves planes in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Int64, Intp
from tofuse.engine.compute import run_chunks
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.graph import sparse
from tofuse.engine.icp import extent
from tofuse.engine.refinement import plane_kernels as kernels

# Iterations of moving cells to the centroids of their points, which aligns them with the surface.
_CENTRING = 2
# Each chunk has its own blocks of all pairs.
_CHUNKS = 8
# Small compared with the information of a cell, so that unconstrained poses stay.
_DAMPING = 1e-6
# Points of the median cell, as a multiple of the minimum.
_MIN_FILL = 1.5
# Sizes above the smallest that is flat initially, and sizes below the last that is full.
_SIZES_ABOVE = 3
_SIZES_BELOW = 3
# Change of the support of clouds due to another division of their points. The support of pairs of
# images is defined differently, and has a separate limit (`calibration_check`).
SUPPORT_NOISE = 0.003
# Largest mean motion of a view's points in a step, as a fraction of the size of the cells.
_MAX_STEP = 0.5
# Smallest variance of a cell, as a fraction of the median: smaller ones are so by chance.
_MIN_VARIANCE = 0.25
# Cosine of incidence below which the side of a plane that a view observes is unknown; and the
# distance of two sides, in units of their thickness, above which they are separate surfaces.
_MIN_COSINE, _SEPARATION = 0.15, 3.0
# Size of the largest cells, as a fraction of the extent of the median view (the diagonal of the
# middle 90 % of its points): larger cells would contain views that share no surface. And the ratio
# of successive sizes.
_COARSEST, _SHRINK = 0.2, 0.8
# Largest number of iterations with each size; three times as many with the last.
_ITERATIONS = 4
# Iterations end when points move by less, as a fraction of the size of the cells.
_CONVERGENCE = 0.002
# Smallest number of points of a cell; the median cell must have half as many again.
_MIN_POINTS = 10
# Cells shrink while the median cell's thickness is at most this fraction of its width (of the
# shorter side; both as standard deviations).
_FLATNESS = 0.6
# Number of shifted divisions of the points into the last cells, which are averaged.
_DIVISIONS = 4


@dataclass(frozen=True, eq=False)
class Aligned:
    """Result of the refinement of clouds.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera; the first of each connected part has not moved.
    pairs
        (M, 2) positions of the views i < j that share planes.
    covariance
        (M, 6, 6) of the right perturbations of their relative poses T_i_j, from the noise, for all
        views jointly.
    size
        Of the last cells, m; 0 if there are none.
    sigma
        Standard deviation of the points across the surface, m.
    before, after
        (N,) support of each view at the initial and at the refined poses: 1 if all its points lie
        on planes that other views share.
    """

    poses: Float64
    pairs: Intp
    covariance: Float64
    size: float
    sigma: float
    before: Float64
    after: Float64


@dataclass(frozen=True, eq=False)
class _Points:
    """The points of all views, concatenated."""

    p: Float64
    view: Int64
    count: int

    @cached_property
    def extent(self) -> float:
        """Extent of the median view, m; 0 if all are empty."""
        ends = np.searchsorted(self.view, np.arange(1, self.count))
        extents = [extent(p) for p in np.split(self.p, ends) if len(p)]
        return float(np.median(extents)) if extents else 0.0

    def world(self, poses: Float64) -> Float64:
        """(M, 3) points in the world, by poses (N, 4, 4)."""
        chunks = run_chunks(
            lambda a, b: (
                np.einsum("kij,kj->ki", poses[self.view[a:b], :3, :3], self.p[a:b])
                + poses[self.view[a:b], :3, 3]
            ),
            len(self.p),
        )
        return np.concatenate(chunks) if chunks else np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class _PlaneCells:
    """Points sorted into cells, and the plane of each."""

    order: Intp
    start: Int64
    p: Float64
    x: Float64
    view: Int64
    mean: Float64
    axes: Float64
    spread: Float64
    views: Int64

    @cached_property
    def shared(self) -> Bool:
        """(S,) cells that several views observe."""
        return self.views > 1

    def typical(self) -> tuple[float, float, float]:
        """Median thickness (m), width (m) and number of points of the shared cells."""
        if not self.shared.any():
            return np.inf, 1.0, 0.0
        deviation = np.sqrt(np.maximum(self.spread[self.shared], 0))
        thickness, width = np.median(deviation[:, :2], axis=0)
        return float(thickness), float(width), float(np.median(np.diff(self.start)[self.shared]))


def refine_clouds(clouds: Sequence[Float64], poses: Float64) -> Aligned:
    """Minimise the distances of the points of all views from the planes that they share.

    Parameters
    ----------
    clouds
        (n, 3) points of each view, m, in its frame.
    poses
        (N, 4, 4) initial T_world_camera; the first of each connected part stays.
    """
    start = poses
    points = _Points(
        np.ascontiguousarray(np.concatenate(clouds), np.float64),
        np.repeat(np.arange(len(clouds)), [len(c) for c in clouds]),
        len(clouds),
    )
    best: tuple[float, Float64] | None = None
    for size in _sizes(points, poses).tolist():
        poses, cells = _level(points, poses, size, _ITERATIONS)
        thickness, width, point_count = cells[0].typical()
        flat = thickness <= _FLATNESS * width
        if point_count < _MIN_FILL * _MIN_POINTS or (best is not None and not flat):
            break
        if flat:
            best = size, poses
    if best is None:
        return _unmoved(start)
    size, poses = best
    poses, cells = _level(points, poses, size, 3 * _ITERATIONS, _DIVISIONS)
    sigma = cells[0].typical()[0]
    limit = kernels.ROBUST * sigma
    factor, system = _system(points, poses, cells)
    if factor is None:
        return _unmoved(start)
    i, j = system.pairs.T
    covariance = factor.relative_covariances(se3.inverse(poses[i]) @ poses[j])
    initial_cells = _divided(points, start, size, _DIVISIONS)
    return Aligned(
        poses,
        system.pairs,
        covariance,
        size,
        sigma,
        np.mean([_support(points, division, limit) for division in initial_cells], axis=0),
        np.mean([_support(points, division, limit) for division in cells], axis=0),
    )


def _sizes(points: _Points, poses: Float64) -> Float64:
    """Decreasing sizes of cells.

    The first is some steps above the smallest whose cells are flat at the initial poses; coarser
    ones than needed would lose accuracy. If none is flat, all sizes are returned.
    """
    sizes, first = [_COARSEST * points.extent], 0
    while sizes[-1] > 0:
        cells = _cells(points, poses, _centres(points, poses, sizes[-1]))
        thickness, width, point_count = cells.typical()
        if point_count < _MIN_FILL * _MIN_POINTS:
            break
        if thickness <= _FLATNESS * width:
            first = max(0, len(sizes) - 1 - _SIZES_ABOVE)
        sizes.append(_SHRINK * sizes[-1])
    # With better poses, more views may share a cell.
    smaller = sizes[-1] * _SHRINK ** np.arange(1, _SIZES_BELOW + 1)
    return np.concatenate([sizes[first:], smaller[smaller > 0]])


def _unmoved(poses: Float64) -> Aligned:
    none = np.zeros(len(poses))
    return Aligned(poses, np.zeros((0, 2), np.intp), np.zeros((0, 6, 6)), 0.0, 0.0, none, none)


def _level(
    points: _Points, poses: Float64, size: float, iterations: int, divisions: int = 1
) -> tuple[Float64, list[_PlaneCells]]:
    """Iterate with cells of one size; returns the poses and their cells.

    If the support of the views falls, these are the initial ones.
    """
    initial_cells = _divided(points, poses, size, divisions)
    refined, cells = poses, initial_cells
    for _ in range(iterations):
        factor, _ = _system(points, refined, cells)
        step = factor.step() if factor is not None else None
        if step is None:
            break
        step, motion = _bounded(points, refined, step, _MAX_STEP * size)
        refined = se3.orthonormalise(refined @ se3.exp(step))
        cells = [_cells(points, refined, c.mean[np.diff(c.start) > 0]) for c in cells]
        if motion < _CONVERGENCE * size:
            break
    # Divided again, as cells that moved along were fitted in more iterations.
    cells = _divided(points, refined, size, divisions)
    limit = kernels.ROBUST * initial_cells[0].typical()[0]
    before, after = (
        np.mean([_support(points, c, limit) for c in divided]) for divided in (initial_cells, cells)
    )
    return (refined, cells) if after >= before - SUPPORT_NOISE else (poses, initial_cells)


def _divided(points: _Points, poses: Float64, size: float, divisions: int) -> list[_PlaneCells]:
    """Divide all points into cells in several shifted ways."""
    shifts = np.arange(divisions) / divisions
    return [_cells(points, poses, _centres(points, poses, size, shift)) for shift in shifts]


def _bounded(points: _Points, poses: Float64, step: Float64, limit: float) -> tuple[Float64, float]:
    """Shorten a step until no view's points move further than `limit`; also their motion, m."""
    before = points.world(poses)
    while True:
        motion = np.linalg.norm(points.world(poses @ se3.exp(step)) - before, axis=1)
        total = np.bincount(points.view, motion, minlength=points.count)
        mean = total / np.maximum(np.bincount(points.view, minlength=points.count), 1)
        if mean.max() <= limit:
            return step, float(motion.mean())
        step = step * min(0.9 * limit / mean.max(), 0.9)


def _centres(points: _Points, poses: Float64, size: float, shift: float = 0.0) -> Float64:
    """Centres of cells of about one size: of cubes at first, then along the surface."""
    x = points.world(poses)
    cube = np.floor((x - x.min(0)) / size + shift).astype(np.int64)
    _, cell = np.unique(cube, axis=0, return_inverse=True)
    centres = _means(x, cell.ravel())
    for _ in range(_CENTRING):
        centres = _means(x, KdTree(centres).nearest(x)[0])
    return centres


def _means(x: Float64, cell: Int64) -> Float64:
    count = np.bincount(cell)
    sums = np.stack([np.bincount(cell, x[:, a]) for a in range(3)], 1)
    return sums[count > 0] / count[count > 0, None]


def _cells(points: _Points, poses: Float64, centres: Float64) -> _PlaneCells:
    """Assign each point to the nearest centre, and fit the planes.

    The two sides of a wall may be closer to each other than a cell is wide, so cells observed from
    opposite sides are divided.
    """
    x = points.world(poses)
    cell, _ = KdTree(centres).nearest(x)
    cells = _fit(points, x, cell, len(centres))
    behind = _back_sides(cells, poses)
    if not behind.any():
        return cells
    cell[cells.order[behind]] += len(centres)
    _, cell = np.unique(cell, return_inverse=True)
    cell = cell.ravel().astype(np.int64)
    return _fit(points, x, cell, int(cell.max()) + 1)


def _fit(points: _Points, x: Float64, cell: Int64, size: int) -> _PlaneCells:
    """Sort points (M, 3) of the world into cells (M,), and fit the planes."""
    # Points are ordered by their views already.
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], np.arange(size + 1)).astype(np.int64)
    x, view = x[order], points.view[order]
    mean, axes = np.empty((size, 3)), np.empty((size, 3, 3))
    spread, views = np.empty((size, 3)), np.empty(size, np.int64)

    def work(a: int, b: int) -> None:
        kernels.fit_cells(x, view, start[a : b + 1], mean[a:b], axes[a:b], spread[a:b], views[a:b])

    run_chunks(work, size)
    return _PlaneCells(order, start, points.p[order], x, view, mean, axes, spread, views)


def _back_sides(cells: _PlaneCells, poses: Float64) -> Bool:
    """(M,) mask of the points, ordered by cell, on the back of a cell with two separate sides."""
    size = len(cells.mean)
    cell = np.repeat(np.arange(size), np.diff(cells.start))
    viewing_direction = poses[cells.view, :3, 3] - cells.mean[cell]
    viewing_direction /= np.maximum(np.linalg.norm(viewing_direction, axis=1, keepdims=True), 1e-12)
    normal = cells.axes[cell, 0]
    cosine = (viewing_direction * normal).sum(1)
    height = ((cells.x - cells.mean[cell]) * normal).sum(1)
    sides = [cosine > _MIN_COSINE, cosine < -_MIN_COSINE]
    means, squares, counts = [], np.zeros(size), np.zeros(size)
    for side in sides:
        count = np.bincount(cell, side, size)
        mean = np.bincount(cell, np.where(side, height, 0.0), size) / np.maximum(count, 1)
        squares += np.bincount(cell, np.where(side, (height - mean[cell]) ** 2, 0.0), size)
        counts += count
        means.append(np.where(count > 0, mean, np.nan))
    thickness = np.sqrt(squares / np.maximum(counts, 1))
    separate = means[0] - means[1] > _SEPARATION * thickness  # never where one side has no points
    return sides[1] & separate[cell]


def _system(
    points: _Points, poses: Float64, divisions: Sequence[_PlaneCells]
) -> tuple[sparse.Factor | None, sparse.PairSystem]:
    """Normal equations of all poses without the planes, averaged over several divisions."""
    n = points.count
    variances = [_variance(cells) for cells in divisions]
    pairs = _pairs(divisions, variances, n)
    pair_index = np.full((n, n), -1, np.int64)
    pair_index[pairs[:, 0], pairs[:, 1]] = np.arange(len(pairs))
    rotations = np.ascontiguousarray(poses[:, :3, :3])
    diagonal, gradient = np.zeros((n, 6, 6)), np.zeros((n, 6))
    off_diagonal = np.zeros((len(pairs), 6, 6))
    for cells, variance in zip(divisions, variances, strict=True):

        def work(
            a: int, b: int, cells: _PlaneCells = cells, variance: Float64 = variance
        ) -> tuple[Float64, Float64, Float64]:
            out = np.zeros_like(diagonal), np.zeros_like(gradient), np.zeros_like(off_diagonal)
            kernels.plane_equations(
                cells.p,
                cells.x,
                cells.view,
                cells.start[a : b + 1],
                cells.mean[a:b],
                cells.axes[a:b],
                variance[a:b],
                rotations,
                pair_index,
                *out,
            )
            return out

        for parts in run_chunks(work, len(variance), _CHUNKS):
            for total, part in zip((diagonal, gradient, off_diagonal), parts, strict=True):
                total += part / len(divisions)
    system = sparse.PairSystem(n, pairs)
    none, flat = np.zeros_like(off_diagonal), np.zeros((len(pairs), 6))
    matrix, rhs = system.assemble(none, off_diagonal, none, flat, flat, (diagonal, gradient))
    return system.factor(matrix, rhs, _DAMPING), system


def _variance(cells: _PlaneCells) -> Float64:
    """(S,) variance of the residuals of each cell, 0 if it has too few points or only one view."""
    valid = cells.shared & (np.diff(cells.start) >= _MIN_POINTS)
    variance = np.where(valid, cells.spread[:, 0], 0.0)
    if valid.any():
        floor = _MIN_VARIANCE * float(np.median(variance[valid]))
        variance[valid] = np.maximum(variance[valid], max(floor, 1e-18))
    return variance


def _pairs(divisions: Sequence[_PlaneCells], variances: Sequence[Float64], n: int) -> Intp:
    """Pairs of views i < j that observe the same cell."""
    shared_cells = np.zeros((n, n))
    for cells, variance in zip(divisions, variances, strict=True):
        cell = np.repeat(np.arange(len(variance)), np.diff(cells.start))
        visible = np.zeros((len(variance), n))
        visible[cell, cells.view] = 1
        visible = visible[variance > 0]
        shared_cells += visible.T @ visible
    return np.argwhere(np.triu(shared_cells, 1) > 0).astype(np.intp)


def _support(points: _Points, cells: _PlaneCells, limit: float) -> Float64:
    out = np.zeros(points.count)
    kernels.plane_support(
        cells.x, cells.view, cells.start, cells.mean, cells.axes, cells.views, limit, out
    )
    total = np.bincount(points.view, minlength=points.count)
    support: Float64 = out / np.maximum(total, 1)
    return support
