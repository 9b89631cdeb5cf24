"""Error metrics with normals: point-to-plane, plane-to-plane.

`SurfacePairs` are the matches with normals, in coordinates about their centroid. Robust losses,
the solution of normal equations and the detection of degenerate directions are common to all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, Protocol

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.errors import RegistrationError
from tofuse.engine.geometry import se3, unit_vectors
from tofuse.engine.icp.icp_kernels import (
    direction_products,
    matrix_sums,
    plane_sums,
    plane_to_plane_weights,
    transform_points,
)
from tofuse.engine.icp.interfaces import Alignment, Matches, Metric
from tofuse.engine.normal import robust_sigma
from tofuse.engine.parts import part

Loss = Literal["square", "huber", "cauchy", "tukey"]

MIN_PAIRS = 6
# Lower limit of the residuals' sigma, as a fraction of the resolution.
_MIN_SIGMA_RATIO = 1e-3
# Tuning constants for 95 % efficiency on normal errors, in standard deviations.
_HUBER, _CAUCHY, _TUKEY = 1.345, 2.385, 4.685
# Relative eigenvalues below this are rounding errors.
_RANK_TOLERANCE = 1e-10
# Normals that differ by more than 60 degrees are of different surfaces.
_MIN_NORMAL_COSINE = 0.5
# Minimum fraction of a direction's information that is not noise. Degenerate directions have less
# than 0.15, directions constrained by a few percent of the points more than 0.5.
_MIN_SIGNAL_FRACTION = 0.4


@dataclass(frozen=True, eq=False)
class SurfacePairs:
    """m pairs in the source's frame, about `centre`.

    Attributes
    ----------
    T_target_source
        (4, 4) the estimate.
    centre
        (3,) centroid of the paired source points, m, source frame.
    points
        (m, 3) source points relative to it, m.
    residual
        (m, 3) from target point to transformed source point, m, rotated into the source's frame.
    target_normals, source_normals
        (m, 3) unit normals of both surfaces, rotated into the source's frame.
    weight
        (m,) weights of the pairs by their noise.
    resolution
        Point spacing or voxel size of the views, m.
    """

    T_target_source: Float64
    centre: Float64
    points: Float64
    residual: Float64
    target_normals: Float64
    source_normals: Float64
    weight: Float64
    resolution: float

    def __len__(self) -> int:
        return len(self.points)

    @property
    def size(self) -> float:
        """Root mean square distance of the points from their centroid, m."""
        return max(float(np.sqrt((self.points**2).sum(1).mean())), self.resolution)

    def motion(self, xi: Float64) -> Float64:
        """Return the motion (4, 4) in the target's frame of a perturbation about the centre."""
        T, T_centre_source = self.T_target_source, se3.translation(-self.centre)
        T_target_centre = T @ se3.translation(self.centre)
        return T_target_centre @ se3.exp(xi) @ T_centre_source @ se3.inverse(T)

    def to_origin(self, H: Float64) -> Float64:
        """Transform information (6, 6) about the centre to the source's origin."""
        adjoint = se3.adjoint(se3.translation(-self.centre))
        H = adjoint.T @ H @ adjoint
        return (H + H.T) / 2

    def keep(self, mask: Bool) -> SurfacePairs:
        """Return the pairs of the mask, about the same centre."""
        return replace(
            self,
            points=self.points[mask],
            residual=self.residual[mask],
            target_normals=self.target_normals[mask],
            source_normals=self.source_normals[mask],
            weight=self.weight[mask],
        )


def surface_pairs(matches: Matches, alignment: Alignment, *, source: bool = False) -> SurfacePairs:
    """Convert matches to pairs with normals of the target and, if `source`, of the source.

    Pairs without normals are excluded.

    Raises
    ------
    RegistrationError
        If fewer than six pairs remain.
    """
    i, j = matches.source, matches.target
    T = alignment.T_target_source
    rotation = se3.pose(T[:3, :3].T)
    p = alignment.source.points[i]
    residual = transform_points(rotation, alignment.transformed[i] - alignment.target.points[j])
    target_normals = transform_points(rotation, alignment.target.normals[j])
    source_normals = alignment.source.normals[i] if source else np.zeros((len(i), 3))
    weight = matches.weights() * _noise_weights(matches, alignment)
    valid = np.isfinite(target_normals).all(1) & np.isfinite(source_normals).all(1) & (weight > 0)
    paired = int(np.count_nonzero(valid))
    if paired < MIN_PAIRS:
        raise RegistrationError(
            f"the views have only {quantities.count(paired, 'corresponding point')} "
            f"with normals, {MIN_PAIRS} are needed",
            remedy="pass views of a common surface; few points, or points on a line, have none",
        )
    centre = p[valid].mean(0)
    pairs = SurfacePairs(
        T,
        centre,
        p - centre,
        residual,
        target_normals,
        source_normals,
        weight,
        alignment.resolution,
    )
    return pairs.keep(valid)


