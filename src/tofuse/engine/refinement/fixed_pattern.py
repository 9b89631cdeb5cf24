"""Depth errors that are fixed to the camera, over the image and the range, from all views.

A depth camera has errors of millimetres that vary smoothly over the image: remainders of its
calibration, of the lens and of the maker's filters. And the range of a time-of-flight camera has a
periodic error, as its light is no pure sine (Lindner and Kolb 2006). They move with the camera, so
that neighbouring views fit best where the path is bent, and no residual shows it. But a surface
that moves through the image, or comes nearer, meets different errors. From this they are estimated,
as Teichman, Miller and Thrun do from a map (Unsupervised intrinsic calibration of depth sensors via
SLAM, 2013), here with the relative pose of each pair of views free.

Both are sums of cosines, whose coefficients have one variance each, which the views tell as well
(empirical Bayes): where there is no pattern, it vanishes. Other errors, such as multipath, differ
from view to view, and their scatter divides the information.

Errors of triangulation, in the disparity, grow with the squared depth. Those that exceed the noise
are left alone: they reach centimetres, and the recorded images would no longer agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.compute import one_blas_thread, run_chunks
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.normal import robust_sigma
from tofuse.engine.refinement.calibration_check import TOLERANCES, USUAL
from tofuse.engine.refinement.camera_response import SECTIONS
from tofuse.engine.stored_views import SampledView, pair_equations
from tofuse.engine.views import residual_kernels

# Half periods of the cosines across and down; without the constant, the range offset of the camera.
_ACROSS, _DOWN = 7, 6
_ORDERS = np.array([(a, b) for a in range(_ACROSS) for b in range(_DOWN) if a or b])
# Largest number of cosines along the range, between these quantiles of all; and their longest and
# shortest period, m: of the fourth harmonic of light that is modulated at 20 and at 200 MHz.
# Multipath changes more smoothly.
_ALONG, _WITHIN, _LONGEST, _SHORTEST = 16, (0.01, 0.99), 1.9, 0.19
# Ranges at which their sum is stored, and from which they are chosen.
_TABLE, _MAX_RANGES = 1024, 20_000
# Errors of the calibration, which are estimated as well.
_ERRORS = "focal", "center_x", "center_y", "distortion", "offset"
# The errors of time of flight are the same at each depth, those of triangulation, in the disparity,
# grow with its square, and so do some of multipath: powers that are tried.
_POWERS = 0.0, 2.0
# Views are compared with the ones this many later, and at most so many pairs in all.
_LAGS, _MAX_PAIRS = (1, 2, 4, 8), 200
_PAIRS_A_CHUNK = 8
_RUN = 16  # views of a run, where there are too many views for all to be in memory
# Minimum number of points of a pair, and of views: one for each section of the path.
_MIN_POINTS, _MIN_VIEWS = 50, SECTIONS
# Added to the sigma of the residuals, m: at first they contain the pattern, and its largest errors
# would be outliers.
_INFLATIONS = 0.02, 0.005, 0.0
# Prior sigma of the relative pose of a pair, m and rad.
_POSE_SIGMA = 0.02
# Prior information of the pose and of the exposure, a log albedo.
_PRIOR = np.array([1 / _POSE_SIGMA**2] * 6 + [1.0])
# Logarithm of the factor by which views are likelier with a pattern: strong evidence (Jeffreys).
_STRONG = float(np.log(10))
# Iterations for the variance of the coefficients, from this sigma, m.
_ITERATIONS, _FIRST_SIGMA = 20, 0.002


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What is to be added to the depth of views of one camera.

    Attributes
    ----------
    z
        (H, W) m, along the ray, at `depth`, with a mean of about 0; None without strong evidence
        for any error.
    profile, reach
        (TABLE,) m, what is to be added to the range at ranges from 0 to `reach`, m. But for a
        constant and a scale, which are errors of the calibration.
    depth, power
        m, and power of the depth relative to this, to which both are proportional.
    """

    z: Float32 | None
    profile: Float32 = field(default_factory=lambda: np.zeros(_TABLE, np.float32))
    reach: float = 1.0
    depth: float = 1.0
    power: float = 0.0

    def corrected(self, view: SampledView) -> SampledView:
        """Return a view without these errors: its points, and the planes of its target image."""
        if self.z is None:
            return view
        points, target = view.points.copy(), view.target.copy()
        z = points[:, 2]
        change = self.at(z, self.z.ravel()[_pixels(view)], _lengths(points))
        points[:, :3] *= (1 + change / z)[:, None]
        rays = view.projection.rays
        along = (target[..., :2] * rays).sum(-1) + target[..., 2]
        distance = target[..., residual_kernels.DISTANCE]
        scale = np.float32(view.target_scale)
        of_planes = np.divide(distance * scale, along, out=np.zeros_like(along), where=along != 0)
        change = self.at(of_planes, self.z, np.sqrt(1 + (rays**2).sum(-1)))
        distance += np.where(distance != 0, along * change / scale, 0)
        return replace(view, points=points, target=target)

    def at(self, z: Float32, pattern: Float32, lengths: Float32) -> Float32:
        """Return what is to be added at depths z, m, to pixels with these values of the pattern.

        `lengths` are those of their rays at depth 1.
        """
        entries = z * lengths * np.float32(len(self.profile) / self.reach)
        entry = np.nan_to_num(entries).clip(0, len(self.profile) - 1).astype(np.intp)
        factor = (z / np.float32(self.depth)) ** np.float32(self.power)
        return np.asarray((pattern + self.profile[entry] / lengths) * factor, np.float32)


