"""A round walk as a pose graph, each step and loop measured with the same noise."""

from __future__ import annotations

import numpy as np

from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph

SIGMA = np.array([0.004, 0.002, 0.003, 0.001, 0.004, 0.002])


def step_of(n: int) -> np.ndarray:
    """(4, 4) from one of n poses to the next."""
    return se3.exp(np.array([0.2, 0, 0.1, 0, 2 * np.pi / n, 0]))


def true_poses(n: int) -> np.ndarray:
    """(n, 4, 4)."""
    return np.stack([np.linalg.matrix_power(step_of(n), k) for k in range(n)])


def round_walk(n: int, rng: np.random.Generator | None, loops) -> PoseGraph:
    """The graph with loops (i, j); exact without a generator. Its poses chain the steps."""
    true = true_poses(n)

    def measured(i: int, j: int) -> Measured:
        noise = np.zeros(6) if rng is None else SIGMA * rng.standard_normal(6)
        T = se3.inverse(true[i]) @ true[j] @ se3.exp(noise)
        return Measured(i, j, T, np.diag(SIGMA**-2.0))

    steps = [measured(k, k + 1) for k in range(n - 1)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step.T_i_j)
    return build_graph(range(n), np.stack(poses), steps, [measured(i, j) for i, j in loops])
