"""Joint alignment of all overlapping views (eq 2.8), and self-calibration.

Every pair of overlapping views gives the normal equations of its relative pose. The adjoint turns
them into equations in both poses, and one sparse system updates all poses. Correspondences are
then recomputed, until convergence: the iteration that chapter 8 of the thesis suggests, with
planes and albedo in place of points. Errors of the camera that all views share can be unknowns of
the same system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64, Int64, Intp
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.graph import external_sensors, robust, sparse
from tofuse.engine.stored_views import SampledView, overlaps, pair_equations
from tofuse.engine.stored_views import pair_equation_kernels as kernels

DAMPING = 1e-6  # fraction of the diagonal that is added to it


@dataclass(frozen=True, eq=False)
class Priors:
    """Measurements of the poses by odometry and gravity.

    Attributes
    ----------
    pairs, measured, information
        (M, 2) positions i, j of views, (M, 4, 4) T_i_j and (M, 6, 6) its information.
    gravity
        Directions of gravity, or None.
    witness
        Odometry that the result is compared with: of each run of views without a gap their
        positions (K,), and their poses (K, 4, 4) in the first one's frame.
    verified
        Whether its errors are known; see `SensorPriors`.
    """

    pairs: Intp
    measured: Float64
    information: Float64
    gravity: external_sensors.Gravity | None = None
    witness: Sequence[tuple[Intp, Float64]] = ()
    verified: bool = True

    @classmethod
    def none(cls) -> Priors:
        """Return no priors."""
        return cls(np.zeros((0, 2), np.intp), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))

    def system(self, n: int, ends: Intp) -> sparse.PairSystem:
        """Return the sparse system of n poses, pairs `ends` (m, 2) and those of the priors."""
        first = np.arange(n) == 0
        return sparse.PairSystem(n, np.concatenate([ends, self.pairs]), fixed=first)

    def equations(self, T_i_j: Float64) -> tuple[Float64, Float64]:
        """Return the normal equations (M, 6, 6), (M, 6) at relative poses (M, 4, 4)."""
        return sparse.equations(se3.log(se3.inverse(self.measured) @ T_i_j), self.information)

    def factor(
        self,
        system: sparse.PairSystem,
        H: Float64,
        g: Float64,
        T_i_j: Float64,
        unary: tuple[Float64, Float64],
    ) -> sparse.Factor:
        """Factorise a `system` of pairs with normal equations H (m, 6, 6), g (m, 6), and of these.

        Parameters
        ----------
        T_i_j
            (m + M, 4, 4) relative poses.
        unary
            Normal equations of single poses, such as `weak_prior`.
        """
        prior_H, prior_g = self.equations(T_i_j[len(H) :])
        equations = np.concatenate([H, prior_H]), np.concatenate([g, prior_g])
        factor = system.factor(*system.relative(*equations, T_i_j, unary), DAMPING)
        assert factor is not None, "every pose has a prior, so the system is not singular"
        return factor


def weak_prior(n: int) -> tuple[Float64, Float64]:
    """Return equations (n, 6, 6), (n, 6) that just keep unconstrained poses in place."""
    return np.tile(np.diag(projective.WEAK / projective.UNITS**2), (n, 1, 1)), np.zeros((n, 6))


_ERROR_UNIT = 0.01  # of the camera's errors, for their weak prior and convergence
# Overlaps are recomputed after a larger motion, in units of 1 cm and 1 degree.
_MAX_MOTION = 2.0
# Gauss-Newton iterations of a single pair, and the motion in units of 1 cm and 1 degree below which
# it has converged: small, as the errors of the pairs of a loop add up.
_PAIR_ITERATIONS, _PAIR_CONVERGED = 8, 0.002
# Largest ratio of successive steps that is extrapolated.
_MAX_RATIO = 0.9
# Maximum decrease of the support of a view that keeps its refined pose: about that by chance.
MAX_LOSS = 0.03


@dataclass(frozen=True, eq=False)
class Support:
    """Support of each directed pair.

    Attributes
    ----------
    target, source
        (P,) positions of the views.
    score
        (P,) sum over its residuals, each from 1 (zero) to 0 (at the robust limit or beyond), minus
        twice the number of points in free space.
    terms
        (P,) number of its residuals.
    """

    target: Intp
    source: Intp
    score: Float64
    terms: Float64

    def of_views(self, view_count: int) -> Float64:
        """(N,) support of each of `view_count` views by all overlapping ones, 1 at most."""
        total, terms = np.zeros(view_count), np.zeros(view_count)
        for ends in (self.target, self.source):
            np.add.at(total, ends, self.score)
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
        (ERRORS,) of the camera, in the order of `pair_equation_kernels`; 0 where not estimated.
    pairs
        (M, 2) positions of the overlapping views i < j.
    moved
        Largest motion of each iteration, in units of 1 cm and 1 degree.
    before, after
        Support at the initial and at the refined poses, with the same sigmas. Initial poses follow
        errors of the camera, and so fit better than true ones; what errors explain that patches
        share is no loss of the refined ones.
    measured, information
        (M, 4, 4) T_i_j that minimises the residuals of each pair alone, and (M, 6, 6) information
        of its right perturbation, from the noise of the views and the errors that patches share.
    scales
        Exposures and scales of the pairs in both directions.
    shared
        Variances of errors that patches share, for `support_of`, if they are modelled.
    shared_growth
        Variance of these errors at growth 1, see `shared_error`: relative to the depth, for a
        change of the viewpoint of 1 rad. 0 if they are not modelled.
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
    scales: pair_equations.KnownScales
    shared: Float64 | None = None
    shared_growth: float = 0.0


@dataclass(frozen=True, eq=False)
class RefinedViews:
    """Views with the result of their joint alignment by `refine`, and with what it was given."""

    views: Sequence[SampledView]
    refined: Refined
    options: pair_equations.RefineOptions
    priors: Priors = field(default_factory=Priors.none)
    calibrate: Sequence[int] = ()


@dataclass(frozen=True, eq=False)
class Bodies:
    """Rigid bodies of views, such as those of a rig's cameras at one instant.

    Attributes
    ----------
    body_of_view
        (N,) number of the body of each view; 0 is that of the first.
    T_body_view
        (N, 4, 4) pose of each view in its body.
    """

    body_of_view: Intp
    T_body_view: Float64

    def body_poses(self, view_poses: Float64) -> Float64:
        """(M, 4, 4) T_world_body, by the poses (N, 4, 4) of their first views."""
        _, first = np.unique(self.body_of_view, return_index=True)
        return view_poses[first] @ se3.inverse(self.T_body_view[first])

    def view_poses(self, body_poses: Float64) -> Float64:
        """(N, 4, 4) T_world_view, by the poses (M, 4, 4) of their bodies."""
        return np.asarray(body_poses[self.body_of_view] @ self.T_body_view, np.float64)

    def across(self, pairs: Intp) -> Intp:
        """Those of the pairs (M, 2) of views that belong to different bodies."""
        i, j = self.body_of_view[pairs].T
        return pairs[i != j]


def refine(
    views: Sequence[SampledView],
    poses: Float64,
    options: pair_equations.RefineOptions,
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
        Errors of the camera to estimate as well, by their number in `pair_equation_kernels`.
    priors
        Measurements by other sensors.
    pairs
        (M, 2) positions of the views i < j to compare; by default those that overlap, recomputed
        before a round if views have moved.
    bodies
        Views that move rigidly together, if any. `priors` then refers to the bodies.
    """
    if bodies is not None:
        poses = bodies.view_poses(bodies.body_poses(poses))
    start = poses
    aligned = align_views(
        views, poses, options, calibrate=calibrate, priors=priors, pairs=pairs, bodies=bodies
    )
    poses, errors, state = aligned.poses, aligned.errors, aligned.state
    fixed_errors = aligned.fixed_errors
    pairs = aligned.pairs
    by_patch, last = not calibrate and state.depends_on_patches, options.rounds[-1]
    state.evaluate(poses, errors, fixed_errors, last, by_patch=by_patch)
    shared, growth = state.shared_variance(poses) if by_patch else (None, 0.0)
    after = _support(state, shared)
    measured = _pairwise_measurements(poses, pairs, state)
    state.evaluate(start, np.zeros_like(errors), fixed_errors, last)
    found = poses, start, errors, pairs, aligned.moved, _support(state), after, *measured
    return Refined(*found, state.known_scales, shared, growth)


