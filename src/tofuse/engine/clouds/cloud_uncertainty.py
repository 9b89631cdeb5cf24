"""Covariance of the pose between two point clouds.

As for images (`alignment.uncertainty`) the covariance is that of an M-estimate, ``X^-1 B X^-1``
(Huber 1981, ch. 6): X is the Hessian, from the product of both views' normals, in which their
noise cancels, and B the covariance of the gradient. The error model of a cloud is unknown, so B is
estimated from the residuals at the final pose. The relative distortion of the clouds, by
multipath, range errors or sampling, is modelled as a random field of displacements, whose
components have the covariance ``s^2 exp(-d / l)`` over the distance d. A residual is the
displacement along its normal, plus white noise.

The part of the field that equals a rigid motion is absorbed by the pose and invisible in the
residuals; its size follows from s and l, which are estimated from the rest (restricted likelihood:
Patterson and Thompson 1971). The covariance is marginalised over s and l on a grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.clouds.cloud_agreement import NEIGHBOURS, CloudMap, are_oriented
from tofuse.engine.geometry import se3, unit_vectors
from tofuse.engine.icp import surface_metrics
from tofuse.engine.normal import robust_sigma

# Maximum distance of corresponding points, in resolutions, and minimum cosine between their
# normals.
_MAX_DISTANCE, _MIN_NORMAL_COSINE = 3.0, 0.75
# Patches: minimum edge in resolutions and its growth factor; maximum number, and minimum number for
# an estimate of the field.
_MIN_EDGE, _EDGE_GROWTH = 2.0, 1.05
_MAX_PATCHES, _MIN_PATCHES = 120, 12
# Grid of variances of the field, relative to that of the noise of a patch.
_RATIOS = np.r_[0.0, np.geomspace(0.03, 300.0, 9)]
# Grid of correlation lengths, from the patches' edge to this many sizes of the overlap: distortions
# may be correlated beyond it.
_LENGTHS, _MAX_LENGTH = 5, 4.0
# Lower limit of the Hessian relative to the Gauss-Newton approximation, and number of points of its
# finite differences.
_STEEPNESS, _DIFFERENCE_POINTS = 0.1, 1500
# Lower limit of the residuals' sigma, as a fraction of the resolution.
_MIN_SIGMA = 1e-3
# Sigma along degenerate directions, in sizes of the overlap, or in rad.
_UNBOUNDED = 100.0
# Singular values below this fraction of the largest are zero.
_NEGLIGIBLE = 1e-9


def cloud_information(
    source: CloudMap, target: CloudMap, T_target_source: Float64, unobservable: Float64
) -> Float64:
    """Return the information (6, 6) of a pose (4, 4), in 1/m and 1/rad, right perturbation.

    It is the inverse of the covariance, and nearly zero along the `unobservable` directions (k, 6).
    """
    pairs = _Pairs.of(source, target, T_target_source)
    if pairs is None:
        size = max(float(np.linalg.norm(np.ptp(source.view.points, axis=0))), source.size)
        return np.diag((_UNBOUNDED * np.r_[[size] * 3, [1.0] * 3]) ** -2.0)
    T_centre_source = se3.translation(-pairs.centre)
    # From the perturbation about the origin to that about the centroid, in units in which rotations
    # move the points as far as translations.
    unit = np.array([1, 1, 1, *[1 / pairs.size] * 3])
    to_centre = se3.adjoint(T_centre_source) / unit[:, None]
    hessian = _hessian(source, target, T_target_source, pairs, unit)
    H = to_centre.T @ _information(pairs, hessian, unit, unobservable @ to_centre.T) @ to_centre
    return np.asarray(0.5 * (H + H.T), np.float64)


def cloud_unobservable(source: CloudMap, target: CloudMap, T_target_source: Float64) -> Float64:
    """Return the degenerate directions (k, 6) of the right perturbation at a pose (4, 4)."""
    pairs = _Pairs.of(source, target, T_target_source)
    if pairs is None:
        return np.eye(6)
    surface = surface_metrics.SurfacePairs(
        T_target_source,
        pairs.centre,
        pairs.points,
        pairs.residual[:, None] * pairs.normals,
        pairs.target_normals,
        pairs.source_normals,
        pairs.weight,
        pairs.resolution,
    )
    return surface_metrics.unobservable_directions(surface, pairs.noise**2)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Correspondences and their point-to-plane residuals, in the source's frame.

    Attributes
    ----------
    centre, size
        (3,) centroid of the points, and their rms distance from it, m.
    points
        (m, 3) relative to it.
    residual
        (m,) distance along the normal, m.
    normals, target_normals, source_normals
        (m, 3) mean of both, and each; consistently oriented.
    weight
        (m,) of the robust loss.
    resolution
        Voxel size of the averaged clouds, m.
    """

    centre: Float64
    size: float
    points: Float64
    residual: Float64
    normals: Float64
    target_normals: Float64
    source_normals: Float64
    weight: Float64
    resolution: float

    @classmethod
    def of(cls, source: CloudMap, target: CloudMap, T: Float64, stride: int = 1) -> _Pairs | None:
        """Match every n-th point with its nearest target point; None if there are too few."""
        size = max(source.size, target.size)
        p = source.view.points[::stride].astype(np.float64)
        nearest, _ = target.tree.nearest(se3.transform(T, p), _MAX_DISTANCE * size)
        R, j = T[:3, :3], np.maximum(nearest, 0)
        a, b = target.normals[j] @ R, source.normals[::stride]
        q = se3.transform(se3.inverse(T), target.view.points[j].astype(np.float64))
        cosine = (a * b).sum(1)
        alike = cosine if are_oriented(source, target) else np.abs(cosine)
        matched = (nearest >= 0) & (alike > _MIN_NORMAL_COSINE)  # false for NaN
        if np.count_nonzero(matched) < surface_metrics.MIN_PAIRS:
            return None
        p, q, a = p[matched], q[matched], a[matched]
        b = b[matched] * np.sign(cosine[matched])[:, None]
        # Of a normal and its opposite the one with its largest component positive.
        n = unit_vectors(a + b)
        largest = np.take_along_axis(n, np.abs(n).argmax(1)[:, None], 1)
        n, a, b = (v * np.sign(largest) for v in (n, a, b))
        r = ((p - q) * n).sum(1)
        centre = p.mean(0)
        p = p - centre
        spread = max(float(np.sqrt((p**2).sum(1).mean())), size)
        return cls(
            centre, spread, p, r, n, a, b, surface_metrics.loss_weights("tukey", r, size), size
        )

    @property
    def noise(self) -> float:
        """Robust standard deviation of the residuals, m."""
        return max(robust_sigma(self.residual), _MIN_SIGMA * self.resolution)

    def cross_information(self, unit: Float64) -> Float64:
        """Sum of w times the symmetrised product of both Jacobians (6, 6), where noise cancels."""
        Ja = _jacobian(self.points, self.target_normals) * unit
        Jb = _jacobian(self.points, self.source_normals) * unit
        X = (Ja * self.weight[:, None]).T @ Jb
        return np.asarray(0.5 * (X + X.T), np.float64)

    def plain_information(self, unit: Float64) -> Float64:
        """(6, 6) sum of w J^T J."""
        J = _jacobian(self.points, self.normals) * unit
        return np.asarray((J * self.weight[:, None]).T @ J, np.float64)

    def gradient(self, centre: Float64, unit: Float64) -> Float64:
        """Sum of w J r (6,) about another centre (3,)."""
        J = _jacobian(self.points + (self.centre - centre), self.normals) * unit
        return np.asarray((self.weight * self.residual) @ J, np.float64)


