"""The map of deviations: a best fit of all points, places with covariance, and their verdicts.

Points are averaged over places, which are small parts of a region. The deviation of a place is
what remains after the best fit (least squares), so that its covariance is ``P V P^T``: V has the
noise of its points, which averaging reduces, and the errors that neighbouring places share, which
it does not; P is the projection that the fit applies to both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import norm

from tofuse.apps.compare.nearest import Distances, Reach, Reference
from tofuse.apps.compare.surface import Surface, spacing_of
from tofuse.apps.compare.unmatched import FEWEST, Unmatched, unmatched
from tofuse.apps.report import scene
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import KdTree, se3, unit_vectors
from tofuse.engine.normal import robust_sigma

# Points of the fit, first of a sample, and of the map; and iterations.
_FIT_POINTS, _MAX_POINTS, _ITERATIONS = (4000, 100_000), 250_000, (30, 3)
# Deviations beyond this many tolerances and standard deviations are not fitted.
_CUT_TOLERANCES, _CUT_SIGMAS = 3.0, 4.0
# A direction with less information, relative to the best one, keeps the guess.
_MIN_INFORMATION = 1e-3
# Spacings of the points round a sharp edge, where a fused surface is round, that are left out.
_EDGE_SPACINGS = 2.0
# Most points of a place, and the noise of its mean as a fraction of the tolerance.
_MOST, _MEAN_NOISE = 400, 0.1
# Without a tolerance a place is this fraction of the diagonal; never larger than the second.
_PLACE_FRACTION, _MAX_PLACE_FRACTION = 0.025, 0.05
_MAX_PLACES = 1000
# Neighbouring places by which the slope of the deviations is estimated.
_NEIGHBOURS = 8
# Points farther from the centre of a place, in its edges, are in none.
_MAX_REMOTE = 1.5
# Correlation length of shared errors, as a fraction of the diagonal: short, so that the fit does
# not absorb them.
_SHARED_LENGTH = 0.15
LEVEL = 0.95  # one-sided
COVERAGE = float(norm.ppf(LEVEL))


@dataclass(frozen=True, eq=False)
class Places:
    """Small parts of the surface, and the deviation of each.

    Attributes
    ----------
    centres, normals
        (K, 3) in the coordinates of the reference.
    region
        (K,) of the reference.
    points
        (K,) number of points.
    deviation
        (K,) mean signed distance of its points, m.
    covariance
        (K, K) of the deviations, m^2.
    uneven
        (K,) standard deviation of the surface within a place, beyond noise, m.
    slope
        (K,) by how much the deviation changes from the centre of a place to its border, m.
    size
        Typical edge, m.
    """

    centres: Float64
    normals: Float64
    region: Intp
    points: Intp
    deviation: Float64
    covariance: Float64
    uneven: Float64
    slope: Float64
    size: float

    @cached_property
    def sigma(self) -> Float64:
        """(K,) standard deviations, m; inf where errors are not bounded."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def coverage_of_all(self) -> float:
        """Factor of sigma that the largest of all deviations exceeds by chance in 5 %."""
        return float(norm.ppf(1 - (1 - LEVEL) / max(len(self.deviation), 1)))

    def verdicts(self, tolerance_m: float) -> Intp:
        """Return 1 where a place is within the tolerance, -1 where it is not, 0 where undecided.

        That it is within is tested at each place, and includes what the place averages over: an
        uneven or sloping one is not within the tolerance as its mean is. That it is not is tested
        with the multiplicity of all, as one in twenty would seem to fail by chance.
        """
        size = np.abs(self.deviation)
        expanded = COVERAGE * np.hypot(self.sigma, self.uneven) + self.slope
        passed = size + expanded <= tolerance_m
        failed = size - self.coverage_of_all * self.sigma > tolerance_m
        return passed.astype(np.intp) - failed

    @property
    def changed(self) -> Bool:
        """(K,) whether a deviation is significant, among all places and of either sign."""
        factor = norm.ppf(1 - (1 - LEVEL) / max(2 * len(self.deviation), 1))
        return np.asarray(np.abs(self.deviation) > factor * self.sigma)

    @property
    def detectable(self) -> Float64:
        """(K,) smallest change, m, that would be significant with a probability of 95 %."""
        factor = norm.ppf(1 - (1 - LEVEL) / max(2 * len(self.deviation), 1))
        return np.asarray((factor + COVERAGE) * self.sigma)

    def mean(self, chosen: Bool) -> tuple[float, float]:
        """Return the mean deviation of places, weighted by points, and its sigma, m."""
        w = np.where(chosen, self.points, 0).astype(float)
        w /= w.sum()
        used = np.flatnonzero(chosen)
        variance = w[used] @ self.covariance[np.ix_(used, used)] @ w[used]
        return float(w @ self.deviation), float(np.sqrt(max(variance, 0.0)))


