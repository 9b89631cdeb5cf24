"""The default optimiser: all measurements of the poses, weighted by their full information."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.connections import parts_of
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import GraphPart, Optimisation, Optimiser, PoseGraph
from tofuse.engine.graph.graph_covariances import Branches
from tofuse.engine.graph.robust import MEDIAN, Robust, Settings
from tofuse.engine.graph.solver import Solution, solve
from tofuse.engine.graph.sparse import sparsify
from tofuse.engine.parts import part

_RIGID = 1e-3  # largest deviation of a rotation from orthonormal
_MAX_POSITION_M = 1e9  # larger coordinates are corrupt
_NEGATIVE = -1e-9  # of the largest eigenvalue: information with a smaller one is not positive


@part("optimiser", "levenberg-marquardt", label="validated")
@dataclass(frozen=True)
class LevenbergMarquardt(Bounded, Optimiser):
    """Weighted least squares on SE(3), robust against false loops.

    Edges of odometry and gravity have their full weight; loop edges that of the robust kernel. The
    iteration starts from the poses in the graph, unless `start` is "best". Connected parts are
    solved separately; the first vertex of each stays where it is. If a part can't be improved, its
    poses stay.

    Attributes
    ----------
    robust
        Kernel of the loop edges. "truncated": full weight unless they contradict each other; then
        graduated non-convexity selects (Yang et al. 2020). For the others see
        `tofuse.engine.graph.robust`.
    gate
        Threshold on a loop edge's squared error, in units of its information: 100 is ten standard
        deviations.
    start
        "given": from the poses in the graph. "best": from them or from chordal initialisation
        (Carlone et al. 2015), whichever fits better; and where a kernel would reject most loops,
        the stated information is taken for too large, and the threshold scaled by the median of
        their errors at the least squares.
    """

    robust: Robust = "truncated"
    gate: Annotated[float, Bounds(0, exclusive=True)] = 100.0
    start: Literal["given", "best"] = "given"

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """See `Optimiser.optimise`.

        Raises
        ------
        InputError
            If a pose or a measurement is not finite, or information not positive semidefinite.
        """
        settings = Settings(self.robust, self.gate, best_start=self.start == "best")
        done = minimise(graph, settings)
        if not settings.best_start or not _rejects_most(done):
            return done
        fitted = minimise(graph, replace(settings, robust="none")).graph
        scale = float(np.median(fitted.squared_errors()[graph.loop])) / MEDIAN
        return minimise(graph, replace(settings, gate=self.gate * max(scale, 1.0)))


def minimise(graph: PoseGraph, settings: Settings) -> Optimisation:
    """Optimise a graph with given settings, see `LevenbergMarquardt`."""
    eigenvalues = check_graph(graph)
    poses = graph.poses.copy()
    weights = np.ones(len(graph.edges))
    parts, histories = [], []
    components = connected_components(graph)
    first = np.zeros(len(graph.ids), np.bool_)
    first[[vertices[0] for vertices, _ in components]] = True
    branches = Branches(graph, first, eigenvalues)
    moved = np.zeros(len(graph.ids), np.bool_)
    for vertices, edges in components:
        core, kept = vertices[~branches.vertices[vertices]], edges[~branches.edges[edges]]
        used = sparsify(len(core), np.searchsorted(core, graph.edges[kept]))
        solution = _solve(graph.subgraph(core, kept[used]), settings)
        history = solution.history
        of_branches = float(branches.errors[edges].sum())
        if of_branches:  # without which the solution begins
            history = (history[0] + of_branches, *history)
        before, after = history[0], history[-1]
        history = history if after < before else (before,)
        if after < before:
            moved[vertices] = True
            poses[core] = se3.orthonormalise(solution.poses)
            # Exactly as before, without rounding errors.
            poses[vertices[0]] = graph.poses[vertices[0]]
        weights[kept[used]] = solution.weights
        weights[kept[~used]] = _weights_of(graph.with_poses(poses), kept, used, weights, settings)
        histories.append(history)
        parts.append(
            GraphPart(
                int(graph.ids[vertices[0]]), len(vertices), len(edges),
                before, history[-1], solution.converged,
            )
        )  # fmt: skip
    branches.attach(poses, moved)
    return Optimisation(
        graph.with_poses(poses),
        total_history(histories),
        all(p.converged for p in parts),
        weights,
        tuple(parts),
    )


def _rejects_most(done: Optimisation) -> bool:
    """Whether most loops have less than half of their weight."""
    weights = np.ones(0) if done.weights is None else done.weights[done.graph.loop]
    return bool(2 * (weights < 0.5).sum() > len(weights))


def _solve(graph: PoseGraph, settings: Settings) -> Solution:
    """Solve a connected graph, of which the first vertex is fixed."""
    fixed = np.zeros(len(graph.ids), bool)
    fixed[0] = True
    return solve(
        graph.poses, graph.edges, graph.measurements, graph.information,
        loop=graph.loop, fixed=fixed, gravity=graph.gravity, settings=settings,
    )  # fmt: skip


def _weights_of(
    graph: PoseGraph, edges: Intp, used: Bool, weights: Float64, settings: Settings
) -> Float64:
    """Return the weights of the edges that were not used, see `sparsify`, at the solution.

    Loops that contradict the others more than those that were accepted have weight 0.
    """
    left_out = edges[~used]
    if not len(left_out):
        return np.ones(0)
    chi2 = graph.squared_errors()
    accepted = edges[used & graph.loop[edges] & (weights[edges] > 0)]
    limit = max(settings.gate, float(chi2[accepted].max(initial=0.0)))
    return np.where(graph.loop[left_out] & (chi2[left_out] > limit), 0.0, 1.0)


def connected_components(graph: PoseGraph) -> list[tuple[Intp, Intp]]:
    """Positions of the vertices and of the edges of each connected part.

    Gravity does not connect vertices, as it leaves four of six directions free.
    """
    n = len(graph.ids)
    label = parts_of(n, graph.edges)
    of_edge = label[graph.edges[:, 0]]
    count = int(label.max()) + 1 if n else 0
    return [(np.flatnonzero(label == k), np.flatnonzero(of_edge == k)) for k in range(count)]


def total_history(histories: list[tuple[float, ...]]) -> tuple[float, ...]:
    """Objective of all parts together at every step; converged parts keep their last value."""
    length = max((len(h) for h in histories), default=1)
    padded = [[*h, *[h[-1]] * (length - len(h))] for h in histories]
    return tuple(float(sum(column)) for column in zip(*padded, strict=True)) if padded else (0.0,)


def check_graph(graph: PoseGraph) -> Float64:
    """Raise InputError for invalid poses, measurements or information.

    Returns the (M, 6) eigenvalues of the information, ascending.
    """
    check_motions(graph)
    bad = np.flatnonzero(~np.isfinite(graph.information).all((1, 2)))
    if len(bad):
        raise InputError(f"information {bad[0]} is not finite", where="pose graph")
    eigenvalues = np.linalg.eigvalsh(graph.information)
    if len(eigenvalues):
        bad = np.flatnonzero(eigenvalues[:, 0] < _NEGATIVE * np.abs(eigenvalues).max(axis=1))
        if len(bad):
            i, j = graph.ids[graph.edges[bad[0]]]
            raise InputError(
                "the information matrix is not positive", where=f"pose graph, edge {i} {j}"
            )
    return np.asarray(eigenvalues, np.float64)


def check_motions(graph: PoseGraph) -> None:
    """Raise InputError for poses or measurements that are not rigid motions."""
    for name, T in (("pose", graph.poses), ("measurement", graph.measurements)):
        bad = np.flatnonzero(~np.isfinite(T).all((1, 2)))
        if len(bad):
            raise InputError(f"{name} {bad[0]} is not finite", where="pose graph")
        R = np.clip(T[:, :3, :3], -10, 10)
        deviation = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max((1, 2), initial=0)
        position = np.abs(T[:, :3, 3]).max(1, initial=0)
        bad = np.flatnonzero(
            (deviation > _RIGID) | (position > _MAX_POSITION_M) | (np.linalg.det(R) < 0)
        )
        if len(bad):
            raise InputError(f"{name} {bad[0]} is not a rigid motion", where="pose graph")
