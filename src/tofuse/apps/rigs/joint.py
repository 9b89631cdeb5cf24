"""Joint calibration of all cameras of a rig: their poses and depth offsets, with covariances.

Overlapping views of different cameras are compared in both directions. As the cameras are fixed to
each other, all instants share the unknowns: a pose and a depth offset for each camera but the
first. The covariance is that of an M-estimator with spatially correlated errors (Conley, "GMM
estimation with cross sectional dependence", 1999): depth errors due to multipath, the lens and
motion are the same for neighbouring points, in all views of a place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from tofuse.engine.alignment import bounded_below, projective
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import run_chunks
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views import SampledView, pair_equations, shared_error
from tofuse.engine.views import residual_kernels

K = TypeVar("K", bound=tuple[int, int])
# Median distance between the surfaces of two cameras, m, and number of pixels, by pair a < b.
SurfaceDistances = dict[tuple[int, int], tuple[float, int]]

# Unknowns of a camera: its pose, in units of 1 cm and 1 degree, and its depth offset, in cm.
_SIZE = 7
_UNITS = np.append(projective.UNITS, 0.01)
# Coarse to fine, with decreasing noise inflation; until no unknown changes by more than this.
_ROUNDS = (
    pair_equations.Round(6, 0.03, 0.0),
    pair_equations.Round(6, 0.01, 0.0),
    pair_equations.Round(12, 0.0, 0.0),
)
_CONVERGENCE = 0.002
# Minimum fraction of a view's points that project onto surfaces of another one.
_OVERLAP = 0.04
# Prior standard deviation of a camera's depth offset. Data sheets specify about a centimetre.
_OFFSET_SIGMA_M = 0.01
_PAIRS_PER_CHUNK = 8
# Columns of a target's pixels and of a source's points.
_PLANE = slice(residual_kernels.PLANE, residual_kernels.PLANE + 3)
_NORMAL = slice(residual_kernels.NORMAL, residual_kernels.NORMAL + 3)
# Median of chi-square with one degree of freedom; limits of the noise scale of a pair of cameras.
_MEDIAN_OF_SQUARES = 0.455
_MIN_SCALE, _MAX_SCALE = 0.7, 30.0
_MIN_COMPARED = 50
# Points further from a surface than this fraction of the depth belong to a different surface.
_MAX_DISTANCE = 0.1
# Windows of plane fits overlap: number of pixels per independent noise value (half the smallest
# window, with which the covariances of simulated boards are consistent, see tests).
_CORRELATED_PIXELS = 12.0
# Correlation length of errors (to 1/e), and size of regions of space with equal errors, as
# fractions of the depth.
_REACH, _REGION = 0.31, 0.1
# As in `alignment.uncertainty`; largest sigma of a constrained direction, and the sigma of an
# unconstrained one, in units of 1 cm and 1 degree.
_STEEPNESS, _MAX_SIGMA, _UNCONSTRAINED_SIGMA = 0.3, 3.0, 30.0
# Standard deviation of the systematic error of a camera's ranges, as a fraction of the range:
# calibrated on simulated rigs with multipath (`benchmarks/rigs.py systematic`).
_SYSTEMATIC = 0.003


@dataclass(frozen=True, eq=False)
class RigView:
    """A view of a rig's camera at an instant."""

    camera: int
    instant: int
    sampled: SampledView


@dataclass(frozen=True, eq=False)
class JointPoses:
    """Refined poses and depth offsets of the cameras.

    Attributes
    ----------
    poses
        (K, 4, 4) T_rig_camera; the first is the identity.
    offsets
        (K,) amount by which each camera's ranges are too short relative to the first one's, m.
    covariance
        (K, 7, 7) marginal covariances of the right perturbation of the pose, and of the offset.
    random_covariance
        (K, 7, 7) the part of it due to random errors: systematic ones recur in the same scene.
    disagreement
        Distances between the surfaces of pairs of cameras.
    """

    poses: Float64
    offsets: Float64
    covariance: Float64
    random_covariance: Float64
    disagreement: SurfaceDistances = field(default_factory=dict)