NONE = FixedPattern(None)


def _pixels(view: SampledView) -> Intp:
    """Return the (N,) indices of the pixels of a view's points."""
    rows, columns = view.target.shape[:2]
    points = view.points.astype(np.float64)
    u, v = np.rint(view.projection.pixels(points[:, :2] / points[:, 2:3])).T
    return (v.clip(0, rows - 1) * columns + u.clip(0, columns - 1)).astype(np.intp)


def _lengths(points: Float32) -> Float32:
    """Return the lengths (N,) of the rays of points (N, 3 or more) at depth 1."""
    return np.asarray(np.linalg.norm(points[:, :3], axis=1) / points[:, 2], np.float32)


def runs(count: int) -> Intp:
    """Return the positions of some of `count` views: evenly spaced runs of successive ones."""
    starts = np.linspace(0, max(count - _RUN, 0), SECTIONS).astype(np.intp)
    return np.unique((starts[:, None] + np.arange(min(_RUN, count))).ravel())


@one_blas_thread()
def estimate(
    views: Sequence[SampledView],
    poses: Float64,
    options: pair_equations.RefineOptions,
    positions: Intp | None = None,
) -> FixedPattern:
    """Estimate the pattern from some pairs of views.

    Parameters
    ----------
    views, poses
        N views of one camera, in order, and their (N, 4, 4) T_world_camera.
    options
        Of the refinement.
    positions
        (N,) ascending positions of the views among all; by default, these are all.
    """
    shape = views[0].target.shape[:2] if views else (0, 0)
    if len(views) < _MIN_VIEWS or any(view.target.shape[:2] != shape for view in views):
        return NONE
    pairs = _pairs(np.arange(len(views)) if positions is None else positions)
    compared = _compared(views, pairs, poses, photometric=options.photometric)
    if not compared:
        return NONE
    depth = float(np.median([view.depth for view in views]))
    cosines = _cosines(shape)
    ranges = np.concatenate([np.linalg.norm(view.points[:, :3], axis=1) for view in views])
    ranges = ranges[:: -(-len(ranges) // _MAX_RANGES)]
    modes, fit = _likeliest(compared, cosines, depth, ranges)
    # A wrong calibration is to be corrected first: the pattern would take some of its effects.
    if fit.log_ratio < _STRONG or not fit.is_calibrated:
        return NONE
    z = modes.over_image(fit.coefficients).reshape(shape)
    if modes.power and z.std() > np.median([view.sigma for view in views]):
        return NONE
    if modes.periods is None:
        return FixedPattern(z, depth=depth, power=modes.power)
    _, reach = modes.periods.within
    centres = ((np.arange(_TABLE) + 0.5) * reach / _TABLE).astype(np.float32)
    return FixedPattern(z, modes.along(centres, fit.coefficients), reach, depth, modes.power)


def _likeliest(
    compared: Sequence[_Compared], cosines: Float32, depth: float, ranges: Float32
) -> tuple[_Modes, _Fit]:
    """Return the likeliest modes, over the image alone or also along ranges (N,), and their fit."""
    # Half of the pairs tell which power is likelier.
    tried = [_Modes(cosines, depth, power) for power in _POWERS]
    first = [_fitted(compared[::2], modes, modes.zero, _INFLATIONS[0]) for modes in tried]
    modes, fit = max(zip(tried, first, strict=True), key=lambda item: item[1].log_ratio)
    periodic = _Modes(cosines, depth, periods=_Periods.of(ranges))
    of_range = _of_range(compared, periodic, least=fit.log_ratio + _STRONG)
    for inflation in _INFLATIONS[1:]:
        fit = _fitted(compared, modes, fit.coefficients, inflation)
    if of_range is not None and of_range.log_ratio > fit.log_ratio + _STRONG:
        # Along the range, a larger pattern over the image leaves something, too.
        along = periodic.along(ranges, of_range.coefficients)
        if along.std() > periodic.over_image(of_range.coefficients).std():
            modes, fit = periodic, of_range
    return modes, fit


def _cosines(shape: tuple[int, ...]) -> Float32:
    """Return the modes (H W, ORDERS) of an image (H, W)."""
    v, u = np.indices(shape).reshape(2, -1)
    phase = np.pi * (np.stack([u, v], 1) + 0.5) / shape[::-1]
    return np.prod(np.cos(phase[:, None] * _ORDERS), axis=2).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Periods:
    """Cosines along the range.

    Attributes
    ----------
    ranges, within
        (N,) that points have, and the lowest and the highest of those with different errors, m.
    half_periods
        (K,) up to the highest.
    lines
        (2, K) constant and slope that are subtracted from the cosines.
    """

    ranges: Float32
    within: tuple[float, float]
    half_periods: Float32
    lines: Float32

    @classmethod
    def of(cls, ranges: Float32) -> _Periods:
        """Choose those of points with ranges (N,), m."""
        low, high = np.quantile(ranges, _WITHIN).tolist()
        longest = np.clip(high - low, 1e-3, _LONGEST)
        least, most = 2 * high / longest, 2 * high / _SHORTEST
        count = np.arange(np.ceil(least), most + 1, dtype=np.float32)[:_ALONG]
        periods = cls(ranges, (low, high), count, np.zeros((2, len(count)), np.float32))
        line = np.column_stack([np.ones_like(ranges), ranges])
        lines = np.linalg.lstsq(line, periods.at(ranges), rcond=None)[0]
        return replace(periods, lines=lines.astype(np.float32))

    def at(self, ranges: Float32) -> Float32:
        """Return them (N, K) at ranges (N,), m."""
        ranges = np.asarray(np.clip(ranges, *self.within), np.float32)
        phase = np.float32(np.pi / self.within[1]) * ranges
        line = self.lines[0] + self.lines[1] * ranges[:, None]
        return np.asarray(np.cos(phase[:, None] * self.half_periods) - line, np.float32)


@dataclass(frozen=True, eq=False)
class _Modes:
    """Changes of the depth.

    Attributes
    ----------
    cosines
        (H W, ORDERS) over the image.
    depth, power
        m, and power of the depth relative to this, to which the changes are proportional.
    periods
        Those along the range, if there are any.
    """

    cosines: Float32
    depth: float
    power: float = 0.0
    periods: _Periods | None = None

    @property
    def groups(self) -> tuple[slice, ...]:
        """Which modes are over the image, and which along the range."""
        of_image = self.cosines.shape[1]
        if self.periods is None:
            return (slice(0, of_image),)
        return slice(0, of_image), slice(of_image, of_image + len(self.periods.half_periods))

    @property
    def count(self) -> int:
        """Number of modes."""
        return int(self.groups[-1].stop)

    @property
    def zero(self) -> Float64:
        """Coefficients of the modes, and errors, that are 0 (UNKNOWNS,)."""
        return np.zeros(self.count + len(_ERRORS))

    def over_image(self, coefficients: Float64) -> Float32:
        """Return the sum (H W,) of those over the image, m."""
        return (self.cosines @ coefficients[self.groups[0]]).astype(np.float32)

    def along(self, ranges: Float32, coefficients: Float64) -> Float32:
        """Return the sum (N,) of those along the range at ranges (N,), m."""
        assert self.periods is not None, "there are such modes"
        return (self.periods.at(ranges) @ coefficients[self.groups[1]]).astype(np.float32)


def _pairs(positions: Intp) -> Intp:
    """Return (P, 2) of the views at these positions: by lag, so that every n-th has all of them."""
    found = []
    for lag in _LAGS:
        later = np.searchsorted(positions, positions + lag)
        earlier = np.flatnonzero(positions[later % len(positions)] == positions + lag)
        found.append(np.stack([earlier, later[earlier]], 1))
    pairs = np.concatenate(found)
    return pairs[:: -(-len(pairs) // _MAX_PAIRS)]


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays of one view along which residuals change.

    Attributes
    ----------
    pixels, points
        (N,) of the rays, and (N, 3) points on them, m.
    per_z
        (N,) change of the residual with their depth.
    """

    pixels: Intp
    points: Float32
    per_z: Float32

    def by(self, modes: _Modes) -> Float32:
        """Return the changes of the residuals by the coefficients of the modes, (N, MODES)."""
        z, lengths = self.points[:, 2], _lengths(self.points)
        factor = self.per_z * (z / np.float32(modes.depth)) ** np.float32(modes.power)
        columns = modes.cosines[self.pixels]
        if modes.periods is not None:
            along = modes.periods.at(z * lengths) / lengths[:, None]
            columns = np.concatenate([columns, along], axis=1)
        return np.asarray(columns * factor[:, None], np.float32)


@dataclass(frozen=True, eq=False)
class _Differences:
    """Distances of points from the planes of another view, m, or differences of the log albedo.

    Attributes
    ----------
    residuals
        (N,).
    by_pose
        (N, 7) their Jacobian by the right perturbation of T_target_source and by the exposure.
    by_errors
        (N, ERRORS) by the errors of the calibration.
    rays
        Of the source, and of the target if its depth matters.
    """

    residuals: Float32
    by_pose: Float32
    by_errors: Float32
    rays: tuple[_Rays, ...]

    def rows(self, modes: _Modes) -> Float32:
        """Return the Jacobian by pose, exposure, coefficients and errors, and the residuals.

        As (N, 7 + UNKNOWNS + 1).
        """
        by_modes = self.rays[0].by(modes)
        for target in self.rays[1:]:
            by_modes -= target.by(modes)
        columns = self.by_pose, by_modes, self.by_errors, self.residuals[:, None]
        return np.concatenate(columns, axis=1)


def _root_weights(residuals: Float32, inflation: float) -> Float32:
    """Return the square roots (N, 1) of robust weights of residuals (N,)."""
    sigma = max(robust_sigma(residuals), 1e-6)
    cutoff = projective.ROBUST * np.hypot(sigma, inflation)
    weights = tukey.weights((residuals.astype(np.float64) / cutoff) ** 2)
    return np.asarray(np.sqrt(weights)[:, None] / sigma, np.float32)


@dataclass(frozen=True, eq=False)
class _Compared:
    """A pair of views.

    Attributes
    ----------
    target
        Position of the view that the points are compared with.
    terms
        Distances, and albedo if both views have it.
    """

    target: int
    terms: tuple[_Differences, ...]

    def equations(self, modes: _Modes, coefficients: Float64, inflation: float) -> Float64:
        """Return the normal equations of the coefficients and errors, without the pose.

        With robust weights of the residuals that these leave, at the best pose: (UNKNOWNS + 1,
        UNKNOWNS + 1), of which the last column is the gradient.
        """
        terms = [term.rows(modes) for term in self.terms]
        unknowns = np.concatenate([_best_step(terms, coefficients), coefficients, [1.0]])
        M = np.zeros((len(unknowns), len(unknowns)))
        for rows in terms:
            weighted = _root_weights(rows @ unknowns.astype(np.float32), inflation) * rows
            M += weighted.T @ weighted
        pose = M[:7, :7] + np.diag(_PRIOR)
        return np.asarray(M[7:, 7:] - M[7:, :7] @ np.linalg.solve(pose, M[:7, 7:]), np.float64)


def _best_step(terms: Sequence[Float32], coefficients: Float64) -> Float64:
    """Return the step (7,) of the pose and the exposure, without outliers by far."""
    M = np.zeros((8, 8))
    unknowns = np.append(coefficients, 1.0).astype(np.float32)
    for rows in terms:
        left = rows[:, 7:] @ unknowns
        weighted = _root_weights(left, _INFLATIONS[0]) * np.column_stack([rows[:, :7], left])
        M += weighted.T @ weighted
    return np.asarray(-np.linalg.solve(M[:7, :7] + np.diag(_PRIOR), M[:7, 7]), np.float64)


def _compared(
    views: Sequence[SampledView], pairs: Intp, poses: Float64, *, photometric: bool
) -> list[_Compared]:
    """Compare pairs (P, 2) of views, without those that are apart."""
    pixels = [_pixels(view) for view in views]

    def work(a: int, b: int) -> list[_Compared]:
        result = []
        for t, s in pairs[a:b].tolist():
            T = (se3.inverse(poses[t]) @ poses[s]).astype(np.float32)
            terms = _terms(views[s], pixels[s], views[t], T, photometric=photometric)
            if terms:
                result.append(_Compared(t, terms))
        return result

    chunks = run_chunks(work, len(pairs), -(-len(pairs) // _PAIRS_A_CHUNK))
    return [pair for chunk in chunks for pair in chunk]


def _terms(
    source: SampledView, pixels: Intp, target: SampledView, T: Float32, *, photometric: bool
) -> tuple[_Differences, ...]:
    """Compare a source's points, which are at these pixels, with the target.

    T is (4, 4) T_target_source. Empty if few points see surfaces of the target. A change of the
    depth moves a point along its ray, and the plane along that of the target; the albedo of the
    target depends on the ray alone.
    """
    k, (rows, columns) = residual_kernels, target.target.shape[:2]
    R, points = T[:3, :3], source.points
    q = points[:, :3] @ R.T + T[:3, 3]
    projected = (q[:, :2] / np.maximum(q[:, 2:], 1e-3)).astype(np.float64)
    u, v = np.rint(target.projection.pixels(projected)).T
    inside = (q[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    pixel = np.where(inside, v * columns + u, 0).astype(np.intp)
    image = target.target.reshape(-1, k.PIXEL_SIZE)[pixel]
    n, distance = image[:, :3], image[:, k.DISTANCE] * np.float32(target.target_scale)
    normal = points[:, k.NORMAL : k.NORMAL + 3]
    seen = inside & (distance != 0) & ((n @ R * normal).sum(1) > projective.MIN_COSINE)
    # Planes fitted to mere noise can have unbounded coefficients.
    seen &= np.isfinite(image[:, : k.VARIANCE]).all(1) & np.isfinite(normal).all(1)
    if np.count_nonzero(seen) < _MIN_POINTS:
        return ()

    def term(which: Bool, r: Float32, n: Float32, exposure: float) -> _Differences:
        p, q_, n, m = points[which, :3], q[which], n[which], n[which] @ R
        by_pose = np.column_stack([m, np.cross(p, m), np.full(len(p), exposure, np.float32)])
        of_source, by_errors = _by_camera(m, p, radial=source.measures_range)
        of_target, errors = _by_camera(n, q_, radial=target.measures_range)
        rays = [_Rays(pixels[which], p, of_source)]
        if exposure:
            errors[:, -1] = 0.0
        else:
            rays.append(_Rays(pixel[which], q_, of_target))
        return _Differences(r[which], by_pose, by_errors - errors, tuple(rays))

    distances = term(seen, (n * q).sum(1) - distance, n, 0.0)
    if not (photometric and source.has_albedo and target.has_albedo):
        return (distances,)
    z = np.where(seen, q[:, 2], 1.0)
    slope, ray = image[:, k.ALBEDO_SLOPE : k.ALBEDO_SLOPE + 2], q[:, :2] / z[:, None]
    along = (slope * ray).sum(1)
    difference = image[:, k.ALBEDO] + along - points[:, k.POINT_ALBEDO]
    known = seen & np.isfinite(difference)
    if np.count_nonzero(known) < _MIN_POINTS:
        return (distances,)
    gradient = np.column_stack([slope, -along]) / z[:, None]
    gradient += points[:, k.POINT_ALBEDO_SLOPE : k.POINT_ALBEDO_SLOPE + 3] @ R.T
    difference -= np.median(difference[known])
    return distances, term(known, difference, (0.5 * gradient).astype(np.float32), -1.0)


def _by_camera(m: Float32, p: Float32, *, radial: bool) -> tuple[Float32, Float32]:
    """Return how distances (N,) along m (N, 3) of points p (N, 3) change with the camera's errors.

    By the depth, (N,), and by the errors of the calibration, (N, ERRORS): see
    `pair_equation_kernels`.
    """
    along = (m * p).sum(1)
    square = (p * p).sum(1)
    x, y, z = p.T
    # What a lateral displacement adds to the range is not kept, if the camera measures that.
    kept = along / square if radial else np.zeros(len(p), np.float32)
    by_x, by_y = m[:, 0] - x * kept, m[:, 1] - y * kept
    longer = x * by_x + y * by_y
    errors = [longer, z * by_x, z * by_y, (x * x + y * y) / z**2 * longer, along / np.sqrt(square)]
    return along / z, np.column_stack(errors)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Coefficients and errors (UNKNOWNS,), and how much likelier the views are with a pattern."""

    coefficients: Float64
    log_ratio: float

    @property
    def is_calibrated(self) -> bool:
        """Whether no error exceeds the tolerance."""
        errors = zip(_ERRORS, self.coefficients[-len(_ERRORS) :], strict=True)
        return all(abs(error) <= TOLERANCES[name] for name, error in errors)


def _of_range(compared: Sequence[_Compared], modes: _Modes, least: float) -> _Fit | None:
    """Fit errors along the range as well; None if the views are not likelier than `least`.

    Or if these, or errors of the calibration beside them, exceed those of usual cameras: they then
    show something else, such as multipath, or are not told from these.
    """
    assert modes.periods is not None, "there are such modes"
    coefficients, some = modes.zero, compared[::2]
    if not len(modes.periods.half_periods):
        return None
    for inflation in _INFLATIONS:
        fit = _fitted(some, modes, coefficients, inflation)
        coefficients, some = fit.coefficients, compared
        too_large = modes.along(modes.periods.ranges, coefficients).std() > USUAL
        if too_large or not fit.is_calibrated or fit.log_ratio < least:
            return None
    return fit


def _fitted(
    compared: Sequence[_Compared], modes: _Modes, coefficients: Float64, inflation: float
) -> _Fit:
    """Fit coefficients with the robust weights at the last ones.

    Their variances maximise the likelihood (expectation maximisation). The information is divided
    by the scatter of the scores of sections of the path, by the targets of the pairs, relative to
    that by noise alone: within a section, views share the errors of the scene.
    """

    def work(a: int, b: int) -> list[Float64]:
        return [pair.equations(modes, coefficients, inflation) for pair in compared[a:b]]

    chunks = run_chunks(work, len(compared), -(-len(compared) // _PAIRS_A_CHUNK))
    equations = np.array([pair for chunk in chunks for pair in chunk])
    A, g = equations[:, :-1, :-1], equations[:, :-1, -1]
    target = np.array([pair.target for pair in compared])
    total, gradient = A.sum(0), g.sum(0)
    section = target * SECTIONS // (int(target.max()) + 1)
    count, usual = modes.count, np.full(len(_ERRORS), USUAL**2)
    c, dispersion = np.zeros(len(total)), 1.0
    prior = np.append(np.full(count, _FIRST_SIGMA**2), usual)
    for _ in range(_ITERATIONS):
        covariance = np.linalg.inv(total / dispersion + np.diag(1 / prior))
        c = -covariance @ gradient / dispersion
        for group in modes.groups:
            prior[group] = np.mean(c[group] ** 2 + np.diag(covariance)[group])
        scores = np.zeros((SECTIONS, count))
        np.add.at(scores, section, (g + A @ c)[:, :count])
        scatter = float(scores.var(0, ddof=1).sum()) * SECTIONS
        dispersion = max(scatter / float(np.trace(total[:count, :count])), 1.0)
    without = np.append(np.zeros(count), usual)
    with_pattern, none = (
        _log_evidence(total / dispersion, gradient / dispersion, p) for p in (prior, without)
    )
    return _Fit(c, with_pattern - none)


def _log_evidence(A: Float64, g: Float64, prior: Float64) -> float:
    """Logarithm of the evidence of normal equations, with prior variances, against all being 0."""
    covariance = prior[:, None] * np.linalg.inv(np.eye(len(A)) + A * prior)
    return 0.5 * float(g @ covariance @ g - np.linalg.slogdet(np.eye(len(A)) + A * prior)[1])