@dataclass(frozen=True, eq=False)
class DeviationMap:
    """Deviations of points and places.

    Attributes
    ----------
    T_reference_measured
        (4, 4) best fit.
    points, normals
        (N, 3) measured, in the coordinates of the reference.
    deviation, sigma
        (N,) m, and the standard deviation of a single point; NaN where there is nothing to compare.
    place
        (N,) -1 where none.
    places
        The places.
    seen
        (M,) whether each triangle of the reference was measured.
    left_out
        Width around sharp edges that is not assessed, m; 0 without any.
    free
        Number of motions that the surface does not determine.
    noise_scale
        Scatter of neighbouring points, as a multiple of the stated noise.
    beyond
        Fraction of the measured points that the reference has no surface near.
    unmatched
        Surface of a part that a solid reference lacks.
    """

    T_reference_measured: Float64
    points: Float64
    normals: Float64
    deviation: Float64
    sigma: Float64
    place: Intp
    places: Places
    seen: Bool
    left_out: float
    free: int
    noise_scale: float
    beyond: float
    unmatched: tuple[Unmatched, ...] = ()


def fitted(
    measured: Surface, reference: Reference, T: Float64, reach: Reach, tolerance_m: float | None
) -> tuple[Float64, int]:
    """Return the best fit T_reference_measured (4, 4) from a start, and the undetermined motions.

    Least squares over the points; directions that are not determined keep the start.
    """
    free = 6
    for count, iterations in zip(_FIT_POINTS, _ITERATIONS, strict=True):
        chosen = scene.random_subset(len(measured.points), count)
        subset = replace(measured, points=measured.points[chosen], normals=measured.normals[chosen])
        T, free = _iterated(subset, reference, T, reach, tolerance_m, iterations)
    return T, free


def _iterated(
    measured: Surface,
    reference: Reference,
    T: Float64,
    reach: Reach,
    tolerance_m: float | None,
    iterations: int,
) -> tuple[Float64, int]:
    points, normals, free = measured.points, measured.normals, 6
    for _ in range(iterations):
        moved = se3.transform(T, points)
        found = reference.distances(moved, normals @ T[:3, :3].T, reach, oriented=measured.oriented)
        used = found.compared
        if used.sum() < FEWEST:
            return T, 6
        r = found.signed[used]
        scale = robust_sigma(r - np.median(r))
        cut = max(_CUT_TOLERANCES * (tolerance_m or 0.0), _CUT_SIGMAS * scale)
        near = np.abs(r) <= max(cut, float(np.median(np.abs(r))))
        centre = moved[used].mean(0)
        J, unit = _jacobian(moved[used][near] - centre, found.normals[used][near])
        inverse, free = _inverse(J.T @ J)
        step = -unit * (inverse @ (J.T @ r[near]))
        about = se3.translation(centre) @ se3.exp(step) @ se3.translation(-centre)
        T = se3.orthonormalise(about @ T)
        if np.linalg.norm(step / unit) < 1e-3 * max(scale, 1e-9):
            break
    return T, free


def _jacobian(points: Float64, normals: Float64) -> tuple[Float64, Float64]:
    """Return the derivative (n, 6) of distances, and the units of its columns."""
    size = max(float(np.sqrt((points**2).sum(1).mean())), 1e-9)
    unit = np.array([1, 1, 1, 1 / size, 1 / size, 1 / size])
    return np.concatenate([normals, np.cross(points, normals)], axis=1) * unit, unit


def _inverse(H: Float64) -> tuple[Float64, int]:
    """Return the inverse of an information (6, 6) without its empty directions, and their count."""
    values, vectors = np.linalg.eigh(H)
    kept = values > _MIN_INFORMATION * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    return inverse, int(6 - kept.sum())


