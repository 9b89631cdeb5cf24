"""Covariances of the poses of a graph, and consistency of its loops."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from tofuse.arrays import Bool, Float64, Intp
from tofuse.geometry import se3
from tofuse.posegraph.descent import Problem
from tofuse.posegraph.graph import Optimisation, PoseGraph
from tofuse.posegraph.sparse import Factor, bounded, first_of_parts, parts_of

# A loop with a smaller weight is rejected.
MIN_WEIGHT = 0.05


def accepted_only(optimisation: Optimisation) -> Optimisation:
    """Return the result of an optimisation without the edges that it rejected."""
    if optimisation.weights is None:
        return optimisation
    kept = optimisation.weights >= MIN_WEIGHT
    graph = _only(optimisation.graph, kept)
    return replace(optimisation, graph=graph, weights=optimisation.weights[kept])


def _only(graph: PoseGraph, chosen: Bool) -> PoseGraph:
    """Return the graph with only some of its edges (m,)."""
    return replace(
        graph,
        edges=graph.edges[chosen],
        measurements=graph.measurements[chosen],
        information=graph.information[chosen],
        loop=graph.loop[chosen],
    )


def _bounded(graph: PoseGraph) -> PoseGraph:
    chosen = bounded(len(graph.ids), graph.edges)
    return graph if chosen.all() else _only(graph, chosen)


def pose_covariances(graph: PoseGraph, origin: int = 0) -> Float64:
    """(N, 6, 6) covariances of the poses relative to one of them, as right perturbations.

    NaN where a pose is not connected to it, or not constrained.

    Parameters
    ----------
    graph
        The optimised graph of N poses.
    origin
        Position of the pose that is fixed.
    """
    if not len(graph.ids):
        return np.empty((0, 6, 6))
    graph = _bounded(graph)
    part = parts_of(len(graph.ids), graph.edges)
    fixed = first_of_parts(len(graph.ids), graph.edges) & (part != part[origin])
    fixed[origin] = True
    factor = _problem(graph, fixed).factor(graph.poses, np.ones(len(graph.edges)))
    return _connected(graph, origin, factor)


def _connected(graph: PoseGraph, origin: int, factor: Factor | None) -> Float64:
    """Return the (N, 6, 6) covariances by a factor; NaN where not connected to the origin."""
    out = np.full((len(graph.ids), 6, 6), np.nan)
    if factor is None or not len(out):
        return out
    part = parts_of(len(out), graph.edges)
    joined = part == part[origin]
    try:
        out[joined] = factor.covariances()[: len(out)][joined]
    except RuntimeError:
        return out
    return out


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
    """Covariances of the poses of an optimised graph relative to its first pose.

    Those of poses and joint ones come from the same factor. They are by the edges that `bounded`
    chooses: without the others they are slightly larger.
    """

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = _bounded(graph)

    @cached_property
    def _factor(self) -> Factor | None:
        graph = self.graph
        problem = _problem(graph, first_of_parts(len(graph.ids), graph.edges))
        return problem.factor(graph.poses, np.ones(len(graph.edges)))

    @cached_property
    def of_poses(self) -> Float64:
        """(N, 6, 6) as right perturbations, see `pose_covariances`."""
        return _connected(self.graph, 0, self._factor)

    def joint(self, some: Intp) -> Float64 | None:
        """Return the (6v, 6v) joint covariance of v poses, given their positions.

        None where the measurements do not constrain all poses of the graph.
        """
        n, edges = len(self.graph.ids), self.graph.edges
        if self._factor is None or first_of_parts(n, edges).sum() > 1:
            return None
        return self._factor.joint_covariance(some)


def loop_errors(graph: PoseGraph, sequential: Float64) -> Float64:
    """(L,) squared Mahalanobis distances of the loops from odometry alone.

    Chi-square with six degrees of freedom if both covariances are right; NaN for loops between
    poses that odometry does not connect, and for those that `bounded` leaves out.

    Parameters
    ----------
    graph
        With L loops.
    sequential
        (N, 4, 4) poses of odometry alone.
    """
    chosen = bounded(len(graph.ids), graph.edges)
    out = np.full(int(graph.loop.sum()), np.nan)
    out[chosen[graph.loop]] = _loop_errors(_only(graph, chosen), sequential)
    return out


def _loop_errors(graph: PoseGraph, sequential: Float64) -> Float64:
    loops = np.flatnonzero(graph.loop)
    out = np.full(len(loops), np.nan)
    odometry = graph.edges[~graph.loop]
    problem = _problem(graph, first_of_parts(len(graph.ids), odometry))
    factor = problem.factor(sequential, np.where(graph.loop, 0.0, 1.0))
    part = parts_of(len(graph.ids), odometry)
    i, j = graph.edges[loops].T
    same = part[i] == part[j]
    if factor is None or not same.any():
        return out
    a, b = graph.edges.T
    T_i_j = se3.inverse(sequential[a]) @ sequential[b]
    try:
        C = factor.relative_covariances(T_i_j)[loops]
    except RuntimeError:
        return out
    e = se3.log(se3.inverse(graph.measurements[loops]) @ T_i_j[loops])
    C = C + np.linalg.pinv(graph.information[loops], hermitian=True)
    d = (e * np.linalg.solve(C, e[..., None])[..., 0]).sum(1)
    out[same] = d[same]
    return out


def _problem(graph: PoseGraph, fixed: Bool) -> Problem:
    return Problem(
        graph.edges, graph.measurements, graph.information, fixed, graph.gravity, "tangent"
    )
