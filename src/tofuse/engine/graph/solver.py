"""Least squares over a pose graph, on plain arrays: sparse Levenberg-Marquardt on SE(3).

The objective is the sum over all edges of ``e^T Omega e`` with ``e = log(Z^-1 T_i^-1 T_j)``, with
an optional robust kernel on loop edges (`robust`), and of the errors of gravity at single poses.
Poses are perturbed on the right. With ``E = exp(e)``::

    log(E exp(xi)) = e + J_r^-1(e) xi,    xi = d_j - Ad(T_j_i) d_i

so the Jacobians are the inverse right Jacobian of SE(3), and that times an adjoint.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.graph import robust
from tofuse.engine.graph.gnc import chordal_poses, truncated_least_squares
from tofuse.engine.graph.graph import Gravity
from tofuse.engine.graph.minimisation import Cost, Descent, Problem
from tofuse.engine.graph.robust import Settings
from tofuse.engine.graph.sparse import Factor, first_of_parts


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of the minimisation.

    Attributes
    ----------
    poses
        (n, 4, 4).
    chi2
        (m,) squared errors of the edges, weighted by their full information.
    weights
        (m,) final weight of each edge, 0 to 1.
    history
        The objective at the start and after every step. It falls at every step, unless "truncated"
        selects among the edges: then it is that of the finally accepted edges, and rejected ones
        count as an edge at the threshold.
    converged
        Whether the stopping rule was met.
    """

    poses: Float64
    chi2: Float64
    weights: Float64
    history: tuple[float, ...]
    converged: bool
    _problem: Problem = field(repr=False)

    def factor(self) -> Factor | None:
        """Factorise the normal equations at the solution, for covariances; None if singular."""
        return self._problem.factor(self.poses, self.weights)


def solve(
    poses: Float64,
    pairs: Intp,
    measurements: Float64,
    information: Float64,
    *,
    loop: Bool | None = None,
    fixed: Bool | None = None,
    gravity: Gravity | None = None,
    settings: Settings | None = None,
) -> Solution:
    """Minimise the objective over the poses, starting from `poses`.

    Parameters
    ----------
    poses
        (n, 4, 4) T_world_k.
    pairs
        (m, 2) positions i, j.
    measurements, information
        (m, 4, 4) measured T_i_j and (m, 6, 6) information of ``log(Z^-1 T_i^-1 T_j)``.
    loop
        (m,) mask of the edges with the robust kernel; none by default.
    fixed
        (n,) mask of fixed poses; by default the first of each connected part.
    gravity
        Directions of gravity measured at single poses.
    settings
        Kernel, thresholds and stopping rule.
    """
    settings = settings or Settings()
    pairs = np.asarray(pairs, np.intp).reshape(-1, 2)
    loop = np.zeros(len(pairs), bool) if loop is None else np.asarray(loop, bool)
    fixed = first_of_parts(len(poses), pairs) if fixed is None else np.asarray(fixed, bool)
    problem = Problem(pairs, measurements, information, fixed, gravity)
    if settings.robust == "truncated" and loop.any():
        selection = truncated_least_squares(problem, poses, loop, settings)
        log = selection.descent.log
        history = tuple(float(np.minimum(x, selection.limit).sum()) + extra for x, extra in log)
        return Solution(
            selection.descent.poses[: len(fixed)],
            selection.descent.chi2,
            selection.weights,
            history,
            selection.converged,
            problem,
        )

    def total(x: Float64) -> Float64:
        return np.where(loop, robust.cost(settings.robust, x, settings.gate), x)

    def weights(x: Float64) -> Float64:
        return np.where(loop, robust.weight(settings.robust, x, settings.gate), 1.0)

    descent = Descent(problem, problem.start(poses))
    if settings.best_start:
        descent = _better(
            descent, chordal_poses(poses, pairs, measurements, information, fixed), total
        )
    converged = descent.run(total, weights, settings.tolerance, settings.max_iterations)
    history = tuple(float(total(x).sum()) + extra for x, extra in descent.log)
    solved_poses, chi2 = descent.poses[: len(fixed)], descent.chi2
    return Solution(solved_poses, chi2, weights(chi2), history, converged, problem)


def _better(given: Descent, poses: Float64 | None, total: Cost) -> Descent:
    """Return a descent from other poses if their objective is lower, with the given log first."""
    if poses is None:
        return given
    other = Descent(given.problem, given.problem.start(poses))
    if not other.value(total) < given.value(total):
        return given
    other.log[:0] = given.log
    return other