def mapped(
    measured: Surface,
    reference: Reference,
    T: Float64,
    reach: Reach,
    tolerance_m: float | None = None,
    shared_m: float = 0.0,
    free: int = 0,
    centres: Places | None = None,
) -> DeviationMap:
    """Return the deviations of a measured surface at its best fit.

    Parameters
    ----------
    measured, reference
        Both surfaces.
    T
        (4, 4) T_reference_measured; see `fitted`.
    reach
        How far surfaces are compared.
    tolerance_m
        Determines the size of places.
    shared_m
        Standard deviation of errors that neighbouring places share, of both surfaces.
    free
        Number of motions that are not determined.
    centres
        Places to use, for comparing several surfaces at the same ones: by differences between
        them, in which the noise of the reference cancels, so that it is in no covariance.
    """
    chosen = scene.random_subset(len(measured.points), _MAX_POINTS)
    points = se3.transform(T, measured.points[chosen])
    normals = measured.normals[chosen] @ T[:3, :3].T
    found = reference.distances(points, normals, reach, oriented=measured.oriented)
    deviation = found.signed.copy()
    spacing = spacing_of(points)
    left_out = 0.0
    if len(reference.edges):
        left_out = _EDGE_SPACINGS * spacing
        deviation[KdTree(reference.edges).nearest(found.feet, left_out)[0] >= 0] = np.nan
    compared = np.flatnonzero(np.isfinite(deviation))
    beyond = 1 - float(found.compared.mean())
    seen = _seen(reference, found, spacing)
    own = None if measured.sigma is None else measured.sigma[chosen]
    stated = own
    if own is not None and reference.sigma is not None:
        stated = np.hypot(own, reference.sigma[found.element])
    feet, region = found.feet[compared], reference.region[found.element[compared]]
    d = deviation[compared]
    if centres is None:
        noise = _noise(feet, d, stated, compared)
        size = _place_size(reference, spacing, noise, tolerance_m)
        label, count = _grouped(feet, region, size)
    else:
        label, count, size = _assigned(feet, region, centres), len(centres.points), centres.size
    place = np.full(len(points), -1, np.intp)
    place[compared] = label
    if not count:
        return DeviationMap(
            T, points, normals, deviation, np.full(len(points), np.nan), place,
            _no_places(size), seen, left_out, free, 1.0, beyond,
        )  # fmt: skip
    sums = _Sums(label, count)
    mean = sums.mean(d)
    scatter = d - mean[np.maximum(label, 0)]
    sigma, scale, correlation = _point_noise(feet, scatter, stated, compared, label)
    n = sums.count
    # What a place averages over, beyond noise: a place that is bent or stepped is not flat.
    variance = sums.mean(sigma**2)
    expected = variance * (1 + 2 * np.sqrt(2 * correlation / np.maximum(n, 1)))
    uneven = np.maximum(sums.mean(scatter**2) - expected, 0.0)
    if centres is not None and own is not None:  # that of the reference is common to all surfaces
        variance = sums.mean((scale * own[compared]) ** 2)
    variance_of_mean = (variance + uneven) / np.maximum(n / correlation, 1.0)
    p, normal = sums.mean3(feet), unit_vectors(sums.mean3(found.normals[compared]))
    covariance = _covariance(p, normal, n, variance_of_mean, shared_m, reference.diagonal)
    region_of = np.zeros(count, np.intp)
    region_of[label[label >= 0]] = region[label >= 0]
    radius = np.zeros(count)
    used = label >= 0
    np.maximum.at(radius, label[used], np.linalg.norm(feet[used] - p[label[used]], axis=1))
    slope = radius * _gradients(p, region_of, mean, covariance, size)
    places = Places(p, normal, region_of, n, mean, covariance, np.sqrt(uneven), slope, size)
    of_points = np.full(len(points), np.nan)
    row = np.maximum(label, 0)
    of_points[compared] = np.where(label < 0, np.nan, np.hypot(sigma, places.sigma[row]))
    deviation[compared[label < 0]] = np.nan
    noise = _CUT_SIGMAS * float(np.hypot(shared_m, np.median(sigma)))
    lacking = unmatched(
        reference, points, normals, found, measured.oriented, size, spacing,
        tolerance_m or 0.0, noise, se3.transform(T, measured.eyes),
    )  # fmt: skip
    return DeviationMap(
        T, points, normals, deviation, of_points, place, places, seen, left_out, free, scale,
        beyond, lacking,
    )  # fmt: skip


