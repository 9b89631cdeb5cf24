"""The pose graph of a random walk."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured, PoseGraph, build_graph

SIGMA = np.array([0.005, 0.01, 0.02, 0.002, 0.004, 0.003])  # of the edges: tx ty tz rx ry rz


def walk(
    n: int = 60, loops: int = 40, false: int = 0, seed: int = 0
) -> tuple[PoseGraph, Float64, Bool]:
    """Graph of two rounds with loops, some of them false; the true poses; mask of false edges."""
    rng = np.random.default_rng([seed, n])
    k = np.arange(n)
    angle = 4 * np.pi * k / n
    truth = np.tile(np.eye(4), (n, 1, 1))
    truth[:, :3, :3] = se3.so3_exp(np.stack([0.1 * np.sin(angle), angle, 0.05 * k / n], axis=1))
    truth[:, :3, 3] = np.stack([2 * np.cos(angle), 0.2 * np.sin(k), 2 * np.sin(angle)], axis=1)

    def measured(i: int, j: int) -> Measured:
        T = se3.inverse(truth[i]) @ truth[j] @ se3.exp(rng.normal(size=6) * SIGMA)
        return Measured(i, j, T, np.diag(SIGMA**-2))

    sequence = [measured(i, i + 1) for i in range(n - 1)]
    closed = []
    for _ in range(loops):
        i = int(rng.integers(0, n // 2 - 3))
        closed.append(measured(i, i + n // 2 + int(rng.integers(0, 3))))
    for _ in range(false):
        i, j = sorted(rng.choice(n, 2, replace=False).tolist())
        wrong = se3.exp(rng.normal(size=6) * [2, 2, 2, 1, 1, 1])
        closed.append(Measured(i, j, wrong, np.diag(SIGMA**-2)))
    poses = np.empty((n, 4, 4))
    poses[0] = truth[0]
    for edge in sequence:
        poses[edge.j] = poses[edge.i] @ edge.T_i_j
    graph = build_graph(range(n), poses, sequence, closed)
    bad = np.arange(len(graph.edges)) >= n - 1 + loops
    return graph, truth, bad