def _jacobian(points: Float64, normals: Float64) -> Float64:
    """Derivative (m, 6) of point-to-plane distances by the right perturbation."""
    return np.concatenate([normals, np.cross(points, normals)], axis=1)


@dataclass(frozen=True, eq=False)
class _Patches:
    """Means over patches of the overlap.

    Attributes
    ----------
    positions, normals
        (n, 3) centroids in m, and mean normals, shorter than 1 where the surface is curved.
    residual
        (n,) m.
    responses
        (n, 6) mean J.
    weight
        (n,) sums of w.
    edge
        Of the patches, m.
    """

    positions: Float64
    normals: Float64
    residual: Float64
    responses: Float64
    weight: Float64
    edge: float

    @classmethod
    def of(cls, pairs: _Pairs, unit: Float64) -> _Patches:
        """Group points by voxel and by the dominant axis of their normals."""
        dominant_axis = np.abs(pairs.normals).argmax(1).astype(np.int64)
        edge = _MIN_EDGE * pairs.resolution
        while True:
            cell = np.floor(pairs.points / edge).astype(np.int64)
            cell -= cell.min(0)
            _, rows, layers = cell.max(0) + 1
            key = ((cell[:, 0] * rows + cell[:, 1]) * layers + cell[:, 2]) * 3 + dominant_axis
            patch = np.unique(key, return_inverse=True)[1]
            count = int(patch.max()) + 1
            if count <= _MAX_PATCHES:
                break
            edge *= _EDGE_GROWTH * float(np.sqrt(count / _MAX_PATCHES))
        total = np.bincount(patch, pairs.weight)
        valid = total > 0

        def mean(values: Float64) -> Float64:
            columns = values.reshape(len(values), -1).T
            sums = [np.bincount(patch, pairs.weight * c) for c in columns]
            return np.stack(sums, -1)[valid] / total[valid, None]

        J = _jacobian(pairs.points, pairs.normals) * unit
        return cls(
            mean(pairs.points),
            mean(pairs.normals),
            mean(pairs.residual)[:, 0],
            mean(J),
            np.asarray(total[valid], np.float64),
            edge,
        )


