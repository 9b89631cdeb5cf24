"""Joint calibration of all cameras of a rig: their poses and depth offsets, with covariances.

Overlapping views of different cameras are compared in both directions. As the cameras are fixed to
each other, all instants share the unknowns: a pose and a depth offset for each camera but the
first. The covariance is that of an M-estimator with spatially correlated errors (Conley, "GMM
estimation with cross sectional dependence", 1999): depth errors due to multipath, the lens and
motion are the same for neighbouring points, in all views of a place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tofuse.apps.rigs import rig_residual_kernels as kernels
from tofuse.apps.rigs.joint_covariance import by_region, correlated, inverse_slope
from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.compute import run_chunks
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views import SampledView, pair_equations, shared_error

# Unknowns of a camera: its pose, in units of 1 cm and 1 degree, and its depth offset, in cm.
_SIZE = 7
_UNITS = np.append(projective.UNITS, 0.01)
_PAIRS_PER_CHUNK = 8
# Median of chi-square with one degree of freedom; limits of the noise scale of a pair of cameras.
_MEDIAN_OF_SQUARES = 0.455
_MIN_SCALE, _MAX_SCALE = 0.7, 30.0
_MIN_COMPARED = 50
# Points further from a surface than this fraction of the depth belong to a different surface.
_MAX_DISTANCE = 0.1
# Windows of plane fits overlap: number of pixels per independent noise value (half the smallest
# window, with which the covariances of simulated boards are consistent, see tests).
_CORRELATED_PIXELS = 12.0


@dataclass(frozen=True)
class JointOptions:
    """Options of the joint refinement of a rig's cameras.

    Attributes
    ----------
    rounds
        Coarse to fine, with decreasing noise inflation.
    robust, max_angle
        As in `ProjectiveOptions`.
    overlap
        Minimum fraction of a view's points that project onto surfaces of another one.
    offset_sigma_m
        Prior standard deviation of a camera's depth offset. Data sheets specify about a centimetre.
    reach
        Correlation length of errors (to 1/e), as a fraction of the depth.
    steepness
        As in `registration.uncertainty`.
    systematic
        Standard deviation of the systematic error of a camera's ranges, as a fraction of the range:
        calibrated on simulated rigs with multipath (`benchmarks/rigs.py systematic`).
    convergence
        Iterations stop when no unknown changes by more than this, in units of 1 cm and 1 degree.
    """

    rounds: tuple[pair_equations.Round, ...] = (
        pair_equations.Round(6, 0.03, 0.0),
        pair_equations.Round(6, 0.01, 0.0),
        pair_equations.Round(12, 0.0, 0.0),
    )
    robust: float = 3.5
    max_angle: float = 0.7
    overlap: float = 0.04
    offset_sigma_m: float = 0.01
    reach: float = 0.31
    steepness: float = 0.3
    systematic: float = 0.003
    convergence: float = 0.002


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
        By pair of cameras (a, b), a < b: median distance between their surfaces in m, and number of
        compared pixels.
    """

    poses: Float64
    offsets: Float64
    covariance: Float64
    random_covariance: Float64
    disagreement: dict[tuple[int, int], tuple[float, int]] = field(default_factory=dict)


def refine_together(views: Sequence[RigView], poses: Float64) -> JointPoses:
    """Optimise the poses and depth offsets of all cameras jointly.

    Parameters
    ----------
    views
        Views of all cameras.
    poses
        (K, 4, 4) initial T_rig_camera; the first is fixed.
    """
    return _optimised(views, poses, JointOptions()).placed()


def refined_poses(
    views: Sequence[RigView], poses: Float64, options: JointOptions | None = None
) -> Float64:
    """Return the poses (K, 4, 4) of `refine_together` alone, without covariances."""
    return _optimised(views, poses, options or JointOptions()).poses


def disagreements(
    views: Sequence[RigView], poses: Float64
) -> dict[tuple[int, int], tuple[float, int]]:
    """Return, by pair of cameras, the median distance between surfaces in m and the pixel count."""
    system = _System(views, poses, JointOptions())
    return system.disagreement(system.compare())


def disagreements_of(
    views: Sequence[SampledView], camera: Intp, poses: Float64, pairs: Intp
) -> dict[tuple[int, int], tuple[float, int]]:
    """Return `disagreements` for pairs (M, 2) of views at any time with poses (N, 4, 4)."""
    distances: dict[tuple[int, int], list[Float64]] = {}
    for i, j in pairs:
        a, b = sorted((int(camera[i]), int(camera[j])))
        if a != b:
            T = se3.inverse(poses[i]) @ poses[j]
            distances.setdefault((a, b), []).append(distances_between(views[i], views[j], T))
    return _medians(distances)


