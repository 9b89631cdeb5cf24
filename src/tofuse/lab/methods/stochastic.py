"""Stochastic gradient descent over a pose graph (Olson 2008; in space as Grisetti et al. 2007)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.parts import part
from tofuse.posegraph.castellani import free_vertices
from tofuse.posegraph.graph import Optimisation, Optimiser, PoseGraph
from tofuse.posegraph.levenberg import check_graph


@part("optimiser", "stochastic", label="validated")
@dataclass(frozen=True)
class Stochastic(Optimiser):
    """Satisfy one edge after the other, less and less, by all poses between its ends.

    A pose is the sum of the steps before it (incremental poses), so that the error of an edge is
    spread over all steps between its ends, each by its share of their compliance, and all poses
    behind it come along. In round t an edge over n steps is satisfied by the share
    ``n w / (t m)``, w its information and m the stiffness of the softest step, at most in full:
    in full at first, whatever the error, and then less and less, which leads to the least squares.
    Rotations are spread along the shortest
    turn, as in TORO. The edges come in the order of their length, the longest first. The first
    vertex of each connected part stays. It gets near quickly and to the end slowly: let
    `levenberg-marquardt` follow. Gravity and anchors are not used.

    Attributes
    ----------
    rounds
        Over all edges.
    """

    rounds: int = 100

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}, not 1 or more")

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """See `Optimiser.optimise`; the best poses on the way. InputError as `lu-milios`."""
        check_graph(graph)
        best, history = graph, [graph.chi2()]
        if not len(graph.edges) or not free_vertices(graph).any():
            return Optimisation(graph, tuple(history), True)
        descent = _Descent(graph)
        for t in range(1, self.rounds + 1):
            here = graph.with_poses(descent.round(1 / t))
            if here.chi2() < min(history):
                best = here
            history.append(here.chi2())
        if history[-1] > min(history):
            history.append(min(history))  # the step back to the best
        return Optimisation(best, tuple(history), False)


class _Descent:
    def __init__(self, graph: PoseGraph) -> None:
        n = len(graph.poses)
        self.R, self.t = graph.poses[:, :3, :3].copy(), graph.poses[:, :3, 3].copy()
        ends = np.sort(graph.edges, axis=1)
        order = np.lexsort((np.arange(len(ends)), ends[:, 0] - ends[:, 1]))
        turned = graph.edges[:, 0] > graph.edges[:, 1]
        Z = np.where(turned[:, None, None], se3.inverse(graph.measurements), graph.measurements)
        self.edges = [(int(ends[k, 0]), int(ends[k, 1]), Z[k]) for k in order]
        trace = np.trace(graph.information[:, :3, :3], axis1=1, axis2=2) / 3
        turn = np.trace(graph.information[:, 3:, 3:], axis1=1, axis2=2) / 3
        self.weight = [(float(trace[k]), float(turn[k])) for k in order]
        # Stiffness of each step: of the edges that bend it, all together.
        self.stiff = np.zeros((n, 2))
        for (i, j, _), w in zip(self.edges, self.weight, strict=True):
            self.stiff[i + 1 : j + 1] += w
        used = self.stiff > 0
        self.softest = np.array([self.stiff[used[:, k], k].min() for k in range(2)])

    def round(self, rate: float) -> Float64:
        """Satisfy each edge once; returns the poses (N, 4, 4)."""
        for (i, j, Z), (move, turn) in zip(self.edges, self.weight, strict=True):
            steps = slice(i + 1, j + 1)
            soft = 1 / self.stiff[steps]
            # The share of the error that is the edge's to ask for, and how it is spread.
            gain = np.minimum(1.0, rate * (j - i) * np.array([move, turn]) / self.softest)
            along = np.cumsum(soft, axis=0) / soft.sum(0)
            error = se3.so3_log(self.R[i] @ Z[:3, :3] @ self.R[j].T)
            pivot = self.t[j].copy()
            last = self._turn(steps, gain[1] * along[:, 1:] * error)
            self.R[j + 1 :] = last @ self.R[j + 1 :]
            self.t[j + 1 :] = (self.t[j + 1 :] - pivot) @ last.T + self.t[j]
            shift = self.R[i] @ Z[:3, 3] + self.t[i] - self.t[j]
            self.t[steps] += gain[0] * along[:, :1] * shift
            self.t[j + 1 :] += gain[0] * shift
        poses = np.tile(np.eye(4), (len(self.t), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.R, self.t
        return np.asarray(se3.orthonormalise(poses))

    def _turn(self, steps: slice, turns: Float64) -> Float64:
        """Turn poses by vectors (k, 3) of the world, and steps with them; returns the last turn."""
        R = se3.so3_exp(turns)
        before = np.concatenate([np.eye(3)[None], R[:-1]])
        steps_t = np.diff(self.t[steps.start - 1 : steps.stop], axis=0)
        moved = (before @ steps_t[..., None])[..., 0]
        self.t[steps] = self.t[steps.start - 1] + np.cumsum(moved, axis=0)
        self.R[steps] = R @ self.R[steps]
        return np.asarray(R[-1])
