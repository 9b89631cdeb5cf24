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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.compute import run_chunks
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.normal import robust_sigma
from tofuse.engine.refinement.camera_response import SECTIONS
from tofuse.engine.stored_views import SampledView, pair_equation_kernels, pair_equations
from tofuse.engine.views import residual_kernels

# Half periods of the cosines across and down; without the constant, the range offset of the camera.
_ACROSS, _DOWN = 5, 4
_ORDERS = np.array([(a, b) for a in range(_ACROSS) for b in range(_DOWN) if a or b])
_MODES = len(_ORDERS)
# Views are compared with the ones this many later, and at most so many pairs in all.
_LAGS, _MAX_PAIRS = (1, 2, 4, 8), 200
_PAIRS_A_CHUNK = 8
# Minimum number of points of a pair, and of views: one for each section of the path.
_MIN_POINTS, _MIN_VIEWS = 50, SECTIONS
# Prior sigma of the relative pose of a pair, m and rad.
_POSE_SIGMA = 0.02
_RESCALED = 2  # iterations for exposure and scales of the pairs
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
        (H, W) m, along the ray, with a mean of about 0; None without strong evidence for any.
    """

    z: Float32 | None

    def corrected(self, view: SampledView) -> SampledView:
        """Return a view without these errors: its points, and the planes of its target image."""
        if self.z is None:
            return view
        points, target = view.points.copy(), view.target.copy()
        points[:, :3] *= (1 + self.z.ravel()[_pixels(view)] / points[:, 2])[:, None]
        shift = (target[..., :2] * view.projection.rays).sum(-1) + target[..., 2]
        distance = target[..., residual_kernels.DISTANCE]
        distance += np.where(distance != 0, shift * self.z / np.float32(view.target_scale), 0)
        return replace(view, points=points, target=target)


def _pixels(view: SampledView) -> Intp:
    """Return the (N,) indices of the pixels of a view's points."""
    rows, columns = view.target.shape[:2]
    points = view.points.astype(np.float64)
    u, v = np.rint(view.projection.pixels(points[:, :2] / points[:, 2:3])).T
    return (v.clip(0, rows - 1) * columns + u.clip(0, columns - 1)).astype(np.intp)