def _noise_weights(matches: Matches, alignment: Alignment) -> Float64:
    """Return inverse variances (m,) relative to their mean; ones if sigma is unknown."""
    source_variance, target_variance = alignment.source.variance, alignment.target.variance
    if source_variance is None or target_variance is None or len(matches) == 0:
        return np.ones(len(matches))
    floor = (_MIN_SIGMA_RATIO * alignment.resolution) ** 2
    inverse = 1 / np.maximum(
        source_variance[matches.source] + target_variance[matches.target], floor
    )
    return inverse / inverse.mean()


def shared_weights(matches: Matches, alignment: Alignment) -> Float64:
    """Return the information weights (m,) of pairs, reduced where many share one target point.

    With equal noise in both views, m pairs with one target point have the information of
    ``2 m / (1 + m)`` pairs with distinct target points.
    """
    return 2 / (1 + np.bincount(matches.target, minlength=len(alignment.target))[matches.target])


def in_scales(residual: Float64, resolution: float) -> Float64:
    """Return absolute residuals (m,), in m, relative to their robust scale.

    The scale is their `robust_sigma`, at least a thousandth of the resolution.
    """
    magnitude = np.abs(residual)
    return np.asarray(magnitude / max(robust_sigma(magnitude), _MIN_SIGMA_RATIO * resolution))


def loss_weights(loss: Loss, residual: Float64, resolution: float) -> Float64:
    """Weights (m,), 0 to 1, of a robust loss for residuals (m,) in m; see `in_scales`."""
    if loss == "square":
        return np.ones(len(residual))
    x = in_scales(residual, resolution)
    if loss == "huber":
        return np.minimum(1.0, _HUBER / np.maximum(x, _HUBER))
    if loss == "cauchy":
        return 1 / (1 + (x / _CAUCHY) ** 2)
    return tukey.weights((x / _TUKEY) ** 2)


def variance_of(square: float, weight: Float64, resolution: float) -> float:
    """Variance in m^2 of residuals with the weighted sum of squares `square`."""
    variance = square / max(float(weight.sum()) - 6, 1.0)
    return max(variance, (_MIN_SIGMA_RATIO * resolution) ** 2)


def solve(H: Float64, g: Float64, size: float) -> Float64:
    """Solve ``H xi = -g`` by the pseudo-inverse, without motion along null directions of H.

    `size` (m) makes rotations comparable with translations.
    """
    scale = np.array([1, 1, 1, 1 / size, 1 / size, 1 / size])
    values, vectors = np.linalg.eigh(H * scale[:, None] * scale)
    nonsingular = values > _RANK_TOLERANCE * values[-1]
    step = np.zeros(6)
    for value, vector in zip(values[nonsingular], vectors.T[nonsingular], strict=True):
        step -= vector * float((vector * scale * g).sum()) / value
    return scale * step


def cross_information(pairs: SurfacePairs, variance: float) -> Float64:
    """Return ``sum w (Jt^T Js + Js^T Jt) / (2 variance)`` (6, 6), about the pairs' centre.

    Jt and Js are the derivatives of the distance along the target's and along the source's
    normal. The noise of the two views is independent and cancels in the product. In the plain
    information ``Jt^T Jt`` it accumulates, and seems to constrain a flat wall in every direction.
    """
    a, b = pairs.target_normals, pairs.source_normals
    H, _, _ = plane_sums(pairs.points, a, b, np.zeros(len(pairs)), pairs.weight)
    return (H + H.T) / (2 * variance)


def unobservable_directions(pairs: SurfacePairs, variance: float) -> Float64:
    """Return the degenerate directions (k, 6) of the right perturbation.

    Candidates are the eigenvectors of the cross-information, with lengths in resolutions and
    angles scaled by the rms distance from the centroid. One is degenerate if its sigma exceeds one,
    or if most of its plain information is noise, and absent from the cross-information.
    """
    # The orientation of the normals is irrelevant here.
    cosine = (pairs.target_normals * pairs.source_normals).sum(1)
    oriented = pairs.source_normals * np.sign(cosine)[:, None]
    pairs = replace(pairs, source_normals=oriented).keep(np.abs(cosine) > _MIN_NORMAL_COSINE)
    if not len(pairs):
        return np.eye(6)
    unit = pairs.resolution
    scale = unit * np.array([1, 1, 1, 1 / pairs.size, 1 / pairs.size, 1 / pairs.size])
    C = cross_information(pairs, variance) * scale[:, None] * scale
    values, vectors = np.linalg.eigh(C)
    directions = np.ascontiguousarray((vectors * scale[:, None]).T)
    cross, plain = direction_products(
        pairs.points, pairs.target_normals, pairs.source_normals, pairs.weight, directions
    )
    constrained = (values > 1) & (cross > _MIN_SIGNAL_FRACTION * plain)
    return unit_vectors(directions[~constrained] @ se3.adjoint(se3.translation(pairs.centre)).T)


