"""Gauss-Newton iterations of an alignment: from summed normal equations to a converged pose.

Independent noise cancels in the symmetrised cross-information of two views. Errors that distort
both views alike do not: multipath rounds corners and bends walls, scattering and lens shading
change the albedo, and the range depends on the amplitude. They tilt normals and add albedo
gradients in both Jacobians, so that a flat wall seems to constrain directions that it does not
constrain. The expected spurious information follows from the standard deviations of such tilts and
gradients, and is subtracted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import compose, retract, twist_between
from tofuse.engine.views import residual_kernels as res

# Number of points from which the spurious information is estimated.
SAMPLE_SIZE = 500
# Nuisance parameters that are also estimated: log albedo of the targets minus that of the source,
# scale of the sigmas of distances, and sigma of the log albedo (0 leaves it out).
EXPOSURE, SCALE_G, SCALE_P = 0, 1, 2
_MIN_PIVOT = 1e-12


@kernel
def spurious_information(
    points: Float32,
    stride: int,
    scale: float,
    inflation: float,
    albedo_variance: float,
    tilt: float,
    slope: float,
) -> Float64:
    """Return the expected information (6, 6) per point due to tilts and slopes shared by two views.

    Parameters
    ----------
    points
        (N, POINT_SIZE), see `alignment`.
    stride
        Every `stride`-th point is used.
    scale, inflation
        Factor of the sigmas of distances, and noise inflation added in quadrature, m.
    albedo_variance
        Variance of the log albedo residuals; 0 without the photometric term.
    tilt
        Standard deviation of the shared error of normals, per tangent direction, rad.
    slope
        Standard deviation of the shared error of the log albedo's slope per ray coordinate.
    """
    out = np.zeros((6, 6))
    J = np.empty(6)
    albedo_weight = slope * slope / albedo_variance if albedo_variance > 0 else 0.0
    count = 0
    for k in range(0, points.shape[0], stride):
        count += 1
        x = np.float64(points[k, res.POINT])
        y = np.float64(points[k, res.POINT + 1])
        z = np.float64(points[k, res.POINT + 2])
        a = np.float64(points[k, res.NORMAL])
        b = np.float64(points[k, res.NORMAL + 1])
        c = np.float64(points[k, res.NORMAL + 2])
        sigma = (x * a + y * b + z * c) * np.float64(points[k, res.SIGMA]) * scale
        weight = tilt * tilt / max(2 * sigma * sigma + inflation * inflation, 1e-12)
        # Sum over both tangent directions: all three axes minus the normal.
        _add_outer(out, J, weight, 1.0, 0.0, 0.0, x, y, z)
        _add_outer(out, J, weight, 0.0, 1.0, 0.0, x, y, z)
        _add_outer(out, J, weight, 0.0, 0.0, 1.0, x, y, z)
        _add_outer(out, J, -weight, a, b, c, x, y, z)
        if albedo_weight > 0 and not np.isnan(points[k, res.POINT_ALBEDO]):
            _add_outer(out, J, albedo_weight, 1 / z, 0.0, -x / (z * z), x, y, z)
            _add_outer(out, J, albedo_weight, 0.0, 1 / z, -y / (z * z), x, y, z)
    return out / max(count, 1)


@kernel
def _add_outer(
    out: Float64,
    J: Float64,
    weight: float,
    m0: float,
    m1: float,
    m2: float,
    x: float,
    y: float,
    z: float,
) -> None:
    projection_kernels.jacobian_row(J, m0, m1, m2, x, y, z)
    for p in range(6):
        for o in range(6):
            out[p, o] += weight * J[p] * J[o]


class LevelSettings(NamedTuple):
    """Settings of one pyramid level of an alignment.

    Attributes
    ----------
    iterations
        Maximum number of iterations.
    tolerance
        Iterations stop when the step is smaller than this, in `units`.
    max_scale
        Upper limit of the scale of the sigmas.
    inflation, albedo_inflation
        Noise inflation of distances, m, and of the log albedo.
    robust, min_cosine
        As in `Residuals`.
    remap
        Whether degenerate directions stay at the prediction (solution remapping, Zhang et al.
        2016).
    tilt, slope
        As in `spurious_information`.
    sigma_ratio
        Rms of the source's and the targets' sigmas of distances, relative to the source's.
    max_sigma
        As in `degenerate_directions`.
    prior, units
        As in `solve_step`.
    """

    iterations: int
    tolerance: float
    max_scale: float
    inflation: float
    albedo_inflation: float
    robust: float
    min_cosine: float
    remap: bool
    tilt: float
    slope: float
    sigma_ratio: float
    max_sigma: float
    prior: Float64
    units: Float64


@kernel
def iterate_level(
    points: Float32,
    targets: tuple[res.TargetImage, ...],
    T_targets: Float64,
    T: Float64,
    T_predicted: Float64,
    estimates: Float64,
    settings: LevelSettings,
) -> tuple[Float64, Float64, Float64, float, int]:
    """Iterate one pyramid level of an alignment until it converges.

    Parameters
    ----------
    points, targets
        Source points as in `accumulate`, and at least n targets, of which the first n count.
    T_targets
        (n, 4, 4) T_target_world of each target.
    T, estimates
        (4, 4) T_world_source and (3,) nuisance parameters, both updated in place.
    T_predicted
        As in `solve_step`.
    settings
        Of the level.

    Returns
    -------
    The last sums (SIZE,), the spurious information (6, 6), the degenerate directions (k, 6), the
    size of the last step in `units`, and the number of iterations. If sums or step are not finite,
    the returned sums are 0, all directions are degenerate, and T keeps its last value.
    """
    inflation, prior, units = settings.inflation, settings.prior, settings.units
    total = np.zeros(res.SIZE)
    degenerate = np.zeros((0, 6))
    spurious = np.zeros((6, 6))
    step_size = np.inf
    iterations = 0
    while iterations < settings.iterations and step_size >= settings.tolerance:
        total[:] = 0.0
        residuals = res.Residuals(
            estimates[EXPOSURE],
            estimates[SCALE_G],
            estimates[SCALE_P],
            inflation,
            settings.robust,
            settings.min_cosine,
        )
        for k in range(len(T_targets)):
            total += res.accumulate(points, targets[k], compose(T_targets[k], T), residuals)
        if settings.remap and iterations == 0:
            spurious = total[res.INLIERS] * spurious_information(
                points,
                max(1, len(points) // SAMPLE_SIZE),
                estimates[SCALE_G] * settings.sigma_ratio,
                inflation,
                estimates[SCALE_P] ** 2,
                settings.tilt,
                settings.slope,
            )
        finite = np.isfinite(total.sum() + spurious.sum())
        if finite:
            if settings.remap:
                cross = cross_information(total) - spurious
                degenerate = degenerate_directions(cross, units, settings.max_sigma)
            T_updated, step = solve_step(total, T, T_predicted, degenerate, prior, units)
            finite = np.isfinite(step.sum())
        if not finite:  # planes fitted to mere noise can have unbounded coefficients
            return np.zeros(res.SIZE), np.zeros((6, 6)), np.eye(6), np.inf, iterations
        for p in range(4):
            for o in range(4):
                T[p, o] = T_updated[p, o]
        iterations += 1
        step_size = 0.0
        for p in range(6):
            step_size = max(step_size, abs(step[p] / units[p]))
        if estimates[SCALE_P] > 0:
            estimates[EXPOSURE] += step[6]
        _rescale(total, estimates, settings)
    return total, spurious, degenerate, step_size, iterations


@kernel
def _rescale(total: Float64, estimates: Float64, settings: LevelSettings) -> None:
    """Estimate the sigmas from the residuals, which include both views' noise and bias."""
    scale = scale_of_distances(total[res.HISTOGRAM :])
    if not np.isnan(scale):
        estimates[SCALE_G] = min(max(scale, 0.7), settings.max_scale)
    if estimates[SCALE_P] > 0 and total[res.WEIGHT_P] > 0:
        mean_square = total[res.SQUARES_P] / total[res.WEIGHT_P]
        variance = mean_square / tukey.consistency(settings.robust) + settings.albedo_inflation**2
        estimates[SCALE_P] = min(max(np.sqrt(variance), 0.005), 0.5)