def refine_together(views: Sequence[RigView], poses: Float64) -> JointPoses:
    """Optimise the poses and depth offsets of all cameras jointly.

    Parameters
    ----------
    views
        Views of all cameras.
    poses
        (K, 4, 4) initial T_rig_camera; the first is fixed.
    """
    return _optimised(views, poses, _OFFSET_SIGMA_M).placed()


def refined_poses(
    views: Sequence[RigView], poses: Float64, offset_sigma_m: float = _OFFSET_SIGMA_M
) -> Float64:
    """Return the poses (K, 4, 4) of `refine_together` alone, without covariances."""
    return _optimised(views, poses, offset_sigma_m).poses


def disagreements(views: Sequence[RigView], poses: Float64) -> SurfaceDistances:
    """Return the distances between the surfaces of cameras at poses (K, 4, 4)."""
    system = _System(views, poses, _OFFSET_SIGMA_M)
    return system.disagreement(system.compare())


def disagreements_of(
    views: Sequence[SampledView], camera: Intp, poses: Float64, pairs: Intp
) -> SurfaceDistances:
    """Return `disagreements` for pairs (M, 2) of views at any time with poses (N, 4, 4)."""
    return _medians(
        ((int(camera[i]), int(camera[j])), distances_between(views[i], views[j], T))
        for i, j in pairs
        if camera[i] != camera[j]
        for T in [se3.inverse(poses[i]) @ poses[j]]
    )


def distances_between(
    target: SampledView, source: SampledView, T_target_source: Float64
) -> Float64:
    """Return the (N,) distances in m between the surfaces visible in both views."""
    return np.abs(_residuals(target, source, T_target_source, _MAX_DISTANCE * target.depth).r)


def _grouped(parts: Iterable[tuple[K, Float64]]) -> dict[K, Float64]:
    """Return the concatenated arrays of each key, ordered by key."""
    lists: dict[K, list[Float64]] = {}
    for key, part in parts:
        lists.setdefault(key, []).append(part)
    return {key: np.concatenate(lists[key]) for key in sorted(lists)}


