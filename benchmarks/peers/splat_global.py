"""splatreg's classical seed for scans of rooms (`robust_feature_align`): Open3D's, and its own ICP.

The seed needs Open3D and PyTorch beside splatreg.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.frames.frames import Frame


def method(voxel_m: float) -> Callable[[Frame, Frame], Float64] | None:
    """The registration of two views; None where a package is not installed."""
    try:
        torch = importlib.import_module("torch")
        splatreg = importlib.import_module("splatreg")
        features = importlib.import_module("splatreg.align_features")
        importlib.import_module("open3d")
    except ImportError:
        return None

    def splats(frame: Frame) -> object:
        means = torch.from_numpy(np.array(frame.points, np.float32))
        count = len(means)
        rotations = torch.zeros(count, 4)
        rotations[:, 0] = 1
        return splatreg.Gaussians(
            means, rotations, torch.full((count, 3), voxel_m), torch.ones(count)
        )

    def registered(source: Frame, target: Frame) -> Float64:
        found, _ = features.robust_feature_align(
            splats(target), splats(source), transform="se3", voxel=voxel_m
        )
        return np.asarray(found.cpu().numpy(), float)

    return registered