class SurfaceMetric(Metric, Protocol):
    """Base of the metrics with normals."""

    def fit(self, pairs: SurfacePairs) -> tuple[Float64, float]:
        """Return the information (6, 6) about the pairs' centre, and the variance in m^2."""
        ...

    def information(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.information`; sigma is estimated from the residuals.

        Pairs with the same target point share its noise and count less.
        """
        pairs = _independent_pairs(matches, alignment)
        return pairs.to_origin(self.fit(pairs)[0])

    def unobservable(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.unobservable`."""
        pairs = _independent_pairs(matches, alignment)
        return unobservable_directions(pairs, self.fit(pairs)[1])


def _independent_pairs(matches: Matches, alignment: Alignment) -> SurfacePairs:
    weight = matches.weights() * shared_weights(matches, alignment)
    return surface_pairs(replace(matches, weight=weight), alignment, source=True)


class TangentPlanes(SurfaceMetric, Protocol):
    """Squared distances to the target's tangent planes, with weights defined by the metric.

    One Gauss-Newton step on SE(3) is made for each matching.
    """

    def weights(self, residual: Float64, resolution: float) -> Float64:
        """Return the weights (m,) of residuals (m,) in m."""
        ...

    def motion(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.motion`; no motion along directions that no plane constrains."""
        pairs = surface_pairs(matches, alignment)
        r, weight = self._weigh(pairs)
        n = pairs.target_normals
        H, g, _ = plane_sums(pairs.points, n, n, r, weight)
        return pairs.motion(solve(H, g, pairs.size))

    def fit(self, pairs: SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`."""
        n = pairs.target_normals
        r, weight = self._weigh(pairs)
        H, _, square = plane_sums(pairs.points, n, n, r, weight)
        variance = variance_of(square, weight, pairs.resolution)
        return H / variance, variance

    def _weigh(self, pairs: SurfacePairs) -> tuple[Float64, Float64]:
        r: Float64 = (pairs.residual * pairs.target_normals).sum(1)
        return r, pairs.weight * self.weights(r, pairs.resolution)


@part("metric", "point-to-plane", label="validated")
@dataclass(frozen=True)
class PointToPlane(TangentPlanes):
    """Distances from the source's points to the target's tangent planes (Chen and Medioni 1992).

    ``sum w_i ((T d_i - m_i) . n_i)^2``, see `TangentPlanes`.

    Attributes
    ----------
    loss
        "square" as in the paper; "huber", "cauchy" or "tukey" count large residuals less.
    """

    loss: Loss = "square"

    def weights(self, residual: Float64, resolution: float) -> Float64:
        """See `TangentPlanes.weights`."""
        return loss_weights(self.loss, residual, resolution)


@part("metric", "gicp", label="validated")
@dataclass(frozen=True)
class PlaneToPlane(Bounded, SurfaceMetric):
    """Generalised ICP (Segal, Haehnel and Thrun 2009), plane to plane.

    ``sum r_i^T (C_qi + R C_pi R^T)^-1 r_i``, r_i = T p_i - q_i: each point stands for a disc of
    its surface, with variance 1 along it and `epsilon` across. One Gauss-Newton step is made for
    each matching.

    Attributes
    ----------
    epsilon
        Variance across the surface relative to that along it (section III of the paper: 0.001).
    loss
        "square" as in the paper; "huber", "cauchy" or "tukey" count large residuals less.
    """

    epsilon: Annotated[float, Bounds(1e-9, 1)] = 1e-3
    loss: Loss = "square"

    def motion(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.motion`."""
        pairs = surface_pairs(matches, alignment, source=True)
        W, weight = self._weigh(pairs)
        H, g, _ = matrix_sums(pairs.points, pairs.residual, W, weight)
        return pairs.motion(solve(H, g, pairs.size))

    def fit(self, pairs: SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`; the variance is that across the surface."""
        W, weight = self._weigh(pairs)
        H, _, square = matrix_sums(pairs.points, pairs.residual, W, weight)
        variance = variance_of(square, weight, pairs.resolution)
        return H / variance, variance

    def _weigh(self, pairs: SurfacePairs) -> tuple[Float64, Float64]:
        """Return W (m, 3, 3), normalised to 1 across two parallel discs, and the weights (m,)."""
        W = (
            2
            * self.epsilon
            * plane_to_plane_weights(pairs.target_normals, pairs.source_normals, self.epsilon)
        )
        square = np.einsum("ki,kij,kj->k", pairs.residual, W, pairs.residual)
        size = np.sqrt(np.maximum(square, 0))
        return W, pairs.weight * loss_weights(self.loss, size, pairs.resolution)
