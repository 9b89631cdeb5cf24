"""Covariances of the poses of a graph, and consistency of its loops.

Branches of a pose graph: vertices that only one edge connects with the others.

They do not influence the others, and at the minimum their edges have no error. Most frames are such
vertices: each is registered to a keyframe, and none to it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import ROUNDING, Optimisation, PoseGraph
from tofuse.engine.graph.minimisation import Problem
from tofuse.engine.graph.sparse import Factor, first_of_parts, sparsify

# Levels of a branch that are removed: of a chain without loops one end at a time.
_LEVELS = 8
# Minimum eigenvalue of an edge's information relative to the largest: otherwise it does not
# constrain its ends in all directions.
_CONSTRAINED = 1e-12


class TreeLevel(NamedTuple):
    """Vertices at the ends of the branches once those of the levels before are removed.

    Attributes
    ----------
    edges
        (L,) the only edge of each.
    vertices, parents
        (L,) these vertices, and those at the other ends of their edges.
    """

    edges: Intp
    vertices: Intp
    parents: Intp


class Branches:
    """The branches of a graph.

    Parameters
    ----------
    graph
        Of N vertices and M edges.
    kept
        (N,) mask of vertices that belong to no branch. Those with gravity don't either, and
        loop edges are in no branch.
    eigenvalues
        (M, 6) of the information of the edges, ascending; computed unless given.

    Attributes
    ----------
    vertices, edges
        (N,) and (M,) masks of those in branches.
    errors
        (M,) squared errors of the edges in branches, weighted by their information; 0 for others,
        and below rounding errors.
    """

    def __init__(self, graph: PoseGraph, kept: Bool, eigenvalues: Float64 | None = None) -> None:
        self._graph = graph
        kept = kept.copy()
        if graph.gravity is not None:
            kept[graph.gravity.vertices] = True
        if eigenvalues is None:
            eigenvalues = np.asarray(np.linalg.eigvalsh(graph.information), np.float64)
        rigid = ~graph.loop & (eigenvalues[:, 0] > _CONSTRAINED * eigenvalues[:, -1])
        self.vertices = np.zeros(len(graph.ids), np.bool_)
        self.edges = np.zeros(len(graph.edges), np.bool_)
        self._levels: list[TreeLevel] = []
        degree = np.bincount(graph.edges.ravel(), minlength=len(graph.ids))
        for _ in range(_LEVELS):
            is_leaf = (degree == 1) & ~kept
            leaf_edges = np.flatnonzero(rigid & ~self.edges & is_leaf[graph.edges].any(1))
            if not len(leaf_edges):
                break
            i, j = graph.edges[leaf_edges].T
            # Of two ends that only join each other, the later one is removed.
            is_leaf_j = is_leaf[j]
            level = TreeLevel(leaf_edges, np.where(is_leaf_j, j, i), np.where(is_leaf_j, i, j))
            self._levels.append(level)
            self.edges[leaf_edges], self.vertices[level.vertices] = True, True
            degree -= np.bincount(graph.edges[leaf_edges].ravel(), minlength=len(degree))

        chi2 = graph.squared_errors()[self.edges]
        self.errors = np.zeros(len(graph.edges))
        self.errors[self.edges] = np.where(chi2 > ROUNDING, chi2, 0.0)

    def fill_covariances(self, covariances: Float64) -> None:
        """Replace the covariances (N, 6, 6) of poses in branches by those that follow from others.

        Those of right perturbations: C_child = A C_parent A^T + C_edge, with the adjoint A of
        T_child_parent.
        """
        graph = self._graph
        for edges, vertices, parents in reversed(self._levels):
            A = se3.adjoint(se3.inverse(graph.poses[vertices]) @ graph.poses[parents])
            At = np.swapaxes(A, 1, 2)
            C_edge = np.linalg.inv(graph.information[edges])
            forwards = graph.edges[edges, 1] == vertices
            C_edge = np.where(forwards[:, None, None], C_edge, A @ C_edge @ At)
            covariances[vertices] = A @ covariances[parents] @ At + C_edge

    def attach(self, poses: Float64, moved: Bool) -> None:
        """Replace poses (N, 4, 4) of branches by those without error, where `moved` (N,)."""
        for level in reversed(self._levels):
            edges, vertices, parents = (part[moved[level.vertices]] for part in level)
            Z = self._graph.measurements[edges]
            forwards = self._graph.edges[edges, 1] == vertices
            T = np.where(forwards[:, None, None], Z, se3.inverse(Z))
            poses[vertices] = se3.orthonormalise(poses[parents] @ T)


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
    reduced = replace(graph.subgraph(core, edges), gravity=None)
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
