"""Joint alignment of all overlapping views (eq 2.8), and self-calibration.

Every pair of overlapping views gives the normal equations of its relative pose. The adjoint turns
them into equations in both poses, and one sparse system updates all poses. Correspondences are
then found anew, until convergence: the iteration that chapter 8 of the thesis suggests, with
planes and albedo in place of points. Errors of the camera that all views share can be unknowns of
the same system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64, Int64, Intp
from tofuse.geometry import se3
from tofuse.kernels import pair_equations as kernels
from tofuse.posegraph import robust
from tofuse.posegraph.descent import vertical
from tofuse.posegraph.graph import Gravity
from tofuse.posegraph.pair_equations import (
    DirectedPairs,
    RefineOptions,
    Round,
    depends_on_patches,
    directed_pairs,
    discount_shared,
    evaluate,
    rescale,
    without_exposure,
)
from tofuse.posegraph.pose_priors import DAMPING, UNITS, WEAK, Priors, weak_prior
from tofuse.posegraph.sparse import PairSystem
from tofuse.posegraph.view_store import SampledView, overlaps

_ERROR_UNIT = 0.01  # of the weak prior of the camera's errors
# Overlaps are computed anew after a larger motion, in units of 1 cm and 1 degree.
_MAX_MOTION = 2.0
# Gauss-Newton iterations of a single pair, and the motion in units of 1 cm and 1 degree below which
# it has converged: small, as the errors of the pairs of a loop add up.
_PAIR_ITERATIONS, _PAIR_CONVERGED = 8, 0.002


@dataclass(frozen=True, eq=False)
class Support:
    """Support of each directed pair.

    Attributes
    ----------
    target, source
        (P,) positions of the views.
    good
        (P,) sum over its residuals, each from 1 (zero) to 0 (at the robust limit or beyond), minus
        twice the number of points in free space.
    terms
        (P,) number of its residuals.
    """

    target: Intp
    source: Intp
    good: Float64
    terms: Float64

    def of_views(self, count: int) -> Float64:
        """(N,) support of each of `count` views by all overlapping ones, 1 at most."""
        total, terms = np.zeros(count), np.zeros(count)
        for ends in (self.target, self.source):
            np.add.at(total, ends, self.good)
            np.add.at(terms, ends, self.terms)
        return total / np.maximum(terms, 1)


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of a joint alignment.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera; the first has not moved.
    start
        (N, 4, 4) poses that the alignment started from.
    errors
        (ERRORS,) of the camera, in the order of `kernels.pair_equations`; 0 where not estimated.
    pairs
        (M, 2) positions of the overlapping views i < j.
    moved
        Largest motion of each iteration, in units of 1 cm and 1 degree.
    before, after
        Support at the initial and at the refined poses, with the same sigmas.
    measured, information
        (M, 4, 4) T_i_j that minimises the residuals of each pair alone, and (M, 6, 6) information
        of its right perturbation, from the noise of the views and the errors that patches share.
    scales
        (2M, 3) exposure, and factors of the sigmas of distance and albedo, of the pairs (i, j),
        then of the pairs (j, i).
    """

    poses: Float64
    start: Float64
    errors: Float64
    pairs: Intp
    moved: tuple[float, ...]
    before: Support
    after: Support
    measured: Float64
    information: Float64
    scales: Float64


@dataclass(frozen=True, eq=False)
class Bodies:
    """Rigid bodies of views, as those of a rig's cameras at one instant.

    Attributes
    ----------
    of
        (N,) number of the body of each view; 0 is that of the first.
    T_body_view
        (N, 4, 4) pose of each view in its body.
    """

    of: Intp
    T_body_view: Float64

    def poses(self, views: Float64) -> Float64:
        """(M, 4, 4) T_world_body, by the poses (N, 4, 4) of their first views."""
        _, first = np.unique(self.of, return_index=True)
        return views[first] @ se3.inverse(self.T_body_view[first])

    def views(self, bodies: Float64) -> Float64:
        """(N, 4, 4) T_world_view, by the poses (M, 4, 4) of their bodies."""
        return np.asarray(bodies[self.of] @ self.T_body_view, np.float64)

    def across(self, pairs: Intp) -> Intp:
        """Those of the pairs (M, 2) of views that belong to different bodies."""
        i, j = self.of[pairs].T
        return pairs[i != j]