def _medians(distances: Iterable[tuple[tuple[int, int], Float64]]) -> SurfaceDistances:
    """Return the median and the number of the distances of each pair, in either direction."""
    by_pair = _grouped(((min(ends), max(ends)), part) for ends, part in distances)
    return {ends: (float(np.median(d)), len(d)) for ends, d in by_pair.items() if len(d)}


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Signed distances (N,) of a view's points from the planes of another one, and derivatives.

    Attributes
    ----------
    r, variance
        (N,) the distance in m, and its variance.
    p, m, s
        (N, 3) corrected source points, and in their frame the target's and the source's normals.
    by_source, by_target
        (N,) derivatives of the distance by the range offsets of source and target.
    """

    r: Float64
    variance: Float64
    p: Float64
    m: Float64
    s: Float64
    by_source: Float64
    by_target: Float64

    def __len__(self) -> int:
        return len(self.r)


def _residuals(
    target: SampledView,
    source: SampledView,
    T_target_source: Float64,
    limit_m: float,
    offsets: tuple[float, float] = (0.0, 0.0),
) -> _Residuals:
    """Compare points with the planes of the pixels that they project to, as `pair_equations` do.

    Distances above the limit are those of other surfaces. `offsets` are to be added to the ranges
    of the source and of the target.
    """
    image, lookup, frame = target.target_image
    points = np.asarray(source.points, np.float64)
    rays = points[:, :3] / np.linalg.norm(points[:, :3], axis=1, keepdims=True)
    p = points[:, :3] + offsets[0] * rays
    q = se3.transform(T_target_source, p)
    ahead = q[:, 2] > projection_kernels.MIN_DEPTH
    on_plane = q[:, :2] / np.where(ahead, q[:, 2], 1.0)[:, None]
    x, y = np.ascontiguousarray(on_plane.T, np.float32)
    u, v = np.empty((2, len(q)))
    projection_kernels.project_rays(x, y, lookup, frame, u, v)
    rows, columns = image.shape[:2]
    seen = ahead & (u > -0.5) & (v > -0.5) & (u < columns - 0.5) & (v < rows - 0.5)
    points, rays, p, q = points[seen], rays[seen], p[seen], q[seen]
    pixels = image[(v[seen] + 0.5).astype(int), (u[seen] + 0.5).astype(int)].astype(np.float64)
    n, distance = pixels[:, _PLANE], pixels[:, residual_kernels.DISTANCE]
    m, s = n @ T_target_source[:3, :3], points[:, _NORMAL]
    height = (n * q).sum(1)
    # The target's offset moves its plane along the ray of the pixel.
    by_target = -height / np.linalg.norm(q, axis=1)
    r = height - distance + offsets[1] * by_target
    sigma = (m * p).sum(1) * points[:, residual_kernels.SIGMA]
    variance = sigma**2 + pixels[:, residual_kernels.VARIANCE]
    near = (distance != 0) & (np.abs(r) < limit_m) & ((s * m).sum(1) >= projective.MIN_COSINE)
    parts = (r, variance, p, m, s, (m * rays).sum(1), by_target)
    return _Residuals(*(part[near & (variance > 0)] for part in parts))


def _optimised(views: Sequence[RigView], poses: Float64, offset_sigma_m: float) -> _System:
    system = _System(views, poses, offset_sigma_m)
    for stage in _ROUNDS:
        for _ in range(stage.iterations):
            if system.step(stage.inflation_m) < _CONVERGENCE:
                break
    return system


class _System:
    """The unknowns, and the compared pairs of views (target, source) with their cameras."""

    def __init__(self, views: Sequence[RigView], poses: Float64, offset_sigma_m: float) -> None:
        self.poses = np.array(poses, float)
        self.offsets = np.zeros(len(poses))
        self.pairs = [(a, b) for a in views for b in views if a.instant == b.instant and a is not b]
        self.ends = [(target.camera, source.camera) for target, source in self.pairs]
        self.scale = dict.fromkeys(self.ends, 3.0)
        self.depth = float(np.median([v.sampled.depth for v in views])) if views else 1.0
        self.prior = np.tile([*[0.0] * 6, (0.01 / offset_sigma_m) ** 2], len(poses))

    def compare(self) -> list[_Residuals]:
        """Return the residuals of each pair, and update the noise scales of the cameras."""
        rows = [_Residuals(*np.zeros((7, 0)))] * len(self.pairs)
        inverse = se3.inverse(self.poses)

        def work(first: int, last: int) -> None:
            for k in range(first, last):
                (target, source), (a, b) = self.pairs[k], self.ends[k]
                compared = _residuals(
                    target.sampled,
                    source.sampled,
                    inverse[a] @ self.poses[b],
                    _MAX_DISTANCE * self.depth,
                    (self.offsets[b], self.offsets[a]),
                )
                if len(compared) >= _OVERLAP * len(source.sampled.points):
                    rows[k] = compared

        run_chunks(work, len(self.pairs), -(-len(self.pairs) // _PAIRS_PER_CHUNK))
        ratios = [row.r**2 / row.variance for row in rows]
        for ends, squares in _grouped(zip(self.ends, ratios, strict=True)).items():
            if len(squares) >= _MIN_COMPARED:
                scale = np.sqrt(np.median(squares) / _MEDIAN_OF_SQUARES)
                self.scale[ends] = float(np.clip(scale, _MIN_SCALE, _MAX_SCALE))
        return rows

    def jacobian(self, k: int, row: _Residuals, normals: Float64) -> tuple[Float64, Intp]:
        """Return the (N, 14) derivatives of a pair by its cameras' unknowns, and their indices."""
        target, source = self.ends[k]
        T_source_target = se3.inverse(self.poses[source]) @ self.poses[target]
        J = np.concatenate([normals, np.cross(row.p, normals)], 1)
        by_offset = np.zeros((len(J), 1))
        J = np.concatenate([J, by_offset, -J @ se3.adjoint(T_source_target), by_offset], 1)
        unknowns = [_SIZE * camera + np.arange(_SIZE) for camera in (source, target)]
        return J * np.tile(_UNITS, 2), np.concatenate(unknowns)

    def by_mean(self, k: int, row: _Residuals) -> tuple[Float64, Intp]:
        """Return the derivatives with the mean of both normals, and those by the offsets."""
        J, at = self.jacobian(k, row, 0.5 * (row.m + row.s))
        J[:, 6] = row.by_source * _UNITS[6]
        J[:, 13] = row.by_target * _UNITS[6]
        return J, at

    def weights(self, k: int, row: _Residuals, inflation_m: float) -> tuple[Float64, Float64]:
        """Return Tukey's weights over the variance, and the derivative of the influence."""
        variance = row.variance * self.scale[self.ends[k]] ** 2
        variance += inflation_m**2
        e2 = row.r**2 / (variance * projective.ROBUST**2)
        return tukey.weights(e2) / variance, tukey.slopes(e2) / variance

    def step(self, inflation_m: float) -> float:
        """Make one Gauss-Newton step, and return the largest change, in units."""
        # Damping, so that an unconstrained camera does not move.
        H, g = np.diag(self.prior + 1e-3), np.zeros(len(self.prior))
        g[6::_SIZE] = self.prior[6::_SIZE] * self.offsets / 0.01
        for k, row in enumerate(self.compare()):
            if len(row):
                J, at = self.by_mean(k, row)
                w, _ = self.weights(k, row, inflation_m)
                H[np.ix_(at, at)] += _weighted(J, w)
                g[at] += J.T @ (w * row.r)
        H[np.diag_indices(len(H))] *= 1 + 1e-6
        step = -np.linalg.solve(H[_SIZE:, _SIZE:], g[_SIZE:])
        change = step.reshape(-1, _SIZE) * _UNITS
        self.poses[1:] = se3.orthonormalise(self.poses[1:] @ se3.exp(change[:, :6]))
        self.offsets[1:] += change[:, 6]
        return float(np.abs(step).max(initial=0.0))

    def placed(self) -> JointPoses:
        """Return the poses and offsets of the cameras, with covariances."""
        rows, count, size = self.compare(), len(self.poses), len(self.prior)
        plain, cross, noise = np.diag(self.prior), np.diag(self.prior), np.diag(self.prior)
        cells, gradients = [np.zeros((0, 3))], [np.zeros((0, size))]
        responses = np.zeros((count, shared_error.PATCHES, size))
        for k, row in enumerate(rows):
            if not len(row):
                continue
            J, at = self.by_mean(k, row)
            D, _ = self.jacobian(k, row, 0.5 * (row.m - row.s))
            w, slope = self.weights(k, row, 0.0)
            block = np.ix_(at, at)
            plain[block] += _weighted(J, w) - _weighted(D, w)
            cross[block] += _weighted(J, slope) - _weighted(D, slope)
            noise[block] += _redundancy(self.pairs[k][1].sampled) * _weighted(J, (w * row.r) ** 2)
            weighted = np.zeros((len(row), size))
            weighted[:, at] = J * w[:, None]
            positions = se3.transform(self.poses[self.ends[k][1]], row.p) / self.depth
            cell, gradient = _sums(np.floor(positions / _REGION), weighted * row.r[:, None])
            cells.append(cell)
            gradients.append(gradient)
            self._add_responses(k, row, weighted, responses)
        random = systematic = np.full((size - _SIZE, size - _SIZE), np.nan)
        if len(cells) > 1:
            noise += _correlated(np.concatenate(cells), np.concatenate(gradients))
            free = slice(_SIZE, None)
            bread, unconstrained = _inverse_slope(plain[free, free], cross[free, free])
            random = bread @ noise[free, free] @ bread + unconstrained
            systematic = bread @ self._systematic(responses)[free, free] @ bread
        return JointPoses(
            self.poses,
            self.offsets,
            self._marginals(random + systematic),
            self._marginals(random),
            self.disagreement(rows),
        )

    def _add_responses(
        self, k: int, row: _Residuals, weighted: Float64, responses: Float64
    ) -> None:
        """Add a pair's response of the gradient to relative range errors, by camera and patch.

        Parameters
        ----------
        k, row
            A pair and its residual rows.
        weighted
            (N, 7 K) weighted derivatives by all unknowns.
        responses
            (K, PATCHES, 7 K) sums, updated in place.
        """
        (target, source), (a, b) = self.pairs[k], self.ends[k]
        q = se3.transform(se3.inverse(self.poses[a]) @ self.poses[b], row.p)
        for view, points, by_offset in ((source, row.p, row.by_source), (target, q, row.by_target)):
            by_error = by_offset * np.linalg.norm(points, axis=1)
            patch = shared_error.patches_of(points, view.sampled.projection)
            np.add.at(responses[view.camera], patch, weighted * by_error[:, None])

    def _systematic(self, responses: Float64) -> Float64:
        """Return the covariance of the gradient due to systematic range errors of each camera."""
        shapes = {view.camera: view.sampled.shape for view, _ in self.pairs}
        # Twice the correlation length of errors that cause residuals, as in the tracker.
        roots = {c: np.sqrt(shared_error.patch_correlation(s)) for c, s in shapes.items()}
        parts = [responses[c].T @ root @ responses[c] for c, root in roots.items()]
        return np.asarray(_SYSTEMATIC**2 * np.sum(parts, axis=0), np.float64)

    def _marginals(self, C: Float64) -> Float64:
        """Return the (K, 7, 7) blocks of the cameras, m and rad; the first camera is fixed."""
        blocks = np.zeros((len(self.poses), _SIZE, _SIZE))
        for c in range(1, len(blocks)):
            block = slice(_SIZE * (c - 1), _SIZE * c)
            blocks[c] = 0.5 * (C[block, block] + C[block, block].T) * np.outer(_UNITS, _UNITS)
        return blocks

    def disagreement(self, rows: Sequence[_Residuals]) -> SurfaceDistances:
        """See `disagreements`."""
        return _medians(zip(self.ends, [np.abs(row.r) for row in rows], strict=True))


