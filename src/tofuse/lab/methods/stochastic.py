"""Stochastic gradient descent over a pose graph (Olson 2008; in space as Grisetti et al. 2007)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Optimisation, Optimiser, PoseGraph, levenberg
from tofuse.engine.parts import part


@part("optimiser", "stochastic", label="validated")
@dataclass(frozen=True)
class Stochastic(Bounded, Optimiser):
    """Satisfy edges sequentially with decreasing rate, by all poses between their ends.

    A pose is the sum of the steps before it (incremental poses), so that the error of an edge is
    distributed over all steps between its ends in proportion to their compliance, and all later
    poses follow. In round t an edge over n steps is satisfied by the fraction ``n w / (t m)``, w
    its information and m the stiffness of the softest step, limited to 1; the decreasing rate
    converges to least squares. Rotations are distributed along the shortest rotation, as in TORO.
    Edges are processed by length, the longest first. The first vertex of each connected component
    is fixed. Initial progress is fast, final convergence slow: follow it by `levenberg-marquardt`.
    Gravity is not used.

    Attributes
    ----------
    rounds
        Rounds over all edges.
    """

    rounds: Annotated[int, Bounds(1)] = 100

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """See `Optimiser.optimise`; the best poses of all rounds. InputError as `lu-milios`."""
        levenberg.check_graph(graph)
        poses, histories = graph.poses.copy(), []
        for vertices, edges in levenberg.connected_components(graph):
            if len(edges):
                poses[vertices], history = self._descended(graph.subgraph(vertices, edges))
                histories.append(history)
        history = levenberg.total_history(histories)
        return Optimisation(graph.with_poses(poses), history, not len(graph.edges))

    def _descended(self, graph: PoseGraph) -> tuple[Float64, tuple[float, ...]]:
        """Return the best poses of a connected graph, and the squared error after each round."""
        best, history = graph.poses, [graph.chi2()]
        descent = _Descent(graph)
        for t in range(1, self.rounds + 1):
            poses = descent.round(1 / t)
            poses[0] = graph.poses[0]
            chi2 = graph.with_poses(poses).chi2()
            if chi2 < min(history):
                best = poses
            history.append(chi2)
        if history[-1] > min(history):
            history.append(min(history))  # return to the best
        return best, tuple(history)


class _Descent:
    def __init__(self, graph: PoseGraph) -> None:
        n = len(graph.poses)
        self.R, self.t = graph.poses[:, :3, :3].copy(), graph.poses[:, :3, 3].copy()
        ends = np.sort(graph.edges, axis=1)
        order = np.lexsort((np.arange(len(ends)), ends[:, 0] - ends[:, 1]))
        flipped = graph.edges[:, 0] > graph.edges[:, 1]
        Z = np.where(flipped[:, None, None], se3.inverse(graph.measurements), graph.measurements)
        self.edges = [(int(ends[k, 0]), int(ends[k, 1]), Z[k]) for k in order]
        w_t = np.trace(graph.information[:, :3, :3], axis1=1, axis2=2) / 3
        w_R = np.trace(graph.information[:, 3:, 3:], axis1=1, axis2=2) / 3
        self.weight = [(float(w_t[k]), float(w_R[k])) for k in order]
        # Stiffness of each step: the total weight of the edges that span it.
        self.stiffness = np.zeros((n, 2))
        for (i, j, _), w in zip(self.edges, self.weight, strict=True):
            self.stiffness[i + 1 : j + 1] += w
        softest = np.where(self.stiffness > 0, self.stiffness, np.inf).min(0)
        self.min_stiffness = np.where(np.isfinite(softest), softest, 1.0)

    def round(self, rate: float) -> Float64:
        """Satisfy each edge once; returns the poses (N, 4, 4)."""
        for (i, j, Z), (w_t, w_R) in zip(self.edges, self.weight, strict=True):
            steps = slice(i + 1, j + 1)
            compliance = 1 / np.maximum(self.stiffness[steps], self.min_stiffness)
            # The fraction of the error to correct, and its distribution.
            gain = np.minimum(1.0, rate * (j - i) * np.array([w_t, w_R]) / self.min_stiffness)
            fractions = np.cumsum(compliance, axis=0) / compliance.sum(0)
            error = se3.so3_log(self.R[i] @ Z[:3, :3] @ self.R[j].T)
            pivot = self.t[j].copy()
            last = self._rotate(steps, gain[1] * fractions[:, 1:] * error)
            self.R[j + 1 :] = last @ self.R[j + 1 :]
            self.t[j + 1 :] = (self.t[j + 1 :] - pivot) @ last.T + self.t[j]
            translation = self.R[i] @ Z[:3, 3] + self.t[i] - self.t[j]
            self.t[steps] += gain[0] * fractions[:, :1] * translation
            self.t[j + 1 :] += gain[0] * translation
        return se3.pose(se3.nearest_rotation(self.R), self.t)

    def _rotate(self, steps: slice, rotations: Float64) -> Float64:
        """Rotate poses by world vectors (k, 3), and steps with them; returns the last rotation."""
        R = se3.so3_exp(rotations)
        previous = np.concatenate([np.eye(3)[None], R[:-1]])
        steps_t = np.diff(self.t[steps.start - 1 : steps.stop], axis=0)
        rotated = (previous @ steps_t[..., None])[..., 0]
        self.t[steps] = self.t[steps.start - 1] + np.cumsum(rotated, axis=0)
        self.R[steps] = R @ self.R[steps]
        return np.asarray(R[-1])