def refine(
    views: Sequence[SampledView],
    poses: Float64,
    options: RefineOptions,
    *,
    calibrate: Sequence[int] = (),
    priors: Priors | None = None,
    pairs: Intp | None = None,
    bodies: Bodies | None = None,
) -> Refined:
    """Align all views jointly with the views that they overlap with.

    Parameters
    ----------
    views
        N views of one recording.
    poses
        (N, 4, 4) initial T_world_camera; the first stays.
    options
        See `RefineOptions`.
    calibrate
        Errors of the camera to estimate as well, by their number in `kernels.pair_equations`.
    priors
        Measurements by other sensors.
    pairs
        (M, 2) positions of the views i < j to compare; by default those that overlap, computed
        anew before a round if views have moved.
    bodies
        Views that move rigidly together, if any. `priors` then refers to the bodies.
    """
    if bodies is not None:
        poses = bodies.views(bodies.poses(poses))
    start = poses
    found = align_views(
        views,
        poses,
        options,
        calibrate=calibrate,
        priors=priors,
        pairs=pairs,
        bodies=bodies,
    )
    poses, errors, state, known = found.poses, found.errors, found.state, found.known
    half = len(state.target) // 2
    pairs = np.stack([state.target[:half], state.source[:half]], 1)
    last = options.rounds[-1]
    by_patch = not calibrate and depends_on_patches(state, options)
    after = _support(views, poses, errors, known, state, last, options, by_patch=by_patch)
    if by_patch:
        discount_shared(views, poses, state, options)
    measured = _pairwise_measurements(poses, pairs, state)
    before = _support(views, start, np.zeros_like(errors), known, state, last, options)
    scales = np.stack([state.exposure, state.scale_g, state.scale_p], 1)
    return Refined(poses, start, errors, pairs, found.moved, before, after, *measured, scales)


@dataclass(frozen=True, eq=False)
class AlignedViews:
    """Result of the last iteration.

    Attributes
    ----------
    poses, errors
        (N, 4, 4) T_world_camera and (ERRORS,) errors of the camera.
    state
        Residuals and scales of the pairs.
    known
        (ERRORS,) 0 for the errors that were estimated, else 1.
    moved
        Largest motion of a view in each iteration, in units of 1 cm and 1 degree.
    """

    poses: Float64
    errors: Float64
    state: DirectedPairs
    known: Int64
    moved: tuple[float, ...]


def align_views(
    views: Sequence[SampledView],
    poses: Float64,
    options: RefineOptions,
    *,
    calibrate: Sequence[int] = (),
    errors: Float64 | None = None,
    priors: Priors | None = None,
    pairs: Intp | None = None,
    bodies: Bodies | None = None,
) -> AlignedViews:
    """Do as `refine` does, without measuring the support and the pairs of the result.

    Gauss-Newton on all residuals, with correspondences found anew. The parameters are those of
    `refine`.
    """
    priors = priors or Priors.none()
    errors = np.zeros(kernels.ERRORS) if errors is None else errors
    known = np.ones(kernels.ERRORS, np.int64)
    known[list(calibrate)] = 0
    moved: list[float] = []
    near = _overlapping(views, poses, options, bodies) if pairs is None else pairs
    state = directed_pairs(views, near, options)
    system = _system(state, len(views), priors, bodies)
    since = 0.0
    for stage in options.rounds:
        if since >= _MAX_MOTION:
            near = _overlapping(views, poses, options, bodies)
            state = directed_pairs(views, near, options, state)
            system = _system(state, len(views), priors, bodies)
            since = 0.0
        for _ in range(stage.iterations if len(state.target) else 0):
            last = stage is options.rounds[-1] and not calibrate
            by_patch = last and depends_on_patches(state, options)
            evaluate(views, poses, errors, known, state, stage, options, by_patch=by_patch)
            if by_patch:
                discount_shared(views, poses, state, options)
            step, change = _solve(poses, state, system, known, priors, bodies)
            poses = _moved(poses, step, bodies)
            errors = errors + change
            rescale(state, stage)
            moved.append(float(np.abs(step / UNITS).max()))
            since += moved[-1] if pairs is None else 0.0
            if moved[-1] < options.convergence:
                break
    return AlignedViews(poses, errors, state, known, tuple(moved))


def support_of(
    views: Sequence[SampledView], poses: Float64, refined: Refined, options: RefineOptions
) -> Support:
    """Support of the same pairs at other poses (N, 4, 4), with the same sigmas."""
    state = directed_pairs(views, refined.pairs, options)
    state.exposure, state.scale_g, state.scale_p = refined.scales.T.copy()
    known = (refined.errors == 0).astype(np.int64)
    return _support(views, poses, refined.errors, known, state, options.rounds[-1], options)