def estimate(
    views: Sequence[SampledView], poses: Float64, options: pair_equations.RefineOptions
) -> FixedPattern:
    """Estimate the pattern from some pairs of views.

    Parameters
    ----------
    views, poses
        N views of one camera, in order, and their (N, 4, 4) T_world_camera.
    options
        Of the refinement.
    """
    shape = views[0].target.shape[:2] if views else (0, 0)
    if len(views) < _MIN_VIEWS or any(view.target.shape[:2] != shape for view in views):
        return FixedPattern(None)
    # By lag, so that every n-th pair has all of them.
    pairs = np.array([(k, k + lag) for lag in _LAGS for k in range(len(views) - lag)], np.intp)
    pairs = pairs[:: -(-len(pairs) // _MAX_PAIRS)]
    state = pair_equations.DirectedPairs.of(views, pairs, options)
    albedo = _albedo_equations(state, poses)
    modes = _modes(shape)
    count = len(pairs)  # one direction of each is enough
    A, g = np.zeros((count, _MODES, _MODES)), np.zeros((count, _MODES))

    def work(a: int, b: int) -> None:
        for k in range(a, b):
            t, s = state.target[k], state.source[k]
            T = se3.inverse(poses[t]) @ poses[s]
            of_pair = _pattern_equations(views[s], views[t], T, modes, albedo[0][k], albedo[1][k])
            if of_pair is not None:
                A[k], g[k] = of_pair

    run_chunks(work, count, -(-count // _PAIRS_A_CHUNK))
    coefficients = _coefficients(A, g, state.target[:count])
    if coefficients is None:
        return FixedPattern(None)
    return FixedPattern((modes @ coefficients).astype(np.float32).reshape(shape))


def _modes(shape: tuple[int, ...]) -> Float64:
    """Return the cosines (H W, MODES) of an image (H, W)."""
    v, u = np.indices(shape).reshape(2, -1)
    phase = np.pi * (np.stack([u, v], 1) + 0.5) / shape[::-1]
    return np.asarray(np.prod(np.cos(phase[:, None] * _ORDERS), axis=2), np.float64)


def _albedo_equations(
    state: pair_equations.DirectedPairs, poses: Float64
) -> tuple[Float64, Float64]:
    """Return the normal equations (P, 6, 6), (P, 6) of pairs by their albedo alone.

    In units in which those by their distances have a trace of 1.
    """
    fixed = np.zeros(pair_equation_kernels.ERRORS), np.ones(pair_equation_kernels.ERRORS, np.int64)
    last = state.options.rounds[-1]

    def equations() -> tuple[Float64, Float64]:
        state.evaluate(poses, *fixed, last)
        return state.without_exposure()

    for _ in range(_RESCALED):
        equations()
        state.rescale(last)
    H, g = equations()
    state.scale_p[:] = 0
    H_distance, g_distance = equations()
    trace = np.maximum(np.trace(H_distance, axis1=1, axis2=2), 1e-12)[:, None]
    return (H - H_distance) / trace[..., None], (g - g_distance) / trace


def _pattern_equations(
    source: SampledView,
    target: SampledView,
    T: Float64,
    modes: Float64,
    H_albedo: Float64,
    g_albedo: Float64,
) -> tuple[Float64, Float64] | None:
    """Return the normal equations of the coefficients by a pair, without its pose; None if apart.

    T is (4, 4) T_target_source. A change of the depth moves a point along its ray, and the plane
    that it is compared with along that of the target.
    """
    rows, columns = target.target.shape[:2]
    p = source.points[:, :3].astype(np.float64)
    q = se3.transform(T, p)
    u, v = np.rint(target.projection.pixels(q[:, :2] / np.maximum(q[:, 2:], 1e-3))).T
    inside = (q[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    pixel = np.where(inside, v * columns + u, 0).astype(np.intp)
    plane = target.target.reshape(-1, residual_kernels.PIXEL_SIZE)[pixel].astype(np.float64)
    n, distance = plane[:, :3], plane[:, residual_kernels.DISTANCE] * target.target_scale
    m = n @ T[:3, :3]
    normal = source.points[:, residual_kernels.NORMAL : residual_kernels.NORMAL + 3]
    used = inside & (distance != 0) & ((m * normal).sum(1) > projective.MIN_COSINE)
    if np.count_nonzero(used) < _MIN_POINTS:
        return None
    p, q, n, m = p[used], q[used], n[used], m[used]
    r = (n * q).sum(1) - distance[used]
    sigma = max(robust_sigma(r), 1e-6)
    weight = tukey.weights((r / (projective.ROBUST * sigma)) ** 2) / sigma**2
    J = np.concatenate([m, np.cross(p, m)], axis=1)
    B = modes[_pixels(source)[used]] * ((m * p).sum(1) / p[:, 2])[:, None]
    B -= modes[pixel[used]] * ((n * q).sum(1) / q[:, 2])[:, None]
    wJ, wB = weight[:, None] * J, weight[:, None] * B
    H, g, coupling = J.T @ wJ, r @ wJ, wJ.T @ B
    trace = np.trace(H)
    H += trace * H_albedo + np.eye(6) / _POSE_SIGMA**2
    eliminated = np.linalg.solve(H, np.column_stack([coupling, g + trace * g_albedo]))
    return B.T @ wB - coupling.T @ eliminated[:, :-1], r @ wB - coupling.T @ eliminated[:, -1]


def _coefficients(A: Float64, g: Float64, target: Intp) -> Float64 | None:
    """Return the coefficients (MODES,) by the equations (P, MODES, MODES), (P, MODES) of pairs.

    None without strong evidence for any.

    Their variance maximises the likelihood (expectation maximisation). The information is divided
    by the scatter of the scores of sections of the path, by the targets (P,) of the pairs, relative
    to that by noise alone: within a section, views share the errors of the scene.
    """
    total, gradient = A.sum(0), g.sum(0)
    if not total.any():  # no views overlap
        return None
    section = target * SECTIONS // (int(target.max()) + 1)
    c, variance, dispersion = np.zeros(_MODES), _FIRST_SIGMA**2, 1.0
    for _ in range(_ITERATIONS):
        covariance = np.linalg.inv(total / dispersion + np.eye(_MODES) / variance)
        c = -covariance @ gradient / dispersion
        variance = float(c @ c + np.trace(covariance)) / _MODES
        scores = np.zeros((SECTIONS, _MODES))
        np.add.at(scores, section, g + A @ c)
        scatter = float(scores.var(0, ddof=1).sum()) * SECTIONS
        dispersion = max(scatter / float(np.trace(total)), 1.0)
    # Of the pattern against none, with the variance that maximises it.
    log_ratio = -0.5 * float(
        c @ gradient / dispersion
        + np.linalg.slogdet(np.eye(_MODES) + variance * total / dispersion)[1]
    )
    return c if log_ratio > _STRONG else None
