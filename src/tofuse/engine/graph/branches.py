"""Branches of a pose graph: vertices that only one edge connects with the others.

They do not influence the others, and at the minimum their edges have no error. Most frames are such
vertices: each is registered to a keyframe, and none to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import ROUNDING, PoseGraph

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

        e = graph.residuals()[self.edges]
        chi2 = np.einsum("mi,mij,mj->m", e, graph.information[self.edges], e)
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
