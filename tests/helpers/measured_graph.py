"""Graphs of measured pairs with known errors, without images."""

from __future__ import annotations

import numpy as np

from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Measured, build_graph

SIGMA = np.array([0.003] * 3 + [0.001] * 3)
DEPTH_M = 2.0
RIGID = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, 2.0, -0.4]))


def measured(poses, *, seed=0, noise=1.0, reach=4, stated=SIGMA):
    """A graph of pairs up to `reach` apart, with `noise` times the errors that they state."""
    rng = np.random.default_rng(seed)
    edges = []
    for i in range(len(poses)):
        for j in range(i + 1, min(i + reach + 1, len(poses))):
            error = se3.exp(noise * SIGMA * rng.standard_normal(6))
            T_i_j = se3.inverse(poses[i]) @ poses[j] @ error
            edges.append(Measured(i, j, T_i_j, np.diag(stated**-2.0)))
    return build_graph(range(len(poses)), poses, edges)


def jumped(poses, motion):
    out = poses.copy()
    half = len(out) // 2
    out[half:] = out[half] @ se3.exp(motion) @ se3.inverse(out[half]) @ out[half:]
    return out