def _gradients(
    p: Float64, region: Intp, deviation: Float64, covariance: Float64, size: float
) -> Float64:
    """Return the length (K,) of the gradient of deviations, by neighbouring places of a region.

    It is that in excess of errors with this covariance (K, K).
    """
    k = min(_NEIGHBOURS, len(p))
    apart = _apart(p, region, 2 * (float(np.ptp(p, axis=0).max()) + size))
    index = KdTree(apart).neighbours(apart, k)[0]
    offset = p[index] - p[:, None]
    near = (region[index] == region[:, None]) & (np.linalg.norm(offset, axis=2) < 2 * size)
    rise = np.where(near, deviation[index] - deviation[:, None], 0.0)
    inverse = np.linalg.pinv(np.where(near[..., None], offset, 0.0), rcond=0.3)
    square = (np.einsum("kij,kj->ki", inverse, rise) ** 2).sum(1)
    # The covariance of the rises: errors that neighbours share cancel.
    with np.errstate(invalid="ignore"):
        to_centre = covariance[index, np.arange(len(p))[:, None]]
        shared = to_centre[:, :, None] + to_centre[:, None]
        of_rises = covariance[index[:, :, None], index[:, None]] - shared
        of_rises += np.diag(covariance)[:, None, None]
        noise = np.einsum("kij,kjl,kil->k", inverse, of_rises, inverse)
    return np.asarray(np.sqrt(np.maximum(square - np.nan_to_num(noise, nan=np.inf), 0.0)))


class _Sums:
    """Means over places: `label` is the place of each point, -1 for none."""

    def __init__(self, label: Intp, count: int) -> None:
        self._label, self._used = label[label >= 0], label >= 0
        self.count = np.bincount(self._label, minlength=count)

    def mean(self, values: Float64) -> Float64:
        total = np.bincount(self._label, values[self._used], minlength=len(self.count))
        return np.asarray(total / np.maximum(self.count, 1))

    def mean3(self, values: Float64) -> Float64:
        return np.stack([self.mean(column) for column in values.T], axis=1)


def _no_places(size: float) -> Places:
    none, zeros = np.zeros((0, 3)), np.zeros(0)
    index = np.zeros(0, np.intp)
    return Places(none, none, index, index, zeros, np.zeros((0, 0)), zeros, zeros, size)


def _seen(reference: Reference, found: Distances, spacing: float) -> Bool:
    """(M,) whether a point lies opposite each triangle of the reference."""
    feet, region = found.feet[found.compared], reference.region[found.element[found.compared]]
    if not len(feet):
        return np.zeros(len(reference.triangles), bool)
    near = max(reference.size, 2 * spacing)
    centres = reference.centres
    return np.asarray(_nearest_centre(centres, reference.region, feet, region, near) >= 0)


def _noise(feet: Float64, deviation: Float64, stated: Float64 | None, rows: Intp) -> float:
    """Return the typical noise of a point, m: as stated, or of the differences of neighbours."""
    if len(feet) < 2:
        return 0.0
    if stated is not None:
        return float(np.median(stated[rows]))
    return _neighbour_sigma(feet, deviation)


