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
    cosines = _cosines(shape)
    depth = float(np.median([view.depth for view in views]))

    def fitted(power: float) -> _Fit:
        fit, modes = _Fit(np.zeros(_UNKNOWNS), -np.inf), _Modes(cosines, depth, power)
        compared = _compared(views, pairs, poses, modes, photometric=options.photometric)
        for inflation in _INFLATIONS if compared else ():
            fit = _fitted(compared, fit.coefficients, inflation)
        return fit

    power, fit = max(((p, fitted(p)) for p in _POWERS), key=lambda item: item[1].log_ratio)
    errors = zip(_ERRORS, fit.coefficients[_MODES:], strict=True)
    # A wrong calibration is to be corrected first: the pattern would take some of its effects.
    if fit.log_ratio < _STRONG or any(abs(error) > TOLERANCES[name] for name, error in errors):
        return NONE
    z = (cosines @ fit.coefficients[:_MODES]).astype(np.float32).reshape(shape)
    if power and z.std() > np.median([view.sigma for view in views]):
        return NONE
    return FixedPattern(z, depth, power)


def _cosines(shape: tuple[int, ...]) -> Float64:
    """Return the modes (H W, MODES) of an image (H, W)."""
    v, u = np.indices(shape).reshape(2, -1)
    phase = np.pi * (np.stack([u, v], 1) + 0.5) / shape[::-1]
    return np.asarray(np.prod(np.cos(phase[:, None] * _ORDERS), axis=2), np.float64)


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

    cosines: Float64
    depth: float
    power: float

    def at(self, pixels: Intp, z: Float64) -> Float64:
        """Return the (N, MODES) changes for points at pixels (N,) and depths (N,), m."""
        changes = self.cosines[pixels] * ((z / self.depth) ** self.power)[:, None]
        return np.asarray(changes, np.float64)


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
class _Residuals:
    """Distances of points from the planes of another view, m, or differences of the log albedo.

    Attributes
    ----------
    residuals
        (N,).
    J
        (N, 7 + UNKNOWNS) their Jacobian by the right perturbation of T_target_source, exposure,
        coefficients and errors of the calibration.
    """

    residuals: Float64
    J: Float64

    def left(self, step: Float64, coefficients: Float64) -> Float64:
        """Return the residuals after a step (7,), with these coefficients and errors."""
        return np.asarray(self.residuals + self.J @ np.append(step, coefficients), np.float64)


def _weights(residuals: Float64, inflation: float) -> Float64:
    """Return robust weights (N, 1) of residuals (N,)."""
    sigma = max(robust_sigma(residuals), 1e-6)
    cutoff = projective.ROBUST * np.hypot(sigma, inflation)
    return np.asarray(tukey.weights((residuals / cutoff) ** 2)[:, None] / sigma**2, np.float64)


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
    terms: tuple[_Residuals, ...]

    def equations(self, coefficients: Float64, inflation: float) -> tuple[Float64, Float64]:
        """Return the normal equations of the coefficients and errors, without the pose.

        With robust weights of the residuals that these leave, at the best pose.
        """
        step = self._best_step(coefficients)
        H, g = np.diag(np.append(_PRIOR, np.zeros(_UNKNOWNS))), np.zeros(7 + _UNKNOWNS)
        for term in self.terms:
            wJ = _weights(term.left(step, coefficients), inflation) * term.J
            H += term.J.T @ wJ
            g += term.residuals @ wJ
        coupling = H[:7, 7:]
        eliminated = np.linalg.solve(H[:7, :7], np.column_stack([coupling, g[:7]]))
        without = coupling.T @ eliminated
        return H[7:, 7:] - without[:, :-1], g[7:] - without[:, -1]

    def _best_step(self, coefficients: Float64) -> Float64:
        """Return the step (7,) of the pose and the exposure, without outliers by far."""
        H, g = np.diag(_PRIOR), np.zeros(7)
        for term in self.terms:
            left, J = term.left(np.zeros(7), coefficients), term.J[:, :7]
            wJ = _weights(left, _INFLATIONS[0]) * J
            H += J.T @ wJ
            g += left @ wJ
        return np.asarray(-np.linalg.solve(H, g), np.float64)