@dataclass(frozen=True, eq=False)
class AlignedViews:
    """Result of the last iteration.

    Attributes
    ----------
    poses, errors
        (N, 4, 4) T_world_camera and (ERRORS,) errors of the camera.
    state
        Residuals and scales of the pairs.
    fixed_errors
        (ERRORS,) mask: 0 for the errors that were estimated, else 1.
    moved
        Largest motion of a view in each iteration, in units of 1 cm and 1 degree.
    """

    poses: Float64
    errors: Float64
    state: pair_equations.DirectedPairs
    fixed_errors: Int64
    moved: tuple[float, ...]

    @property
    def pairs(self) -> Intp:
        """(M, 2) positions of the overlapping views i < j."""
        return self.state.pairs


def align_views(
    views: Sequence[SampledView],
    poses: Float64,
    options: pair_equations.RefineOptions,
    *,
    calibrate: Sequence[int] = (),
    errors: Float64 | None = None,
    usual: Float64 | None = None,
    priors: Priors | None = None,
    pairs: Intp | None = None,
    bodies: Bodies | None = None,
    scales: pair_equations.KnownScales | None = None,
) -> AlignedViews:
    """Do as `refine` does, without measuring the support and the pairs of the result.

    Gauss-Newton on all residuals, with correspondences recomputed in each iteration. The parameters
    are those of `refine`; initial errors of the camera, and the standard deviations (ERRORS,) that
    are usual; and scales of pairs to begin with.
    """
    priors = priors or Priors.none()
    errors = np.zeros(kernels.ERRORS) if errors is None else errors
    usual = np.full(kernels.ERRORS, np.inf) if usual is None else usual
    fixed_errors = np.ones(kernels.ERRORS, np.int64)
    fixed_errors[list(calibrate)] = 0
    motions: list[float] = []
    error_changes = [np.inf]

    def compared(
        poses: Float64, scales: pair_equations.KnownScales | None
    ) -> tuple[pair_equations.DirectedPairs, sparse.PairSystem]:
        of_overlap = overlapping(views, poses, options, bodies) if pairs is None else pairs
        known = None if scales is None else scales.of(of_overlap)
        state = pair_equations.DirectedPairs.of(views, of_overlap, options, known)
        return state, _system(state, priors, bodies)

    state, system = compared(poses, scales)
    motion_since_overlaps = 0.0
    earlier_error_step = np.zeros(kernels.ERRORS)
    for stage in options.rounds:
        if motion_since_overlaps >= _MAX_MOTION:
            state, system = compared(poses, state.known_scales)
            motion_since_overlaps = 0.0
        for _ in range(stage.iterations if len(state.target) else 0):
            is_last = stage is options.rounds[-1] and not calibrate
            by_patch = is_last and state.depends_on_patches
            state.evaluate(poses, errors, fixed_errors, stage, by_patch=by_patch)
            if by_patch:
                state.discount_shared(state.shared_variance(poses)[0])
            known = errors, usual
            step, error_step = _solve(poses, state, system, fixed_errors, known, priors, bodies)
            factor, earlier_error_step = _extrapolation(error_step, earlier_error_step)
            step, error_step = factor * step, factor * error_step
            poses = _apply_step(poses, step, bodies)
            errors = errors + error_step
            state.rescale(stage)
            motions.append(float(np.abs(step / projective.UNITS).max()))
            motion_since_overlaps += motions[-1] if pairs is None else 0.0
            error_changes.append(float(np.abs(error_step).max()) / _ERROR_UNIT)
            if max(motions[-1], error_changes[-1]) < options.convergence:
                break
            if calibrate and max(error_changes[-2:]) < options.error_convergence:
                break
    return AlignedViews(poses, errors, state, fixed_errors, tuple(motions))