def _medians(
    distances: Mapping[tuple[int, int], Sequence[Float64]],
) -> dict[tuple[int, int], tuple[float, int]]:
    """Return the median and the number of the distances of each pair, in order of the pairs."""
    by_pair = {ends: np.concatenate(parts) for ends, parts in sorted(distances.items())}
    return {ends: (float(np.median(d)), len(d)) for ends, d in by_pair.items() if len(d)}


def distances_between(
    target: SampledView, source: SampledView, T_target_source: Float64
) -> Float64:
    """Return the (N,) distances in m between the surfaces visible in both views."""
    limit_m = _MAX_DISTANCE * target.depth
    rows = _residual_rows(target, source, T_target_source, (0.0, 0.0), JointOptions(), limit_m)
    return np.abs(rows[:, kernels.RESIDUAL])


def _residual_rows(
    target: SampledView,
    source: SampledView,
    T_target_source: Float64,
    offsets: tuple[float, float],
    options: JointOptions,
    limit_m: float,
) -> Float64:
    """Return the residual rows of corresponding points: larger distances are of other surfaces.

    `offsets` are those of the source and of the target.
    """
    rows = np.empty((len(source.points), kernels.ROW))
    kernels.residuals(
        source.points,
        target.target_image,
        np.ascontiguousarray(T_target_source),
        *offsets,
        float(np.cos(options.max_angle)),
        rows,
    )
    near = np.abs(rows[:, kernels.RESIDUAL]) < limit_m
    return np.asarray(rows[(rows[:, kernels.RESIDUAL_VARIANCE] > 0) & near], np.float64)


def _optimised(views: Sequence[RigView], poses: Float64, options: JointOptions) -> _System:
    system = _System(views, poses, options)
    for stage in options.rounds:
        for _ in range(stage.iterations):
            if system.step(stage.inflation_m) < options.convergence:
                break
    return system