def _compared(
    views: Sequence[SampledView], pairs: Intp, poses: Float64, modes: _Modes, *, photometric: bool
) -> list[_Compared]:
    """Compare pairs (P, 2) of views, without those that are apart."""
    pixels = [_pixels(view) for view in views]

    def work(a: int, b: int) -> list[_Compared]:
        result = []
        for k in range(a, b):
            t, s = pairs[k].tolist()
            T = se3.inverse(poses[t]) @ poses[s]
            terms = _terms(views[s], pixels[s], views[t], T, modes, photometric=photometric)
            if terms:
                result.append(_Compared(t, terms))
        return result

    chunks = run_chunks(work, len(pairs), -(-len(pairs) // _PAIRS_A_CHUNK))
    return [pair for chunk in chunks for pair in chunk]


def _terms(
    source: SampledView,
    pixels: Intp,
    target: SampledView,
    T: Float64,
    modes: _Modes,
    *,
    photometric: bool,
) -> tuple[_Residuals, ...]:
    """Compare a source's points, which are at these pixels, with the target.

    T is (4, 4) T_target_source. Empty if few points see surfaces of the target. A change of the
    depth moves a point along its ray, and the plane along that of the target; the albedo of the
    target depends on the ray alone.
    """
    k, (rows, columns) = residual_kernels, target.target.shape[:2]
    points = source.points.astype(np.float64)
    q = se3.transform(T, points[:, :3])
    u, v = np.rint(target.projection.pixels(q[:, :2] / np.maximum(q[:, 2:], 1e-3))).T
    inside = (q[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    pixel = np.where(inside, v * columns + u, 0).astype(np.intp)
    image = target.target.reshape(-1, k.PIXEL_SIZE)[pixel].astype(np.float64)
    n, distance = image[:, :3], image[:, k.DISTANCE] * target.target_scale
    m, normal = n @ T[:3, :3], points[:, k.NORMAL : k.NORMAL + 3]
    seen = inside & (distance != 0) & ((m * normal).sum(1) > projective.MIN_COSINE)
    # Planes fitted to mere noise can have unbounded coefficients.
    seen &= np.isfinite(image[:, : k.VARIANCE]).all(1) & np.isfinite(normal).all(1)
    if np.count_nonzero(seen) < _MIN_POINTS:
        return ()

    def term(which: Bool, r: Float64, n: Float64, exposure: float) -> _Residuals:
        p, m = points[which, :3], n[which] @ T[:3, :3]
        by_pose = np.column_stack([m, np.cross(p, m), np.full(len(p), exposure)])
        by_camera = _by_camera(m, p, modes.at(pixels[which], p[:, 2]), radial=source.measures_range)
        of_target = _by_camera(
            n[which],
            q[which],
            modes.at(pixel[which], q[which, 2]),
            radial=target.measures_range,
        )
        if exposure:  # the albedo of the target depends on the ray alone
            of_target[:, :_MODES] = of_target[:, -1] = 0.0
        return _Residuals(r[which], np.column_stack([by_pose, by_camera - of_target]))

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
    gradient += points[:, k.POINT_ALBEDO_SLOPE : k.POINT_ALBEDO_SLOPE + 3] @ T[:3, :3].T
    difference -= np.median(difference[known])
    return distances, term(known, difference, 0.5 * gradient, -1.0)


def _by_camera(m: Float64, p: Float64, modes: Float64, *, radial: bool) -> Float64:
    """Return how distances (N,) along m (N, 3) of points p (N, 3) change with the camera's errors.

    By the coefficients of the modes (N, MODES) at their pixels, and by the errors of the
    calibration: (N, UNKNOWNS). See `pair_equation_kernels`.
    """
    along = (m * p).sum(1)
    square = (p * p).sum(1)
    x, y, z = p.T
    # What a lateral displacement adds to the range is not kept, if the camera measures that.
    kept = along / square if radial else np.zeros(len(p))
    by_x, by_y = m[:, 0] - x * kept, m[:, 1] - y * kept
    longer = x * by_x + y * by_y
    errors = [longer, z * by_x, z * by_y, (x * x + y * y) / z**2 * longer, along / np.sqrt(square)]
    return np.column_stack([modes * (along / z)[:, None], *errors])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Coefficients and errors (UNKNOWNS,), and how much likelier the views are with a pattern."""

    coefficients: Float64
    log_ratio: float


def _fitted(compared: Sequence[_Compared], coefficients: Float64, inflation: float) -> _Fit:
    """Fit coefficients with the robust weights at the last ones.

    Their variance maximises the likelihood (expectation maximisation). The information is divided
    by the scatter of the scores of sections of the path, by the targets of the pairs, relative to
    that by noise alone: within a section, views share the errors of the scene.
    """

    def work(a: int, b: int) -> list[tuple[Float64, Float64]]:
        return [pair.equations(coefficients, inflation) for pair in compared[a:b]]

    chunks = run_chunks(work, len(compared), -(-len(compared) // _PAIRS_A_CHUNK))
    A, g = (np.array(terms) for terms in zip(*(pair for c in chunks for pair in c), strict=True))
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