def align_pairs(
    views: Sequence[SampledView],
    pairs: Intp,
    T_i_j: Float64,
    options: RefineOptions,
    errors: Float64,
) -> Float64:
    """(M, 4, 4) relative poses T_i_j of pairs, each aligned by itself.

    Parameters
    ----------
    views, options
        As for `refine`.
    pairs
        (M, 2) positions of views.
    T_i_j
        (M, 4, 4) initial guesses.
    errors
        (ERRORS,) assumed errors of the camera.
    """
    count = len(pairs)
    views = [views[int(k)] for k in pairs.ravel()]
    ends = np.arange(2 * count).reshape(-1, 2)
    poses = np.tile(np.eye(4), (2 * count, 1, 1))
    poses[1::2] = T_i_j
    state = directed_pairs(views, ends, options)
    known, stage = np.ones(len(errors), np.int64), options.rounds[-1]
    active = np.arange(count)
    for _ in range(_PAIR_ITERATIONS):
        both = np.concatenate([active, active + count])
        part = state.of(both)
        evaluate(views, poses, errors, known, part, stage, options)
        aligned, _ = _pairwise_measurements(poses, ends[active], part)
        rescale(part, stage)
        state.put(both, part)
        at = 2 * active + 1
        step = se3.log(se3.inverse(poses[at]) @ aligned) / UNITS
        poses[at] = se3.orthonormalise(aligned)
        active = active[np.abs(step).max(1) >= _PAIR_CONVERGED]
        if not len(active):
            break
    return poses[1::2]


def spread_evenly(pairs: Intp, neighbours: int) -> Intp:
    """At most `neighbours` earlier partners of each view, evenly spread, first and last included.

    `pairs` are (M, 2) positions i < j.
    """
    keep = [np.zeros(0, np.intp)]
    order = np.argsort(pairs[:, 1], kind="stable")
    _, begin = np.unique(pairs[order, 1], return_index=True)
    for rows in np.split(order, begin[1:]):
        if len(rows) > neighbours:
            rows = rows[np.unique(np.linspace(0, len(rows) - 1, neighbours).round().astype(int))]
        keep.append(rows)
    return pairs[np.concatenate(keep)]


def _overlapping(
    views: Sequence[SampledView], poses: Float64, options: RefineOptions, bodies: Bodies | None
) -> Intp:
    """Return the (M, 2) pairs of overlapping views, of different bodies if there are any."""
    pairs = overlaps(views, poses, options.overlap)[0]
    if bodies is not None:
        pairs = bodies.across(pairs)
    return spread_evenly(pairs, options.neighbours)


def _moved(poses: Float64, step: Float64, bodies: Bodies | None) -> Float64:
    """Apply a step to the views, or to their bodies; the first stays."""
    free = poses if bodies is None else bodies.poses(poses)
    out = se3.orthonormalise(free @ se3.exp(step))
    out[0] = free[0]
    return out if bodies is None else bodies.views(out)


def _support(
    views: Sequence[SampledView],
    poses: Float64,
    errors: Float64,
    known: Int64,
    state: DirectedPairs,
    stage: Round,
    options: RefineOptions,
    *,
    by_patch: bool = False,
) -> Support:
    evaluate(views, poses, errors, known, state, stage, options, by_patch=by_patch)
    good = state.rows[:, kernels.SUPPORT] - 2 * state.rows[:, kernels.IN_FRONT]
    # A copy, as a view would keep the equations of all pairs in memory.
    return Support(state.target, state.source, good, state.rows[:, kernels.TERMS].copy())


def _pairwise_measurements(
    poses: Float64, pairs: Intp, state: DirectedPairs
) -> tuple[Float64, Float64]:
    """T_i_j that each pair alone measures, and its information."""
    H, g = without_exposure(state)
    H, g = H[:, :6, :6], g[:, :6]
    half = len(pairs)
    T_i_j = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
    # A perturbation of T_i_j is the opposite one of T_j_i, in the other frame.
    A = -se3.adjoint(T_i_j)
    At = np.swapaxes(A, 1, 2)
    H = H[:half] + At @ H[half:] @ A
    g = g[:half] + (At @ g[half:, :, None])[..., 0]
    scaled = H * np.outer(UNITS, UNITS) + WEAK * np.eye(6)
    step = -np.linalg.solve(scaled, (g * UNITS)[..., None])[..., 0] * UNITS
    return T_i_j @ se3.exp(step), scaled / np.outer(UNITS, UNITS)


def _system(
    state: DirectedPairs, views: int, priors: Priors, bodies: Bodies | None = None
) -> PairSystem:
    """Return the sparse system of all views, or of their bodies."""
    ends = np.stack([state.target, state.source], 1)
    if bodies is None:
        return priors.system(views, ends)
    return priors.system(int(bodies.of.max()) + 1, bodies.of[ends])


