"""Explicit loop closing heuristics (Sprickerhof et al. 2009): loop errors are distributed.

The error of a loop is distributed over its poses in proportion to their distance in the graph,
where the length of an edge is its uncertainty. Fast, as nothing is minimised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse as scipy_sparse
from scipy.sparse.csgraph import dijkstra

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.connections import parts_of
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Optimisation, Optimiser, PoseGraph, levenberg
from tofuse.engine.parts import part

_MIN_RELATIVE_LENGTH = 1e-12  # min edge length relative to the largest


@part("optimiser", "elch", label="validated")
@dataclass(frozen=True)
class Elch(Optimiser):
    """Close loops sequentially, in temporal order.

    Positions are interpolated linearly and orientations by slerp, with separate distances: the
    traces of the edges' covariances of translation and of rotation. A pose off the loop moves with
    the pose of the loop to which it is connected. A closed loop is an edge of the graph for later
    ones. The first vertex of each connected component is fixed. Gravity is not used.
    """

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """See `Optimiser.optimise`; logs the sum of weighted squared errors.

        It need not decrease. Raises InputError for non-finite or non-positive input.
        """
        levenberg.check_graph(graph)
        lengths = _lengths(graph)
        poses = graph.poses.copy()
        included = ~graph.loop
        history = [graph.chi2()]
        order = np.flatnonzero(graph.loop)
        order = order[np.argsort(graph.edges[order].max(axis=1), kind="stable")]
        for loop in map(int, order):
            fractions = [_fractions(graph, length, included, loop) for length in lengths]
            if fractions[0] is not None and fractions[1] is not None:
                poses = _distribute(poses, graph, loop, fractions[0], fractions[1])
                history.append(graph.with_poses(poses).chi2())
            included[loop] = True
        component = parts_of(len(poses), graph.edges)
        for k in range(int(component.max(initial=-1)) + 1):
            members = np.flatnonzero(component == k)
            first = graph.poses[members[0]]
            if np.array_equal(poses[members], graph.poses[members]):
                continue  # not even by rounding
            poses[members] = se3.orthonormalise(
                first @ se3.inverse(poses[members[0]]) @ poses[members]
            )
            poses[members[0]] = first
        return Optimisation(graph.with_poses(poses), tuple(history), True)


def _lengths(graph: PoseGraph) -> tuple[Float64, Float64]:
    """Traces of the covariances of translation (m^2) and of rotation (rad^2), (M,) each."""
    C = np.linalg.pinv(graph.information, hermitian=True)
    diagonal = np.diagonal(C, axis1=1, axis2=2)
    lengths = []
    for block in (diagonal[:, :3], diagonal[:, 3:]):
        length = block.sum(axis=1)
        lengths.append(np.maximum(length, _MIN_RELATIVE_LENGTH * length.max(initial=1e-300)))
    return lengths[0], lengths[1]


def _fractions(graph: PoseGraph, length: Float64, included: Bool, loop: int) -> Float64 | None:
    """(N,) fraction of the loop's error for each pose, 0 to 1; None if it closes no loop."""
    n = len(graph.ids)
    start, end = graph.edges[loop]
    i, j = graph.edges[included].T
    # Keep the shortest of parallel edges, which the sparse matrix would add up.
    order = np.lexsort((length[included], np.maximum(i, j), np.minimum(i, j)))
    low, high, value = np.minimum(i, j)[order], np.maximum(i, j)[order], length[included][order]
    first = np.ones(len(order), bool)
    first[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    adjacency = scipy_sparse.csr_matrix((value[first], (low[first], high[first])), shape=(n, n))
    distance, predecessors = dijkstra(
        adjacency, directed=False, indices=start, return_predecessors=True
    )
    if not np.isfinite(distance[end]):
        return None
    path = [int(end)]
    while path[-1] != start:
        path.append(int(predecessors[path[-1]]))
    on_path = np.array(path)
    _, _, nearest = dijkstra(
        adjacency, directed=False, indices=on_path, min_only=True, return_predecessors=True
    )
    fraction = np.zeros(n)
    reached = nearest >= 0
    fraction[reached] = (distance / distance[end])[nearest[reached]]
    fraction[on_path] = distance[on_path] / distance[end]
    return fraction


def _distribute(
    poses: Float64, graph: PoseGraph, loop: int, t_fraction: Float64, R_fraction: Float64
) -> Float64:
    """Move every pose by its fractions of the loop's correction."""
    i, j = graph.edges[loop]
    corrected = poses[i] @ graph.measurements[loop]
    translation = corrected[:3, 3] - poses[j, :3, 3]
    rotation = se3.so3_log(corrected[:3, :3] @ poses[j, :3, :3].T)
    out = poses.copy()
    out[:, :3, 3] += t_fraction[:, None] * translation
    out[:, :3, :3] = se3.so3_exp(R_fraction[:, None] * rotation) @ poses[:, :3, :3]
    return out