def _information(pairs: _Pairs, hessian: Float64, unit: Float64, unobservable: Float64) -> Float64:
    """Return the information (6, 6) about the centroid, degenerate along `unobservable` (k, 6)."""
    constrained = _complement(unobservable, np.eye(6))
    patches = _Patches.of(pairs, unit)
    has_field = len(patches.residual) >= _MIN_PATCHES
    if has_field and constrained.shape[1]:  # patches may leave more motions open
        _, s, vt = np.linalg.svd(patches.responses @ constrained, full_matrices=False)
        constrained = _complement(vt[s <= _NEGLIGIBLE * s[0]] @ constrained.T, constrained)
    H = (np.eye(6) - constrained @ constrained.T) / (_UNBOUNDED * pairs.size) ** 2
    if not constrained.shape[1]:
        return H
    if has_field:
        meat = _posterior_meat(patches, patches.responses @ constrained)
    else:  # too few patches for the field: assume neighbourhoods to be fully correlated
        meat = (
            NEIGHBOURS
            * pairs.noise**2
            * constrained.T
            @ pairs.plain_information(unit)
            @ constrained
        )
    bread = np.linalg.inv(constrained.T @ hessian @ constrained)
    # A pose from another estimator is not the minimum: half the squared difference of the two
    # estimates is their common variance.
    step = bread @ constrained.T @ pairs.gradient(pairs.centre, unit)
    C = bread @ meat @ bread + 0.5 * np.outer(step, step)
    C += (_MIN_SIGMA * pairs.resolution) ** 2 / len(pairs.points) * np.eye(len(C))
    return np.asarray(H + constrained @ np.linalg.inv(C) @ constrained.T, np.float64)


def _complement(directions: Float64, within: Float64) -> Float64:
    """Return a basis (6, m) of what is perpendicular to directions (k, 6), within a basis."""
    if not len(directions):
        return within
    _, s, vt = np.linalg.svd(directions @ within)
    return within @ vt[int((s > _NEGLIGIBLE * s[0]).sum()) :].T