def _extrapolation(error_step: Float64, earlier: Float64) -> tuple[float, Float64]:
    """Return the factor of a step by Aitken's extrapolation, and the step to compare the next with.

    As correspondences follow the errors of the camera, steps shrink geometrically.
    """
    ratio = float(error_step @ earlier) / max(float(earlier @ earlier), 1e-30)
    if 0 < ratio < _MAX_RATIO:
        return 1 / (1 - ratio), np.zeros_like(error_step)
    return 1.0, error_step


def support_of(
    views: Sequence[SampledView],
    poses: Float64,
    refined: Refined,
    options: pair_equations.RefineOptions,
) -> Support:
    """Support of the same pairs at other poses (N, 4, 4), with the same sigmas."""
    scales = refined.scales.of(refined.pairs)
    state = pair_equations.DirectedPairs.of(views, refined.pairs, options, scales)
    fixed_errors, by_patch = (refined.errors == 0).astype(np.int64), refined.shared is not None
    state.evaluate(poses, refined.errors, fixed_errors, options.rounds[-1], by_patch=by_patch)
    return _support(state, refined.shared)


def mean_support(aligned: AlignedViews, start: Float64) -> tuple[float, float]:
    """Mean support of the views at poses (N, 4, 4) without errors of the camera, and as aligned.

    Both with the sigmas of the aligned views.
    """
    state, last = aligned.state, aligned.state.options.rounds[-1]

    def at(poses: Float64, errors: Float64) -> float:
        state.evaluate(poses, errors, aligned.fixed_errors, last)
        return float(_support(state).of_views(len(poses)).mean())

    return at(start, np.zeros_like(aligned.errors)), at(aligned.poses, aligned.errors)


