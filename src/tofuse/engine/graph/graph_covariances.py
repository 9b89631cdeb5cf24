"""Covariances of the poses of a graph, and consistency of its loops."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph.branches import Branches
from tofuse.engine.graph.graph import Optimisation, PoseGraph
from tofuse.engine.graph.minimisation import Problem
from tofuse.engine.graph.sparse import Factor, first_of_parts, parts_of, sparsify

# A loop with a smaller weight is rejected.
MIN_WEIGHT = 0.05


def accepted_only(optimisation: Optimisation) -> Optimisation:
    """Return the result of an optimisation without the edges that it rejected."""
    if optimisation.weights is None:
        return optimisation
    kept = optimisation.weights >= MIN_WEIGHT
    graph = optimisation.graph
    graph = graph.subgraph(np.arange(len(graph.ids)), np.flatnonzero(kept))
    return replace(optimisation, graph=graph, weights=optimisation.weights[kept])


def relative_covariance(T_i_j: Float64, C_i: Float64, C_j: Float64) -> Float64:
    """Covariance (6, 6) of the motion between two poses of a chain, as a right perturbation of j.

    Along a chain of measurements C_j = Ad(T_j_i) C_i Ad(T_j_i)^T + C_i_j, which is solved for
    C_i_j. Where the two are on different branches it may be negative in some direction; its
    negative eigenvalues are set to 0.

    Parameters
    ----------
    T_i_j
        (4, 4).
    C_i, C_j
        (6, 6) relative to the first pose, as right perturbations. NaN (unknown) gives 0.
    """
    A = se3.adjoint(se3.inverse(T_i_j))
    C = C_j - A @ C_i @ A.T
    if not np.isfinite(C).all():
        return np.zeros((6, 6))
    variances, axes = np.linalg.eigh(C)
    return np.asarray((axes * np.maximum(variances, 0)) @ axes.T, np.float64)


class GraphCovariances:
    """Covariances of the poses of an optimised graph relative to one of them.

    They are by the edges that `sparsify` chooses: without the others they are slightly larger.

    Parameters
    ----------
    graph
        The optimised graph of N poses.
    origin
        Position of the pose that is fixed.
    """

    def __init__(self, graph: PoseGraph, origin: int = 0) -> None:
        self.graph, self.origin = graph, origin
        n = len(graph.ids)
        self._part = parts_of(n, graph.edges)
        self._fixed = np.zeros(n, np.bool_)
        if n:
            other = self._part != self._part[origin]
            self._fixed = first_of_parts(n, graph.edges) & other
            self._fixed[origin] = True

    @cached_property
    def of_poses(self) -> Float64:
        """(N, 6, 6) covariances of the poses, as right perturbations.

        NaN where a pose is not connected to the fixed one, or not constrained.
        """
        out = np.full((len(self.graph.ids), 6, 6), np.nan)
        if not len(out):
            return out
        branches = Branches(self.graph, self._fixed)
        core, factor = self._factor(branches)
        if factor is None:
            return out
        try:
            out[core] = factor.covariances()[: len(core)]
        except RuntimeError:
            return out
        branches.fill_covariances(out)
        out[self._part != self._part[self.origin]] = np.nan
        return out

    def joint(self, positions: Intp) -> Float64 | None:
        """Return the (6v, 6v) joint covariance of v poses, given their positions.

        None where the measurements do not constrain all poses of the graph.
        """
        if self._part.any():
            return None
        kept = self._fixed.copy()
        kept[positions] = True
        core, factor = self._factor(Branches(self.graph, kept))
        return None if factor is None else factor.joint_covariance(np.searchsorted(core, positions))

    def _factor(self, branches: Branches) -> tuple[Intp, Factor | None]:
        """Return the vertices in no branch, and the factor of their normal equations."""
        core, edges = _core(self.graph, branches)
        graph = self.graph.subgraph(core, edges)
        problem = _problem(graph, self._fixed[core])
        return core, problem.factor(graph.poses, np.ones(len(graph.edges)))


def _core(graph: PoseGraph, branches: Branches) -> tuple[Intp, Intp]:
    """Return the vertices in no branch, and those of their edges that `sparsify` chooses."""
    core, edges = np.flatnonzero(~branches.vertices), np.flatnonzero(~branches.edges)
    return core, edges[sparsify(len(core), np.searchsorted(core, graph.edges[edges]))]


def loop_errors(graph: PoseGraph, sequential: Float64) -> Float64:
    """(L,) squared Mahalanobis distances of the loops from odometry alone.

    Chi-square with six degrees of freedom if both covariances are right; NaN for loops between
    poses that odometry does not connect, and for those that `sparsify` leaves out.

    Parameters
    ----------
    graph
        With L loops.
    sequential
        (N, 4, 4) poses of odometry alone.
    """
    n = len(graph.ids)
    odometry = graph.edges[~graph.loop]
    fixed, part = first_of_parts(n, odometry), parts_of(n, odometry)
    branches = Branches(graph, fixed)
    core, edges = _core(graph, branches)
    out = np.full(len(graph.edges), np.nan)
    loops = edges[graph.loop[edges]]
    i, j = graph.edges[loops].T
    connected = part[i] == part[j]
    reduced = graph.subgraph(core, edges)
    factor = _problem(reduced, fixed[core]).factor(
        sequential[core], np.where(reduced.loop, 0.0, 1.0)
    )
    if factor is None or not connected.any():
        return out[graph.loop]
    a, b = graph.edges[edges].T
    T_i_j = se3.inverse(sequential[a]) @ sequential[b]
    try:
        C = factor.relative_covariances(T_i_j)[reduced.loop]
    except RuntimeError:
        return out[graph.loop]
    e = se3.log(se3.inverse(graph.measurements[loops]) @ T_i_j[reduced.loop])
    C = C + np.linalg.pinv(graph.information[loops], hermitian=True)
    d = (e * np.linalg.solve(C, e[..., None])[..., 0]).sum(1)
    out[loops[connected]] = d[connected]
    return out[graph.loop]


def _problem(graph: PoseGraph, fixed: Bool) -> Problem:
    return Problem(graph.edges, graph.measurements, graph.information, fixed, graph.gravity)
