"""Scans of a simulated flat, as of a laser scanner on a tripod."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.lab.world import scene as scenes


def scanned(
    at: Sequence[float],
    heading: float,
    seed: int,
    *,
    noise: float = 0.003,
    rows: int = 100,
    name: str = "flat",
) -> tuple[Float64, Float64]:
    """A scan with equal angles, z up, at a place of the scene: its pose and points."""
    built, _ = scenes.build(name, seed=0)
    up, around = np.meshgrid(
        np.linspace(-1.2, 1.5, rows), np.linspace(-np.pi, np.pi, 2 * rows, False), indexing="ij"
    )
    rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], -1)
    rays = rays.reshape(-1, 3)
    T = se3.exp([0, 0, 0, 0, 0, heading])
    T[:3, 3] = at
    distance = built.cast(T[:3, 3], rays @ T[:3, :3].T).distance.astype(float)
    seen = np.isfinite(distance)
    distance += np.random.default_rng(seed).normal(0, noise, len(distance))
    return T, rays[seen] * distance[seen, None]