def _neighbour_sigma(feet: Float64, deviation: Float64) -> float:
    neighbour = KdTree(feet).neighbours(feet[:: max(1, len(feet) // 5000)], 4)[0]
    return robust_sigma(deviation[neighbour[:, 3]] - deviation[neighbour[:, 0]]) / 2**0.5


def _point_noise(
    feet: Float64, scatter: Float64, stated: Float64 | None, rows: Intp, label: Intp
) -> tuple[Float64, float, float]:
    """Return sigma (n,) of points, the factor on the stated one, and points per independent one.

    The scatter in a place shows noise that the views don't state; that of neighbours its
    correlation.
    """
    used = label >= 0
    sampled = np.flatnonzero(used)[:: max(1, int(used.sum()) // 20_000)]
    e = scatter[sampled]
    spread = max(robust_sigma(e), 1e-9)
    nearest = KdTree(feet).neighbours(feet[sampled], 2)[0][:, 1]
    inliers = (np.abs(e) < 4 * spread) & (np.abs(scatter[nearest]) < 4 * spread) & used[nearest]
    product, square = (e * scatter[nearest])[inliers], (e**2)[inliers]
    rho = float(np.clip(product.sum() / max(square.sum(), 1e-300), 0.0, 0.9))
    correlation = ((1 + rho) / (1 - rho)) ** 2  # along both directions of a surface
    if stated is None:
        return np.full(len(feet), spread), 1.0, correlation
    scale = max(robust_sigma(e / np.maximum(stated[rows][sampled], 1e-9)), 1.0)
    return scale * stated[rows], scale, correlation


def _place_size(
    reference: Reference, spacing: float, noise: float, tolerance_m: float | None
) -> float:
    """Return the edge of a place, m: small, but with negligible noise if that is possible."""
    if tolerance_m is None:
        size = _PLACE_FRACTION * reference.diagonal
    else:
        needed = COVERAGE * noise / (_MEAN_NOISE * tolerance_m)
        size = spacing * float(np.clip(needed, FEWEST**0.5, _MOST**0.5))
    size = min(size, _MAX_PLACE_FRACTION * reference.diagonal)
    fewest = float(np.sqrt(reference.area.sum() / _MAX_PLACES))
    return max(size, spacing * FEWEST**0.5, fewest)


def _grouped(feet: Float64, region: Intp, size: float) -> tuple[Intp, int]:
    """Return the place (n,) of each point, and their number: cells of a region of enough points.

    The points of smaller cells belong to the nearest place of their region, if it is a neighbour.
    """
    if not len(feet):
        return np.zeros(0, np.intp), 0
    # Cells fill the box of their region, so that none is a sliver at its border.
    low, high = np.full((2, region.max() + 1, 3), [[[np.inf]], [[-np.inf]]])
    np.minimum.at(low, region, feet)
    np.maximum.at(high, region, feet)
    extent = np.maximum(high - low, 1e-9)[region]
    number = np.maximum(np.round(extent / size), 1)
    cell = np.minimum(np.floor((feet - low[region]) / extent * number), number - 1)
    key = np.column_stack([region, cell])
    _, label, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    label = label.ravel()
    large = count >= max(FEWEST, 0.4 * float(np.median(count[count >= min(FEWEST, count.max())])))
    if not large.any():
        return np.full(len(feet), -1, np.intp), 0
    centres = _Sums(label, len(count)).mean3(feet)[large]
    owner = np.zeros(len(count), np.intp)
    owner[label] = region
    made = _nearest_centre(feet, region, centres, owner[large], _MAX_REMOTE * size)
    return made, int(large.sum())


def _nearest_centre(
    points: Float64, region: Intp, centres: Float64, owner: Intp, limit: float
) -> Intp:
    """Return the nearest centre (n,) of the same region for each point; -1 beyond the limit."""
    distance = 2 * (float(np.ptp(centres, axis=0).max()) + limit)
    found = KdTree(_apart(centres, owner, distance))
    return np.asarray(found.nearest(_apart(points, region, distance), limit)[0], np.intp)


def _apart(points: Float64, region: Intp, distance: float) -> Float64:
    """Return points with regions shifted apart, for one kd-tree of all of them."""
    return points + region[:, None] * np.array([distance, 0, 0])


def _assigned(feet: Float64, region: Intp, places: Places) -> Intp:
    return _nearest_centre(feet, region, places.centres, places.region, _MAX_REMOTE * places.size)


def _covariance(
    p: Float64, normals: Float64, n: Intp, noise: Float64, shared_m: float, diagonal: float
) -> Float64:
    """Return the covariance (K, K) of the deviations of places after the best fit, m^2."""
    variance = shared_m * shared_m  # inf where it is no number
    if not np.isfinite(variance):
        return np.full((len(p), len(p)), np.inf)
    V = np.diag(noise)
    if shared_m > 0:
        distance = np.linalg.norm(p[:, None] - p, axis=2)
        V += variance * (normals @ normals.T) * np.exp(-distance / (_SHARED_LENGTH * diagonal))
    J, _ = _jacobian(p - p.mean(0), normals)
    weighted = J * n[:, None]
    A = _inverse(J.T @ weighted)[0] @ weighted.T
    half = J @ (A @ V)  # P is 1 - J A
    return np.asarray(V - half - half.T + J @ (A @ V @ A.T) @ J.T)
