"""Truncated least squares: each loop counts in full or is rejected, by graduated non-convexity.

1. All loops are used. If every one fits, the result is that of least squares.
2. Otherwise graduated non-convexity (Yang et al. 2020): the threshold of a Geman-McClure kernel
   starts at the largest error and is halved at every step, so that the worst loops lose their
   weight first and the others fit better. Then loops are accepted or rejected by their errors
   until nothing changes.
3. A false loop can be masked where odometry is weak and bends to fit it. So every loop is
   tested against all other edges, with the covariance that they leave. What accepting the loop
   adds to the sum of squared errors has a chi-square distribution if the loop is true::

       d = m^T W (I - C W)^-1 m

   with m the loop's error, W its information, C the covariance of the relative pose that it
   measures, all in the same tangent space. The worst loops are rejected, the rest is solved again,
   and loops that fit after all are accepted.
4. A descent from odometry that drifted far may end in a wrong minimum. So if a loop does not fit,
   all of it is repeated from chordal initialisation, and the lower objective counts.

Stated information is often too large. So the threshold grows with the errors of the better half of
the loops, up to a limit.

Chordal initialisation of a pose graph, without an initial estimate.

A descent converges to the nearest minimum: from odometry that drifted far, to a wrong one. If
rotations were arbitrary 3 x 3 matrices, the measured rotations would be linear in them, so that
their least squares have one minimum; its matrices are projected to the nearest rotations. With
these, positions are linear as well. The best of the initialisations that Carlone, Tron, Daniilidis
and Dellaert compare ("Initialization techniques for 3D SLAM", ICRA 2015), there after Martinec and
Pajdla (2007).
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph import robust
from tofuse.engine.graph.minimisation import Descent, Problem
from tofuse.engine.graph.robust import Settings
from tofuse.engine.graph.sparse import PairSystem, equations

# Smallest information along a direction, relative to the largest of the edge: its inverse exists.
_MIN_INFORMATION = 1e-12


def chordal_poses(
    poses: Float64, pairs: Intp, measurements: Float64, information: Float64, fixed: Bool
) -> Float64 | None:
    """Return (n, 4, 4) poses by linear least squares, first of rotations, then of positions.

    Parameters
    ----------
    poses
        (n, 4, 4) T_world_k, of which only the fixed ones count.
    pairs
        (m, 2) positions i, j.
    measurements, information
        (m, 4, 4) measured T_i_j and (m, 6, 6) information of ``log(Z^-1 T_i^-1 T_j)``. Rotations
        are weighted by the mean variance of an edge about its three axes, positions by their whole
        covariance.
    fixed
        (n,) mask of fixed poses, at least one of each connected part.

    Returns
    -------
    None where the edges do not determine all poses.
    """
    scale = np.trace(information, axis1=1, axis2=2)
    used = scale > 0
    pairs, measurements, information = pairs[used], measurements[used], information[used]
    system = PairSystem(len(poses), pairs, fixed, size=3)
    i, j = system.pairs.T
    Z, scale = measurements[:, :3, :3], scale[used]
    C = np.linalg.inv(information + (_MIN_INFORMATION * scale)[:, None, None] * np.eye(6))

    precision = 3 / np.trace(C[:, 3:, 3:], axis1=1, axis2=2)
    W_rotation = precision[:, None, None] * np.eye(3)
    Rt = np.where(fixed[:, None, None], np.swapaxes(poses[:, :3, :3], 1, 2), 0.0)
    # R_j^T = Z^T R_i^T, column by column.
    rotation_residual = precision[:, None, None] * (Rt[j] - np.swapaxes(Z, 1, 2) @ Rt[i])
    columns = _solved(
        system,
        (W_rotation, -precision[:, None, None] * Z, W_rotation),
        -Z @ rotation_residual,
        rotation_residual,
    )
    if columns is None:
        return None
    out = se3.pose(se3.nearest_rotation(np.swapaxes(Rt + columns, 1, 2)))
    out[fixed] = poses[fixed]
    R = out[:, :3, :3]

    # The translation of an edge's error is R_j^T (t_j - t_i - R_i z).
    Rj = R[i] @ Z
    W = Rj @ np.linalg.inv(C[:, :3, :3]) @ np.swapaxes(Rj, 1, 2)
    t = np.where(fixed[:, None], poses[:, :3, 3], 0.0)
    translation_residual = (t[j] - t[i])[..., None] - R[i] @ measurements[:, :3, 3:]
    translations = _solved(system, (W, -W, W), -W @ translation_residual, W @ translation_residual)
    if translations is None:
        return None
    out[~fixed, :3, 3] = translations[~fixed, :, 0]
    return out


def _solved(
    system: PairSystem, blocks: tuple[Float64, Float64, Float64], g_i: Float64, g_j: Float64
) -> Float64 | None:
    """Return the (n, 3, q) solutions for gradients (m, 3, q); zero for fixed poses."""
    factor = system.factor(*system.assemble(*blocks, g_i[..., 0], g_j[..., 0]))
    if factor is None:
        return None
    columns = range(g_i.shape[-1])
    solutions = [factor.solve(system.summed(g_i[..., k], g_j[..., k])) for k in columns]
    finite = [x for x in solutions if x is not None]
    return np.stack(finite, -1) if len(finite) == len(solutions) else None


_QUARTILE = 3.4546  # of a chi-square variable with six degrees of freedom
_MAX_ROUNDS = 20  # of accepting and rejecting loops
_MAX_EDGES_PER_POSE = 3.0  # edges per pose, above which no single loop can bend the others
# Fraction of the objective that rejecting loops must save, otherwise all are accepted; and that
# another start must save.
_MIN_SAVING = 0.01


def truncated_least_squares(
    problem: Problem, poses: Float64, loop: Bool, settings: Settings
) -> GraduatedNonConvexity:
    """Select among the loops (m,) and solve for the poses.

    The given poses (n, 4, 4) are the first start. If no result is better, they are kept,
    without the loops that contradict them.
    """
    result = GraduatedNonConvexity(problem, poses, loop, settings)
    if result.fits_all():
        return result.select()
    chordal = _from_chordal(problem, poses, loop, settings)
    if chordal is not None and chordal.fits_all():
        return chordal.select()
    result.select()
    if chordal is not None:
        chordal.select()
        if chordal.objective() < (1 - _MIN_SAVING) * result.objective():
            result = chordal
    initial = GraduatedNonConvexity(problem, poses, loop, settings)
    return initial.keep_start() if initial.objective() <= result.objective() else result


def _from_chordal(
    problem: Problem, poses: Float64, loop: Bool, settings: Settings
) -> GraduatedNonConvexity | None:
    """Start from chordal initialisation; the objective of the given poses is logged first."""
    start = chordal_poses(
        poses, problem.pairs, problem.measurements, problem.information, problem.fixed
    )
    if start is None:
        return None
    chordal = GraduatedNonConvexity(problem, start, loop, settings)
    chordal.descent.log[:0] = Descent(problem, problem.start(poses)).log
    return chordal


class GraduatedNonConvexity:
    """Selection of the loops that are accepted.

    After `select`, `descent` has the poses, `weights` (m,) is 1 or 0 for each edge, `limit` (m,) is
    the largest contribution of an edge's squared error to the objective, and `converged` is whether
    the last descent met its stopping rule.
    """

    def __init__(self, problem: Problem, poses: Float64, loop: Bool, settings: Settings) -> None:
        self.problem, self.loop, self.settings = problem, loop, settings
        self.descent = Descent(problem, problem.start(poses))
        self.weights = np.ones(len(loop))
        self.limit = np.full(len(loop), np.inf)
        self.converged = True

    def objective(self) -> float:
        """The sum of squared errors, those of loops truncated at the threshold of the settings."""
        x = self.descent.chi2
        squares = np.where(self.loop, np.minimum(x, self.settings.gate), x).sum()
        return float(squares) + self.problem.gravity_cost(self.descent.down)

    def keep_start(self) -> GraduatedNonConvexity:
        """Keep the poses of the start; loops that contradict them are rejected."""
        self.limit = np.where(self.loop, self.settings.gate, np.inf)
        self.weights = np.where(self.descent.chi2 > self.limit, 0.0, 1.0)
        return self

    def fits_all(self) -> bool:
        """Solve with all loops; whether each of them fits."""
        self.converged = self._solve_with(self.weights)
        x = self.descent.chi2[self.loop]
        return self.converged and bool((x <= self._gate(x)).all())

    def select(self) -> GraduatedNonConvexity:
        """Select loops and solve for the poses, after `fits_all`."""
        loop, descent = self.loop, self.descent
        all_loops, total_chi2 = descent.state(), float(descent.chi2.sum())
        if total_chi2 <= self.settings.gate:
            return self  # no single loop can exceed the gate
        gate = self._gate(descent.chi2[loop])
        if not (descent.chi2[loop] <= gate).all():
            self._graduate()
            accepted = descent.chi2[loop] <= self.settings.gate * self.settings.max_inflation**2
            gate = self._gate(descent.chi2[loop][accepted])
            self.converged = self._iterate(gate)
        if len(loop) <= _MAX_EDGES_PER_POSE * len(self.problem.fixed):
            self.converged = self._unmask(self.converged)
        if (self.weights == 1).all():
            return self
        limit = np.where(loop, gate, np.inf)
        if np.minimum(descent.chi2, limit).sum() > (1 - _MIN_SAVING) * total_chi2:
            descent.restore(all_loops)
            self.weights = np.ones(len(loop))
            self.converged = True
        else:
            self.limit = limit
        return self

    def _solve_with(self, weights: Float64) -> bool:
        settings = self.settings
        return self.descent.run(
            lambda x: weights * x, lambda x: weights, settings.tolerance, settings.max_iterations
        )

    def _gate(self, errors: Float64) -> float:
        """Threshold on squared errors, inflated by the spread of the better half of them."""
        spread = float(np.quantile(errors, 0.25)) / _QUARTILE if len(errors) else 1.0
        return self.settings.gate * float(np.clip(spread, 1.0, self.settings.max_inflation**2))

    def _graduate(self) -> None:
        loop, descent = self.loop, self.descent
        c, lowest = float(descent.chi2[loop].max()), self.settings.gate
        while c > lowest:
            c = max(c / 2, lowest)

            def total(x: Float64, c: float = c) -> Float64:
                return np.where(loop, robust.cost("geman-mcclure", x, c), x)

            def weights(x: Float64, c: float = c) -> Float64:
                return np.where(loop, robust.weight("geman-mcclure", x, c), 1.0)

            descent.run(total, weights, 1e-3, 2)

    def _iterate(self, gate: float) -> bool:
        """Accept and reject loops by their errors until nothing changes."""
        for _ in range(_MAX_ROUNDS):
            before = self.weights
            self.weights = np.where(self.loop & (self.descent.chi2 > gate), 0.0, 1.0)
            converged = self._solve_with(self.weights)
            if (self.weights == before).all():
                return converged
        return False

    def _unmask(self, converged: bool) -> bool:
        """Accept and reject loops by their errors against all other edges."""
        visited = set()
        for _ in range(_MAX_ROUNDS + int(self.loop.sum())):
            d = self._leave_one_out_errors()
            if d is None:
                return converged
            accepted = self.loop & (self.weights > 0)
            gate = self._gate(d[accepted])
            if (accepted & (d > gate)).any():
                # The worst first, as they raise the errors of others.
                worst = accepted & (d > max(gate, d[accepted].max() / 2))
                weights = np.where(worst, 0.0, self.weights)
            else:
                weights = np.where(self.loop & ~accepted & (d <= gate), 1.0, self.weights)
            key = weights.tobytes()
            if (weights == self.weights).all() or key in visited:
                return converged
            visited.add(key)
            self.weights = weights
            converged = self._solve_with(weights)
        return False

    def _leave_one_out_errors(self) -> Float64 | None:
        """(m,) squared errors of loops against all other edges; None if the system is singular."""
        problem, descent = self.problem, self.descent
        factor = problem.factor(descent.poses, self.weights)
        if factor is None:
            return None
        i, j = problem.all_pairs.T
        T_i_j = se3.inverse(descent.poses[i]) @ descent.poses[j]
        try:
            C = factor.relative_covariances(T_i_j)[: len(self.loop)][self.loop]
        except RuntimeError:
            return None
        e = descent.e[self.loop]
        W, _ = equations(e, problem.information[self.loop])
        value, vector = np.linalg.eigh(W)
        root = vector * np.sqrt(np.maximum(value, 0))[:, None]  # W = root root^T
        Rt = np.swapaxes(root, 1, 2)
        m = (Rt @ e[..., None])[..., 0]  # a twist is the same in both tangent spaces
        # C includes an accepted loop, but not a rejected one.
        sign = np.where(self.weights[self.loop] > 0, -1.0, 1.0)
        scale, axes = np.linalg.eigh(np.eye(6) + sign[:, None, None] * (Rt @ C @ root))
        along = (np.swapaxes(axes, 1, 2) @ m[..., None])[..., 0]
        d = np.zeros(len(self.loop))
        d[self.loop] = (along**2 / np.maximum(scale, 1e-9)).sum(axis=1)
        return d
