"""Pose graph of a camera carried along the same lap repeatedly, with drifting odometry."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.graph import PoseGraph


def drifting_laps(count: int, per_lap: int, degrees: float) -> tuple[PoseGraph, Float64]:
    """Simulate the pose graph of a camera carried around a circle of 4 m diameter repeatedly.

    One step of each lap is uncertain, and has an error of 1.1 m and `degrees`, always in the same
    direction. Four loops of each lap with earlier ones are accurate: about half of them to 0.1 mm,
    the others to 3 mm.

    Parameters
    ----------
    count, per_lap
        Number of laps, and of poses of each.
    degrees
        Rotation error of each lap.

    Returns
    -------
    The graph, with poses by odometry alone, and the true poses (N, 4, 4).
    """
    rng = np.random.default_rng(0)
    twists = np.zeros((per_lap, 6))
    twists[:, 5] = 2 * np.pi * np.arange(per_lap) / per_lap
    lap = se3.exp(twists)
    lap[:, :3, 3] = 2.0 * np.stack(
        [np.cos(twists[:, 5]), np.sin(twists[:, 5]), 0 * twists[:, 5]], 1
    )
    n = count * per_lap
    truth = lap[np.arange(n) % per_lap]
    uncertain = np.arange(n - 1) % per_lap == per_lap // 3
    noise = rng.normal(size=(n - 1, 6)) * 2e-3
    noise[uncertain] = [0.6, 0, 0.9, 0, np.radians(degrees), 0]
    steps = se3.inverse(truth[:-1]) @ truth[1:] @ se3.exp(noise)
    poses = [truth[0]]
    for step in steps:
        poses.append(poses[-1] @ step)

    j = np.arange(per_lap, n, per_lap // 4)
    i = j - per_lap * np.array([rng.integers(1, min(k, 12) + 1) for k in (j // per_lap).tolist()])
    sigma = np.where(rng.random(len(j)) < 0.5, 3e-3, 1e-4)
    loops = se3.inverse(truth[i]) @ truth[j]
    loops = loops @ se3.exp(rng.normal(size=(len(j), 6)) * sigma[:, None])
    sigma = np.concatenate([np.where(uncertain, 0.3, 2e-3), sigma])
    graph = PoseGraph(
        np.arange(n),
        se3.orthonormalise(np.array(poses)),
        np.concatenate([np.stack([np.arange(n - 1), np.arange(1, n)], 1), np.stack([i, j], 1)]),
        np.concatenate([steps, loops]),
        np.eye(6) / sigma[:, None, None] ** 2,
        np.arange(len(sigma)) >= n - 1,
    )
    return graph, truth