def _hessian(
    source: CloudMap, target: CloudMap, T: Float64, pairs: _Pairs, unit: Float64
) -> Float64:
    """Return X (6, 6), the derivative of the gradient ``sum w J r``, matches updated.

    Where noise is as large as the point spacing, nearest neighbours follow the pose and the
    gradient is less steep than with fixed matches, so X is computed by finite differences.
    """
    stride = max(1, len(source.view.points) // _DIFFERENCE_POINTS)
    T_source_centre = se3.translation(pairs.centre)
    T_centre_source = se3.translation(-pairs.centre)
    plain, cross = pairs.plain_information(unit), pairs.cross_information(unit)
    values, vectors = np.linalg.eigh(plain)
    values = np.maximum(values, 1e-9 * values[-1])
    root, inverse = (vectors * np.sqrt(values)) @ vectors.T, (vectors / np.sqrt(values)) @ vectors.T
    step = pairs.noise
    derivative = np.zeros((6, 6))
    total = 0.0
    for k, direction in enumerate(vectors.T):
        gradients = []
        for sign in (1.0, -1.0):
            T_moved = (
                T @ T_source_centre @ se3.exp(sign * step * direction * unit) @ T_centre_source
            )
            moved_pairs = _Pairs.of(source, target, T_moved, stride)
            if moved_pairs is None:
                break
            gradients.append(moved_pairs.gradient(pairs.centre, unit))
            total += float(moved_pairs.weight.sum()) / 12
        if len(gradients) == 2:
            derivative[:, k] = (gradients[0] - gradients[1]) / (2 * step)
    derivative = derivative @ vectors.T * (pairs.weight.sum() / max(total, 1e-12))
    slope_ratio = _bounded(inverse @ (0.5 * (derivative + derivative.T)) @ inverse, _STEEPNESS)
    signal_ratio = _bounded(inverse @ cross @ inverse, _STEEPNESS)
    values, vectors = np.linalg.eigh(signal_ratio)
    signal_root = (vectors * np.sqrt(values)) @ vectors.T
    return np.asarray(root @ signal_root @ slope_ratio @ signal_root @ root, np.float64)


def _bounded(S: Float64, min_eigenvalue: float) -> Float64:
    """Clip the eigenvalues of a symmetric matrix to the range from `min_eigenvalue` to 1."""
    values, vectors = np.linalg.eigh(S)
    return np.asarray((vectors * np.clip(values, min_eigenvalue, 1.0)) @ vectors.T, np.float64)


def _posterior_meat(patches: _Patches, J: Float64) -> Float64:
    """Posterior mean of ``J^T W V W J`` over the residuals' covariance V."""
    n, constrained = J.shape
    root = np.sqrt(patches.weight)
    y, A = root * patches.residual, root[:, None] * J
    distance = np.linalg.norm(patches.positions[:, None] - patches.positions, axis=2)
    normal_correlation = (
        (patches.normals @ patches.normals.T) * np.outer(root, root) / np.mean(root**2)
    )
    max_length = max(_MAX_LENGTH * float(np.percentile(distance, 90)), 2 * patches.edge)
    degrees_of_freedom = max(n - constrained, 1)
    log_likelihoods, meat = [], []
    for length in np.geomspace(patches.edge, max_length, _LENGTHS):
        values, vectors = np.linalg.eigh(normal_correlation * np.exp(-distance / length))
        values = np.maximum(values, 0.0)
        y_rotated, A_rotated = vectors.T @ y, vectors.T @ A
        noise, field = A_rotated.T @ A_rotated, (A_rotated.T * values) @ A_rotated
        for ratio in _RATIOS:
            variance = 1 + ratio * values
            normal_matrix = (A_rotated.T / variance) @ A_rotated
            fit = np.linalg.pinv(normal_matrix, hermitian=True) @ (
                (A_rotated.T / variance) @ y_rotated
            )
            square = float(((y_rotated - A_rotated @ fit) ** 2 / variance).sum())
            logs = np.log(variance).sum() + np.linalg.slogdet(normal_matrix)[1]
            log_likelihoods.append(
                -0.5 * logs - 0.5 * degrees_of_freedom * np.log(max(square, 1e-300))
            )
            # The scale's posterior mean, with the prior 1 / scale.
            meat.append((noise + ratio * field) * square / max(degrees_of_freedom - 2, 1))
    weight = np.exp(np.array(log_likelihoods) - max(log_likelihoods))
    return np.asarray(np.tensordot(weight / weight.sum(), np.array(meat), 1), np.float64)