def align_pairs(
    views: Sequence[SampledView],
    pairs: Intp,
    T_i_j: Float64,
    options: pair_equations.RefineOptions,
    errors: Float64,
    scales: pair_equations.KnownScales,
) -> Float64:
    """(M, 4, 4) relative poses T_i_j of pairs, each aligned separately.

    Parameters
    ----------
    views, options, scales
        As for `align_views`.
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
    state = pair_equations.DirectedPairs.of(views, ends, options, scales.of(pairs))
    fixed_errors, stage = np.ones(len(errors), np.int64), options.rounds[-1]
    active = np.arange(count)
    for _ in range(_PAIR_ITERATIONS):
        directed = np.concatenate([active, active + count])
        subset = state.subset(directed)
        subset.evaluate(poses, errors, fixed_errors, stage)
        aligned, _ = _pairwise_measurements(poses, ends[active], subset)
        subset.rescale(stage)
        state.put(directed, subset)
        sources = 2 * active + 1
        step = se3.log(se3.inverse(poses[sources]) @ aligned) / projective.UNITS
        poses[sources] = se3.orthonormalise(aligned)
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
    keep += [evenly_spaced(rows, neighbours) for rows in np.split(order, begin[1:])]
    return pairs[np.concatenate(keep)]


def overlapping(
    views: Sequence[SampledView],
    poses: Float64,
    options: pair_equations.RefineOptions,
    bodies: Bodies | None = None,
) -> Intp:
    """Return the (M, 2) pairs of overlapping views, of different bodies if there are any."""
    pairs = overlaps(views, poses, options.overlap)[0]
    if bodies is not None:
        pairs = bodies.across(pairs)
    return spread_evenly(pairs, options.neighbours)


def _apply_step(poses: Float64, step: Float64, bodies: Bodies | None) -> Float64:
    """Apply a step to the views, or to their bodies; the first stays."""
    current = poses if bodies is None else bodies.body_poses(poses)
    updated = se3.orthonormalise(current @ se3.exp(step))
    updated[0] = current[0]
    return updated if bodies is None else bodies.view_poses(updated)


def _support(state: pair_equations.DirectedPairs, shared: Float64 | None = None) -> Support:
    """Return the support by the last evaluation, less shared errors of variances (P,)."""
    if shared is not None:
        state.discount_shared(shared)
    score = state.rows[:, kernels.SUPPORT] - 2 * state.rows[:, kernels.IN_FRONT]
    # A copy, as a view would keep the equations of all pairs in memory.
    return Support(state.target, state.source, score, state.rows[:, kernels.TERMS].copy())


def _pairwise_measurements(
    poses: Float64, pairs: Intp, state: pair_equations.DirectedPairs
) -> tuple[Float64, Float64]:
    """Measurement T_i_j of each pair alone, and its information."""
    H, g = state.without_exposure()
    count = len(pairs)
    T_i_j = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
    # A perturbation of T_i_j is the opposite one of T_j_i, in the other frame.
    A = -se3.adjoint(T_i_j)
    At = np.swapaxes(A, 1, 2)
    H = H[:count] + At @ H[count:] @ A
    g = g[:count] + (At @ g[count:, :, None])[..., 0]
    step, information = projective.step_with_weak_prior(H, g)
    return T_i_j @ se3.exp(step), information


def _system(
    state: pair_equations.DirectedPairs, priors: Priors, bodies: Bodies | None
) -> sparse.PairSystem:
    """Return the sparse system of all views, or of their bodies."""
    ends = np.stack([state.target, state.source], 1)
    if bodies is None:
        return priors.system(len(state.views), ends)
    return priors.system(int(bodies.body_of_view.max()) + 1, bodies.body_of_view[ends])


def _solve(
    poses: Float64,
    state: pair_equations.DirectedPairs,
    system: sparse.PairSystem,
    fixed_errors: Int64,
    known: tuple[Float64, Float64],
    priors: Priors,
    bodies: Bodies | None,
) -> tuple[Float64, Float64]:
    """One Gauss-Newton step: (N, 6) right perturbations of views or bodies, and of the errors.

    `known` are the current errors (ERRORS,), and the standard deviations of usual ones.
    """
    estimated = np.flatnonzero(fixed_errors == 0)
    H, g = state.without_exposure(estimated.tolist())
    if bodies is not None:
        # A perturbation of the body is one of its view, by the adjoint.
        A = np.tile(np.eye(H.shape[1]), (len(H), 1, 1))
        A[:, :6, :6] = se3.adjoint(se3.inverse(bodies.T_body_view[state.source]))
        At = np.swapaxes(A, 1, 2)
        H, g = At @ H @ A, (At @ g[..., None])[..., 0]
        poses = bodies.body_poses(poses)
    n, prior_count = len(poses), len(priors.pairs)
    i, j = system.pairs.T
    T_i_j = se3.inverse(poses[i]) @ poses[j]
    unary = weak_prior(n)
    shared = _SharedUnknowns(
        [
            system.gradient(np.concatenate([H[:, :6, k], np.zeros((prior_count, 6))]), T_i_j)
            for k in range(6, H.shape[1])
        ],
        H[:, 6:, 6:].sum(0) + np.diag(1 / known[1][estimated] ** 2),
        g[:, 6:].sum(0) + known[0][estimated] / known[1][estimated] ** 2,
    )
    damping = projective.WEAK / _ERROR_UNIT**2 + DAMPING * shared.H.diagonal()
    if priors.gravity is not None:
        damping = np.append(damping, np.zeros(2))
        _add_gravity(poses, priors.gravity, unary, shared, system)
    factor = priors.factor(system, H[:, :6, :6], g[:, :6], T_i_j, unary)
    # Schur complement: the shared unknowns have a small dense system.
    coupling, schur, reduced_gradient = shared.coupling, shared.H, shared.g
    step = _checked(factor.step())
    response = np.zeros((len(coupling), n, 6))
    for k, column in enumerate(coupling):
        response[k] = _checked(factor.solve(column))
        reduced_gradient[k] += column.ravel() @ step[system.free].ravel()
    for k, column in enumerate(coupling):
        schur[k] += response[:, system.free].reshape(len(coupling), -1) @ column.ravel()
    schur[np.diag_indices(len(coupling))] += damping
    shared_step = -np.linalg.solve(schur, reduced_gradient)
    errors = np.zeros(kernels.ERRORS)
    errors[estimated] = shared_step[: len(estimated)]
    return step + np.tensordot(shared_step, response, 1), errors


@dataclass(eq=False)
class _SharedUnknowns:
    """Normal equations of unknowns that all poses share: coupling with poses, block, gradient."""

    coupling: list[Float64]
    H: Float64
    g: Float64


def _add_gravity(
    poses: Float64,
    gravity: external_sensors.Gravity,
    unary: tuple[Float64, Float64],
    shared: _SharedUnknowns,
    system: sparse.PairSystem,
) -> None:
    """Add gravity's equations of single poses, and of the world's vertical, which they share."""
    vertices, d = gravity.vertices, gravity.directions
    R = poses[vertices, :3, :3]
    observed = (R @ d[..., None])[..., 0]
    down = gravity.vertical(observed)
    down /= np.linalg.norm(down)
    tangent = np.linalg.svd(down[None])[2][1:].T  # (3, 2) tangent directions
    e = observed - down
    weight = 1 / gravity.sigma**2
    if np.isfinite(gravity.gate):
        weight = weight * robust.weight("geman-mcclure", (e * e).sum(1) * weight, gravity.gate)
    J = -R @ se3.hat(d)
    Jt = weight[:, None, None] * np.swapaxes(J, 1, 2)
    np.add.at(unary[0][:, 3:, 3:], vertices, Jt @ J)
    np.add.at(unary[1][:, 3:], vertices, (Jt @ e[..., None])[..., 0])
    coupling = np.zeros((2, len(poses), 6))
    for k in range(2):
        np.add.at(coupling[k][:, 3:], vertices, -Jt @ tangent[:, k])
    shared.coupling += [column[system.free] for column in coupling]
    count = len(shared.H)
    H = np.zeros((count + 2, count + 2))
    H[:count, :count] = shared.H
    H[count:, count:] = weight.sum() * np.eye(2)
    shared.H = H
    shared.g = np.append(shared.g, -tangent.T @ (weight[:, None] * e).sum(0))


def _checked(step: Float64 | None) -> Float64:
    assert step is not None, "the system is finite"
    return step


def support_fell(gain: Float64) -> bool:
    """Whether gains (N,) of the views' support are significantly negative on average.

    Where all change alike, by next to nothing, they still vary by chance as single views do.
    """
    standard_error = max(float(gain.std(ddof=1)), MAX_LOSS) / np.sqrt(len(gain))
    return float(gain.mean()) < -standard_error