def _weighted(J: Float64, w: Float64) -> Float64:
    return np.asarray((J * w[:, None]).T @ J, np.float64)


def _redundancy(source: SampledView) -> float:
    """Return the number of residuals of a pair per independent noise value.

    Windows of neighbouring pixels overlap, and the pair is compared in both directions.
    """
    pixels = max(math.prod(source.shape), 1)
    return 2 * max(1.0, _CORRELATED_PIXELS * len(source.points) / pixels)


def _sums(cells: Float64, rows: Float64) -> tuple[Float64, Float64]:
    """Return the distinct cells (R, 3), and the sums (R, n) of the rows (N, n) in each."""
    distinct, inverse = np.unique(cells, axis=0, return_inverse=True)
    out = np.zeros((len(distinct), rows.shape[1]))
    np.add.at(out, inverse.ravel(), rows)
    return distinct, out


def _correlated(cells: Float64, gradients: Float64) -> Float64:
    """Return the covariance (n, n) of the gradient due to residuals that are correlated in space.

    `gradients` (R, n) are the sums in cells (R, 3), which are repeated for each pair.
    """
    distinct, g = _sums(cells, gradients)
    distance = _REGION * np.linalg.norm(distinct[:, None] - distinct[None], axis=2)
    return np.asarray(g.T @ np.exp(-distance / _REACH) @ g, np.float64)


def _inverse_slope(plain: Float64, cross: Float64) -> tuple[Float64, Float64]:
    """Return the inverse of the gradient's derivative, and the covariance where that vanishes.

    Directions beyond the largest sigma are unconstrained: their information is noise of normals.
    `plain` and `cross` are the Hessians (n, n) without and with robust weights, in units.
    """
    plain, cross = 0.5 * (plain + plain.T), 0.5 * (cross + cross.T)
    X = bounded_below(cross, plain, _STEEPNESS, _MAX_SIGMA**-2)
    values, vectors = np.linalg.eigh(plain)
    weak, strong = vectors[:, values < _MAX_SIGMA**-2], vectors[:, values >= _MAX_SIGMA**-2]
    inverse = strong @ np.linalg.inv(strong.T @ X @ strong) @ strong.T
    return inverse, _UNCONSTRAINED_SIGMA**2 * weak @ weak.T