def _solve(
    poses: Float64,
    state: DirectedPairs,
    system: PairSystem,
    known: Int64,
    priors: Priors,
    bodies: Bodies | None = None,
) -> tuple[Float64, Float64]:
    """One Gauss-Newton step: (N, 6) right perturbations of views or bodies, and of the errors."""
    H, g = without_exposure(state)
    if bodies is not None:
        # A perturbation of the body is one of its view, by the adjoint.
        A = np.tile(np.eye(H.shape[1]), (len(H), 1, 1))
        A[:, :6, :6] = se3.adjoint(se3.inverse(bodies.T_body_view[state.source]))
        At = np.swapaxes(A, 1, 2)
        H, g = At @ H @ A, (At @ g[..., None])[..., 0]
        poses = bodies.poses(poses)
    free = 6 + np.flatnonzero(known == 0)
    n, m = len(poses), len(priors.pairs)
    i, j = system.pairs.T
    T_i_j = se3.inverse(poses[i]) @ poses[j]
    more_H, more_g = priors.equations(T_i_j[len(H) :])
    prior = weak_prior(n)
    shared = _Shared(
        [system.gradient(np.concatenate([H[:, :6, k], np.zeros((m, 6))]), T_i_j) for k in free],
        H[:, free[:, None], free].sum(0),
        g[:, free].sum(0),
    )
    damping = WEAK / _ERROR_UNIT**2 + DAMPING * shared.small.diagonal()
    if priors.gravity is not None:
        damping = np.append(damping, np.zeros(2))
        _add_gravity(poses, priors.gravity, prior, shared, system)
    matrix, gradient = system.relative(
        np.concatenate([H[:, :6, :6], more_H]), np.concatenate([g[:, :6], more_g]), T_i_j, prior
    )
    factor = system.factor(matrix, gradient, DAMPING)
    assert factor is not None, "every pose has a prior, so the system is not singular"
    # Schur complement: the shared unknowns have a small dense system.
    columns, small, right = shared.columns, shared.small, shared.right
    step = _finite(factor.step())
    follow = np.zeros((len(columns), n, 6))
    for k, column in enumerate(columns):
        follow[k] = _finite(factor.solve(column))
        right[k] += column.ravel() @ step[system.free].ravel()
    for k, column in enumerate(columns):
        small[k] += follow[:, system.free].reshape(len(columns), -1) @ column.ravel()
    small[np.diag_indices(len(columns))] += damping
    change = -np.linalg.solve(small, right)
    errors = np.zeros(kernels.ERRORS)
    errors[free - 6] = change[: len(free)]
    return step + np.tensordot(change, follow, 1), errors


@dataclass(eq=False)
class _Shared:
    """Normal equations of unknowns that all poses share: columns, own block, and gradient."""

    columns: list[Float64]
    small: Float64
    right: Float64


def _add_gravity(
    poses: Float64,
    gravity: Gravity,
    single: tuple[Float64, Float64],
    shared: _Shared,
    system: PairSystem,
) -> None:
    """Add gravity's equations of single poses, and of the world's vertical, which they share."""
    at, d = gravity.vertices, gravity.directions
    R = poses[at, :3, :3]
    seen = (R @ d[..., None])[..., 0]
    down = vertical(seen, gravity)
    down /= np.linalg.norm(down)
    across = np.linalg.svd(down[None])[2][1:].T  # (3, 2) tangent directions
    e = seen - down
    known = 1 / gravity.sigma**2
    if np.isfinite(gravity.gate):
        known = known * robust.weight("geman-mcclure", (e * e).sum(1) * known, gravity.gate)
    J = -R @ se3.hat(d)
    Jt = known[:, None, None] * np.swapaxes(J, 1, 2)
    np.add.at(single[0][:, 3:, 3:], at, Jt @ J)
    np.add.at(single[1][:, 3:], at, (Jt @ e[..., None])[..., 0])
    cross = np.zeros((2, len(poses), 6))
    for k in range(2):
        np.add.at(cross[k][:, 3:], at, -Jt @ across[:, k])
    shared.columns += [column[system.free] for column in cross]
    own = len(shared.small)
    small = np.zeros((own + 2, own + 2))
    small[:own, :own] = shared.small
    small[own:, own:] = known.sum() * np.eye(2)
    shared.small = small
    shared.right = np.append(shared.right, -across.T @ (known[:, None] * e).sum(0))


def _finite(step: Float64 | None) -> Float64:
    assert step is not None, "the system is finite"
    return step
