"""Depth errors that are fixed to the camera: a pattern over the image, estimated from all views.

A depth camera has errors of millimetres that vary smoothly over the image: remainders of its
calibration, of the lens and of the maker's filters. They move with the camera, so that neighbouring
views fit best where the path is bent, and no residual shows it. But a surface that moves through
the image meets different errors. From this the pattern is estimated, as Teichman, Miller and Thrun
do from a map (Unsupervised intrinsic calibration of depth sensors via SLAM, 2013), here with the
relative pose of each pair of views free.

The pattern is a sum of cosines, whose coefficients have one variance, which the views tell as well
(empirical Bayes): where there is no pattern, it vanishes. Other errors, such as multipath, differ
from view to view, and their scatter divides the information.

Errors of triangulation, in the disparity, grow with the squared depth. Those that exceed the noise
are left alone: they reach centimetres, and the recorded images would no longer agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
_MODES = len(_ORDERS)
# Errors of the calibration, which are estimated as well.
_ERRORS = "focal", "center_x", "center_y", "distortion", "offset"
_UNKNOWNS = _MODES + len(_ERRORS)
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
_ZERO = np.zeros(_UNKNOWNS)


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What is to be added to the depth of views of one camera.

    Attributes
    ----------
    z
        (H, W) m, along the ray, at `depth`, with a mean of about 0; None without strong evidence
        for any.
    depth, power
        m, and power of the depth relative to this, to which the errors are proportional.
    """

    z: Float32 | None
    depth: float = 1.0
    power: float = 0.0

    def corrected(self, view: SampledView) -> SampledView:
        """Return a view without these errors: its points, and the planes of its target image."""
        if self.z is None:
            return view
        points, target = view.points.copy(), view.target.copy()
        z = points[:, 2]
        points[:, :3] *= (1 + self.at(z, self.z.ravel()[_pixels(view)]) / z)[:, None]
        along = (target[..., :2] * view.projection.rays).sum(-1) + target[..., 2]
        distance = target[..., residual_kernels.DISTANCE]
        scale = np.float32(view.target_scale)
        of_planes = np.divide(distance * scale, along, out=np.zeros_like(along), where=along != 0)
        distance += np.where(distance != 0, along * self.at(of_planes, self.z) / scale, 0)
        return replace(view, points=points, target=target)

    def at(self, z: Float32, pattern: Float32) -> Float32:
        """Return what is to be added at depths z, m, to pixels with these values of the pattern."""
        return np.asarray(pattern * (z / np.float32(self.depth)) ** np.float32(self.power))


NONE = FixedPattern(None)


def _pixels(view: SampledView) -> Intp:
    """Return the (N,) indices of the pixels of a view's points."""
    rows, columns = view.target.shape[:2]
    points = view.points.astype(np.float64)
    u, v = np.rint(view.projection.pixels(points[:, :2] / points[:, 2:3])).T
    return (v.clip(0, rows - 1) * columns + u.clip(0, columns - 1)).astype(np.intp)


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

    # Half of the pairs tell which power is likelier.
    tried = [_Modes(cosines, depth, power) for power in _POWERS]
    first = [_fitted(compared[::2], modes, _ZERO, _INFLATIONS[0]) for modes in tried]
    modes, fit = max(zip(tried, first, strict=True), key=lambda item: item[1].log_ratio)
    for inflation in _INFLATIONS[1:]:
        fit = _fitted(compared, modes, fit.coefficients, inflation)
    errors = zip(_ERRORS, fit.coefficients[_MODES:], strict=True)
    # A wrong calibration is to be corrected first: the pattern would take some of its effects.
    if fit.log_ratio < _STRONG or any(abs(error) > TOLERANCES[name] for name, error in errors):
        return NONE
    z = (cosines @ fit.coefficients[:_MODES]).astype(np.float32).reshape(shape)
    if modes.power and z.std() > np.median([view.sigma for view in views]):
        return NONE
    return FixedPattern(z, depth, modes.power)


def _cosines(shape: tuple[int, ...]) -> Float32:
    """Return the modes (H W, MODES) of an image (H, W)."""
    v, u = np.indices(shape).reshape(2, -1)
    phase = np.pi * (np.stack([u, v], 1) + 0.5) / shape[::-1]
    return np.prod(np.cos(phase[:, None] * _ORDERS), axis=2).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Modes:
    """Changes of the depth.

    Attributes
    ----------
    cosines
        (H W, MODES).
    depth, power
        m, and power of the depth relative to this, to which the changes are proportional.
    """

    cosines: Float32
    depth: float
    power: float


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
    pixels, z
        (N,) of the rays, and depth of the points on them, m.
    per_z
        (N,) change of the residual with this depth.
    """

    pixels: Intp
    z: Float32
    per_z: Float32

    def by(self, modes: _Modes) -> Float32:
        """Return the changes of the residuals by the coefficients of the modes, (N, MODES)."""
        factor = self.per_z * (self.z / np.float32(modes.depth)) ** np.float32(modes.power)
        return np.asarray(modes.cosines[self.pixels] * factor[:, None], np.float32)


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
        rays = [_Rays(pixels[which], p[:, 2], of_source)]
        if exposure:
            errors[:, -1] = 0.0
        else:
            rays.append(_Rays(pixel[which], q_[:, 2], of_target))
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


def _fitted(
    compared: Sequence[_Compared], modes: _Modes, coefficients: Float64, inflation: float
) -> _Fit:
    """Fit coefficients with the robust weights at the last ones.

    Their variance maximises the likelihood (expectation maximisation). The information is divided
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
    pattern = np.arange(_MODES)
    c, variance, dispersion = np.zeros(_UNKNOWNS), _FIRST_SIGMA**2, 1.0
    for _ in range(_ITERATIONS):
        prior = np.append(np.full(_MODES, variance), np.full(len(_ERRORS), USUAL**2))
        covariance = np.linalg.inv(total / dispersion + np.diag(1 / prior))
        c = -covariance @ gradient / dispersion
        variance = float(c[pattern] @ c[pattern] + np.trace(covariance[:_MODES, :_MODES])) / _MODES
        scores = np.zeros((SECTIONS, _MODES))
        np.add.at(scores, section, (g + A @ c)[:, pattern])
        scatter = float(scores.var(0, ddof=1).sum()) * SECTIONS
        dispersion = max(scatter / float(np.trace(total[:_MODES, :_MODES])), 1.0)
    without = np.append(np.zeros(_MODES), np.full(len(_ERRORS), USUAL**2))
    with_pattern, none = (
        _log_evidence(total / dispersion, gradient / dispersion, p) for p in (prior, without)
    )
    return _Fit(c, with_pattern - none)


def _log_evidence(A: Float64, g: Float64, prior: Float64) -> float:
    """Logarithm of the evidence of normal equations, with prior variances, against all being 0."""
    covariance = prior[:, None] * np.linalg.inv(np.eye(len(A)) + A * prior)
    return 0.5 * float(g @ covariance @ g - np.linalg.slogdet(np.eye(len(A)) + A * prior)[1])