class _System:
    """The unknowns, and the compared pairs of views."""

    def __init__(self, views: Sequence[RigView], poses: Float64, options: JointOptions) -> None:
        self.options = options
        self.views = views
        self.poses = np.array(poses, float)
        self.offsets = np.zeros(len(poses))
        by_instant: dict[int, list[int]] = {}
        for k, view in enumerate(views):
            by_instant.setdefault(view.instant, []).append(k)
        self.pairs = [(i, j) for same in by_instant.values() for i in same for j in same if i != j]
        count = len(poses)
        self.scale = np.full((count, count), 3.0)
        depths = [view.sampled.depth for view in views]
        self.depth = float(np.median(depths)) if depths else 1.0

    def compare(self) -> list[Float64]:
        """Return the residual rows of each pair (target, source): close correspondences only."""
        rows: list[Float64] = [np.zeros((0, kernels.ROW))] * len(self.pairs)
        inverse = se3.inverse(self.poses)

        def work(a: int, b: int) -> None:
            for k in range(a, b):
                target, source = (self.views[i] for i in self.pairs[k])
                compared = _residual_rows(
                    target.sampled,
                    source.sampled,
                    inverse[target.camera] @ self.poses[source.camera],
                    (self.offsets[source.camera], self.offsets[target.camera]),
                    self.options,
                    _MAX_DISTANCE * self.depth,
                )
                if len(compared) >= self.options.overlap * len(source.sampled.points):
                    rows[k] = compared

        run_chunks(work, len(self.pairs), -(-len(self.pairs) // _PAIRS_PER_CHUNK))
        return rows

    def rescale(self, rows: Sequence[Float64]) -> None:
        """Estimate the noise scale of each camera pair from the distances between surfaces."""
        count = len(self.poses)
        ratios: dict[tuple[int, int], list[Float64]] = {}
        for (i, j), row in zip(self.pairs, rows, strict=True):
            ends = self.views[i].camera, self.views[j].camera
            ratios.setdefault(ends, []).append(
                row[:, kernels.RESIDUAL] ** 2 / row[:, kernels.RESIDUAL_VARIANCE]
            )
        for a in range(count):
            for b in range(count):
                normalised = np.concatenate(ratios.get((a, b), [np.zeros(0)]))
                if len(normalised) >= _MIN_COMPARED:
                    scale = np.sqrt(np.median(normalised) / _MEDIAN_OF_SQUARES)
                    self.scale[a, b] = np.clip(scale, _MIN_SCALE, _MAX_SCALE)

    def jacobian(self, k: int, row: Float64) -> tuple[Float64, Float64]:
        """Return the (N, 14) derivatives by the source's and the target's unknowns.

        The first uses the mean of both normals, the second half of their difference.
        """
        target, source = (self.views[i].camera for i in self.pairs[k])
        p = row[:, kernels.SOURCE_POINT : kernels.SOURCE_POINT + 3]
        m = row[:, kernels.TARGET_NORMAL : kernels.TARGET_NORMAL + 3]
        s = row[:, kernels.SOURCE_NORMAL : kernels.SOURCE_NORMAL + 3]
        T_source_target = se3.inverse(self.poses[source]) @ self.poses[target]
        by_target = -se3.adjoint(T_source_target)
        out = []
        for normal in (0.5 * (m + s), 0.5 * (m - s)):
            J = np.concatenate([normal, np.cross(p, normal)], 1)
            out.append(
                np.concatenate([J, np.zeros((len(J), 1)), J @ by_target, np.zeros((len(J), 1))], 1)
            )
        by_mean, by_difference = out
        by_mean[:, 6] = row[:, kernels.BY_SOURCE_OFFSET]
        by_mean[:, 13] = row[:, kernels.BY_TARGET_OFFSET]
        return by_mean * np.tile(_UNITS, 2), by_difference * np.tile(_UNITS, 2)

    def unknowns(self, k: int) -> Intp:
        """Return the (14,) indices of the unknowns of a pair's cameras."""
        target, source = (self.views[i].camera for i in self.pairs[k])
        return np.concatenate(
            [_SIZE * source + np.arange(_SIZE), _SIZE * target + np.arange(_SIZE)]
        )

    def step(self, inflation_m: float) -> float:
        """Make one Gauss-Newton step, and return the largest change, in units."""
        rows = self.compare()
        self.rescale(rows)
        size = _SIZE * len(self.poses)
        H, g = np.zeros((size, size)), np.zeros(size)
        for k, row in enumerate(rows):
            if not len(row):
                continue
            J, _ = self.jacobian(k, row)
            w, _ = self.weights(k, row, inflation_m)
            at = self.unknowns(k)
            H[np.ix_(at, at)] += (J * w[:, None]).T @ J
            g[at] += J.T @ (w * row[:, kernels.RESIDUAL])
        prior = np.tile(self._prior(), len(self.poses))
        H[np.diag_indices(size)] += prior
        g[6::_SIZE] += prior[6::_SIZE] * self.offsets / 0.01
        free = np.arange(_SIZE, size)
        H = H[np.ix_(free, free)]
        # Damping, so that an unconstrained camera does not move.
        H[np.diag_indices(len(H))] += 1e-3 + 1e-6 * H.diagonal()
        step = np.asarray(-np.linalg.solve(H, g[free]), np.float64)
        self._move(step)
        return float(np.abs(step).max(initial=0.0))

    def _move(self, step: Float64) -> None:
        """Update poses and offsets of all cameras but the first by (7 (K - 1),), in units."""
        change = step.reshape(-1, _SIZE) * _UNITS
        self.poses[1:] = se3.orthonormalise(self.poses[1:] @ se3.exp(change[:, :6]))
        self.offsets[1:] += change[:, 6]

    def weights(self, k: int, row: Float64, inflation_m: float) -> tuple[Float64, Float64]:
        """Return Tukey's weights over the variance, and the derivative of the influence."""
        target, source = (self.views[i].camera for i in self.pairs[k])
        variance = (
            row[:, kernels.RESIDUAL_VARIANCE] * self.scale[target, source] ** 2 + inflation_m**2
        )
        e2 = row[:, kernels.RESIDUAL] ** 2 / (variance * self.options.robust**2)
        return tukey.weights(e2) / variance, tukey.slopes(e2) / variance

    def _prior(self) -> Float64:
        """Return the (7,) information of a camera's prior, in units."""
        return np.array([0.0] * 6 + [(0.01 / self.options.offset_sigma_m) ** 2])

    def placed(self) -> JointPoses:
        """Return the poses and offsets of the cameras, with covariances."""
        rows = self.compare()
        self.rescale(rows)
        count, size = len(self.poses), _SIZE * len(self.poses)
        plain, cross = np.zeros((size, size)), np.zeros((size, size))
        noise = np.zeros((size, size))
        regions, gradients = [], []
        responses = np.zeros((count, shared_error.PATCHES, size))
        for k, row in enumerate(rows):
            if not len(row):
                continue
            J, D = self.jacobian(k, row)
            w, slope = self.weights(k, row, 0.0)
            at = self.unknowns(k)
            plain[np.ix_(at, at)] += (J * w[:, None]).T @ J - (D * w[:, None]).T @ D
            cross[np.ix_(at, at)] += (J * slope[:, None]).T @ J - (D * slope[:, None]).T @ D
            r = row[:, kernels.RESIDUAL]
            noise[np.ix_(at, at)] += self._redundancy(k) * (J * (w * w * r * r)[:, None]).T @ J
            gradient = np.zeros((len(row), size))
            gradient[:, at] = J * (w * r)[:, None]
            source = self.views[self.pairs[k][1]].camera
            positions = se3.transform(
                self.poses[source], row[:, kernels.SOURCE_POINT : kernels.SOURCE_POINT + 3]
            )
            positions /= self.depth
            region, summed = by_region(positions, gradient)
            regions.append(region)
            gradients.append(summed)
            self._add_responses(responses, k, row, J * w[:, None])
        random = systematic = np.full((size - _SIZE, size - _SIZE), np.nan)
        if regions:
            free = slice(_SIZE, None)
            B = noise[free, free] + np.diag(np.tile(self._prior(), count - 1))
            B += correlated(
                np.concatenate(regions), np.concatenate(gradients)[:, free], self.options.reach
            )
            for matrix in (plain, cross):
                matrix[np.diag_indices(size)] += np.tile(self._prior(), count)
            bread, unconstrained = inverse_slope(
                plain[free, free], cross[free, free], self.options.steepness
            )
            random = bread @ B @ bread + unconstrained
            systematic = bread @ self._systematic(responses[:, :, free]) @ bread
        return JointPoses(
            self.poses,
            self.offsets,
            self._marginals(random + systematic),
            self._marginals(random),
            self.disagreement(rows),
        )

    def _marginals(self, C: Float64) -> Float64:
        """Return the (K, 7, 7) blocks of the cameras, m and rad; the first camera is fixed."""
        blocks = np.zeros((len(self.poses), _SIZE, _SIZE))
        for c in range(1, len(blocks)):
            block = slice(_SIZE * (c - 1), _SIZE * c)
            blocks[c] = 0.5 * (C[block, block] + C[block, block].T) * np.outer(_UNITS, _UNITS)
        return blocks

    def _systematic(self, responses: Float64) -> Float64:
        """Return the covariance of the gradient due to systematic range errors of each camera.

        Parameters
        ----------
        responses
            (K, PATCHES, n) of the gradient to a relative error of each patch.
        """
        shapes = {view.camera: view.sampled.shape for view in self.views}
        B = np.zeros((responses.shape[2],) * 2)
        for camera, shape in shapes.items():
            # Twice the correlation length of errors that cause residuals, as in the tracker.
            correlation = np.sqrt(shared_error.patch_correlation(shape))
            L = self.options.systematic * responses[camera]
            B += L.T @ correlation @ L
        return B

    def _add_responses(self, responses: Float64, k: int, row: Float64, weighted: Float64) -> None:
        """Add a pair's response of the gradient to relative range errors, by camera and patch.

        Parameters
        ----------
        responses
            (K, PATCHES, 7 K) sums, updated in place.
        k, row
            A pair and its residual rows.
        weighted
            (N, 14) its weighted derivatives, see `jacobian`.
        """
        target, source = (self.views[i] for i in self.pairs[k])
        p = row[:, kernels.SOURCE_POINT : kernels.SOURCE_POINT + 3]
        T_target_source = se3.inverse(self.poses[target.camera]) @ self.poses[source.camera]
        q = se3.transform(T_target_source, p)
        at = self.unknowns(k)
        ends = (source, p, kernels.BY_SOURCE_OFFSET), (target, q, kernels.BY_TARGET_OFFSET)
        for view, points, column in ends:
            by_error = row[:, column] * np.linalg.norm(points, axis=1)
            patch = shared_error.patches_of(points, view.sampled.projection)
            sums = np.zeros((shared_error.PATCHES, weighted.shape[1]))
            np.add.at(sums, patch, weighted * by_error[:, None])
            responses[view.camera][:, at] += sums

    def _redundancy(self, k: int) -> float:
        """Return the number of residuals of a pair per independent noise value.

        Windows of neighbouring pixels overlap, and the pair is compared in both directions.
        """
        source = self.views[self.pairs[k][1]].sampled
        return 2 * max(
            1.0, _CORRELATED_PIXELS * len(source.points) / max(math.prod(source.shape), 1)
        )

    def disagreement(self, rows: Sequence[Float64]) -> dict[tuple[int, int], tuple[float, int]]:
        """See `disagreements`."""
        distances: dict[tuple[int, int], list[Float64]] = {}
        for (i, j), row in zip(self.pairs, rows, strict=True):
            a, b = sorted((self.views[i].camera, self.views[j].camera))
            distances.setdefault((a, b), []).append(np.abs(row[:, kernels.RESIDUAL]))
        return _medians(distances)