@kernel
def _without_exposure(A: Float64) -> Float64:
    """Marginalise the seventh unknown, the exposure: (6, 6)."""
    out = np.empty((6, 6))
    for p in range(6):
        for o in range(6):
            marginalised = A[p, 6] * A[6, o] / A[6, 6] if A[6, 6] > 0 else 0.0
            out[p, o] = A[p, o] - marginalised
    return out


@kernel
def information(total: Float64) -> Float64:
    """Return the information (6, 6) of the pose, from the sums of `accumulate`."""
    return _without_exposure(res.normal_equations(total)[0])


@kernel
def cross_information(total: Float64) -> Float64:
    """Return the symmetrised product (6, 6) of the target's and source's pose Jacobians."""
    return _without_exposure(res.normal_equations(total)[2])


@kernel
def degenerate_directions(cross: Float64, units: Float64, max_sigma: float) -> Float64:
    """Return the unit directions (k, 6), in `units` (6,), whose sigma exceeds `max_sigma`."""
    scaled = np.empty((6, 6))
    for p in range(6):
        for o in range(6):
            scaled[p, o] = cross[p, o] * units[p] * units[o]
    values, vectors = np.linalg.eigh(scaled)
    count = 0
    while count < 6 and values[count] < 1 / (max_sigma * max_sigma):
        count += 1
    out = np.empty((count, 6))
    for k in range(count):
        for p in range(6):
            out[k, p] = vectors[p, k]
    return out


