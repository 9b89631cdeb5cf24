"""Least squares over a pose graph, on plain arrays: sparse Levenberg-Marquardt on SE(3).

The objective is the sum over all edges of ``e^T Omega e`` with ``e = log(Z^-1 T_i^-1 T_j)``, in
which edges that close loops may be judged by a robust kernel (`tofuse.posegraph.robust`), and of
what gravity says of single poses. Poses are perturbed on the right. With ``E = exp(e)``::

    log(E exp(xi)) = e + J_r^-1(e) xi,    xi = d_j - Ad(T_j_i) d_i

so the Jacobians are the inverse right Jacobian of SE(3), and that times an adjoint.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tofuse.arrays import Bool, Float64, Intp
from tofuse.posegraph import robust
from tofuse.posegraph.descent import Descent, Problem
from tofuse.posegraph.graph import Gravity
from tofuse.posegraph.robust import Settings
from tofuse.posegraph.sparse import Factor, first_of_parts
from tofuse.posegraph.truncated import Truncated


@dataclass(frozen=True, eq=False)
class Solution:
    """What came out.

    Attributes
    ----------
    poses
        (n, 4, 4).
    chi2
        (m,) squared errors of the edges, weighted by their full information.
    weights
        (m,) share of its information with which each edge counted in the end.
    history
        The objective at the start and after every step. It falls at every step, unless
        "truncated" had to choose among the edges: it is that of the edges chosen in the end, those
        that it left out counting as much as an edge at the threshold.
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
    """Find the poses that fit the measured relative poses best, starting from those given.

    Parameters
    ----------
    poses
        (n, 4, 4) T_world_k.
    pairs
        (m, 2) positions i, j.
    measurements, information
        (m, 4, 4) measured T_i_j and (m, 6, 6) information of ``log(Z^-1 T_i^-1 T_j)``.
    loop
        (m,) mask of the edges that the robust kernel judges; none unless given.
    fixed
        (n,) mask of poses that don't move; the first of each connected part unless given.
    gravity
        Directions measured by single cameras.
    settings
        Kernel, thresholds and stopping rule.
    """
    settings = settings or Settings()
    pairs = np.asarray(pairs, np.intp).reshape(-1, 2)
    loop = np.zeros(len(pairs), bool) if loop is None else np.asarray(loop, bool)
    fixed = first_of_parts(len(poses), pairs) if fixed is None else np.asarray(fixed, bool)
    problem = Problem(pairs, measurements, information, fixed, gravity, settings.rotation)
    if settings.robust == "truncated" and loop.any():
        found = Truncated(problem, poses, loop, settings)
        converged = found.run()
        log = found.descent.log
        history = tuple(float(np.minimum(x, found.limit).sum()) + extra for x, extra in log)
        return _solution(problem, found.descent, found.weights, history, converged)
    kernel = settings.robust if settings.robust != "truncated" else "none"

    def total(x: Float64) -> Float64:
        return np.where(loop, robust.cost(kernel, x, settings.gate), x)

    def weights(x: Float64) -> Float64:
        return np.where(loop, robust.weight(kernel, x, settings.gate), 1.0)

    descent = Descent(problem, problem.start(poses))
    converged = descent.run(total, weights, settings.tolerance, settings.max_iterations)
    history = tuple(float(total(x).sum()) + extra for x, extra in descent.log)
    return _solution(problem, descent, weights(descent.chi2), history, converged)


def _solution(
    problem: Problem,
    descent: Descent,
    weights: Float64,
    history: tuple[float, ...],
    converged: bool,
) -> Solution:
    poses = descent.poses[: len(problem.fixed)]
    return Solution(poses, descent.chi2, weights, history, converged, problem)
