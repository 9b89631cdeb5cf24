"""Simulated surfaces seen from a path, for joint alignment."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from corner_views import SHARP, corner
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views.pair_equations import RefineOptions
from tofuse.engine.views.prepared_view import prepare_view

OPTIONS = RefineOptions()


def path(count: int) -> np.ndarray:
    """Poses on a closed path in front of the corner, the first the identity."""
    a = np.linspace(0, 2 * np.pi, count, endpoint=False)
    sine, rise = np.sin(a), 1 - np.cos(a)
    shift = [0.3 * sine, 0.2 * rise, 0.2 * np.sin(2 * a)]
    twists = np.stack([*shift, 0.15 * sine, -0.3 * sine, -0.2 * rise], axis=-1)
    return se3.exp(twists)


def surfaces(poses, noise=0.0, *, bias=0.0, **kwargs):
    """Views with noise, and a bias (H, W) fixed to the camera, or (N, 1, 1) of each view, in m."""
    rng = np.random.default_rng(3)
    of_view = bias if np.ndim(bias) == 3 else [bias] * len(poses)
    out = []
    for k, T in enumerate(poses):
        frame = replace(corner(T, **kwargs), index=k)
        depth = frame.depth + of_view[k] + noise * rng.standard_normal(frame.depth.shape)
        out.append(prepare_view(replace(frame, depth=depth.astype(np.float32)), SHARP))
    return out


def drifted(poses):
    """Poses of an odometry with the same small error in every step."""
    step = se3.exp(np.array([0.004, -0.003, 0.002, 0.003, -0.002, 0.003]))
    out = [poses[0]]
    for a, b in itertools.pairwise(poses):
        out.append(out[-1] @ se3.inverse(a) @ b @ step)
    return np.stack(out)


def away(found, truth) -> float:
    """Largest position error of the cameras, m."""
    return float(np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max())