@kernel
def solve_step(
    total: Float64,
    T: Float64,
    T_predicted: Float64,
    degenerate: Float64,
    prior: Float64,
    units: Float64,
) -> tuple[Float64, Float64]:
    """Solve the normal equations and apply the update.

    Parameters
    ----------
    total
        (SIZE,) sums of `accumulate`.
    T, T_predicted
        (4, 4) current and predicted pose of the source.
    degenerate
        (k, 6) unit directions, in `units`, in which the pose stays at the prediction.
    prior
        (6,) sigma of the prediction, m and rad.
    units
        (6,) scale of each component, in which directions are compared.

    Returns
    -------
    The updated pose (4, 4) and the step (7,), whose last element is the exposure's.
    """
    A, g, _ = res.normal_equations(total)
    deviation = twist_between(T_predicted, T)
    for p in range(6):
        deviation[p] /= units[p]
        g[p] *= units[p]
        for o in range(7):
            A[p, o] *= units[p]
            A[o, p] *= units[p]
    for p in range(6):
        weight = (units[p] / prior[p]) ** 2
        A[p, p] += weight
        g[p] += weight * deviation[p]
    if degenerate.shape[0]:
        # Degenerate directions get a stiff prior, much stronger than the information of noise.
        trace = 0.0
        for p in range(6):
            trace += A[p, p]
        stiffness = 1e3 * max(trace, 1.0)
        for k in range(degenerate.shape[0]):
            along = 0.0
            for p in range(6):
                along += degenerate[k, p] * deviation[p]
            for p in range(6):
                g[p] += stiffness * along * degenerate[k, p]
                for o in range(6):
                    A[p, o] += stiffness * degenerate[k, p] * degenerate[k, o]
    solve_positive(A, g)
    for p in range(7):
        g[p] *= -units[p] if p < 6 else -1.0
    return retract(T, g), g


@kernel
def solve_positive(A: Float64, b: Float64) -> None:
    """Solve A x = b in place for a symmetric positive definite A, by Cholesky decomposition.

    Only the lower triangle of A is read. Pivots have a lower limit.
    """
    n = len(b)
    for p in range(n):
        for o in range(p + 1):
            total = A[p, o]
            for k in range(o):
                total -= A[p, k] * A[o, k]
            A[p, o] = total / A[o, o] if o < p else np.sqrt(max(total, _MIN_PIVOT))
        for k in range(p):
            b[p] -= A[p, k] * b[k]
        b[p] /= A[p, p]
    for p in range(n - 1, -1, -1):
        for k in range(p + 1, n):
            b[p] -= A[k, p] * b[k]
        b[p] /= A[p, p]


@kernel
def scale_of_distances(histogram: Float64) -> float:
    """Return the ratio of observed to stated sigma of all compared distances; NaN without any.

    It is 1.48 times the median absolute distance. Outliers are included, as a scale estimated from
    inliers only would confirm itself.
    """
    count = 0.0
    for k in range(res.BINS):
        count += histogram[k]
    cumulative = 0.0
    for k in range(res.BINS):
        in_bin = histogram[k]
        if in_bin > 0 and 2 * (cumulative + in_bin) >= count:
            low, high = res.bin_edge(k), res.bin_edge(k + 1)
            return 1.48 * np.sqrt(low + (high - low) * (0.5 * count - cumulative) / in_bin)
        cumulative += in_bin
    return np.nan


@kernel
def scales_of_distances(histograms: Float64, out: Float64) -> None:
    """Write the `scale_of_distances` of histograms (N, BINS) to `out` (N,)."""
    for k in range(len(histograms)):
        out[k] = scale_of_distances(histograms[k])
