"""Conversions between radial range, z depth and points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float32
from tofuse.engine.cameras.cameras import Camera, ray_lengths


def z_from_range(camera: Camera, radial_range: ArrayLike) -> Float32:
    """Convert radial range (H, W) to z depth (H, W), in m (eq 2.3); 0 stays 0."""
    return _nan_to_zero(np.asarray(radial_range, np.float32) / ray_lengths(camera))


def range_from_z(camera: Camera, z: ArrayLike) -> Float32:
    """Convert z depth (H, W) to radial range (H, W), in m; 0 stays 0."""
    return _nan_to_zero(np.asarray(z, np.float32) * ray_lengths(camera))


def points_from_z(camera: Camera, z: ArrayLike) -> Float32:
    """Convert z depth (H, W) to points (H, W, 3), in m (eqs 2.4, 2.5); the origin where invalid."""
    z = np.asarray(z, np.float32)
    out = np.empty((*z.shape, 3), np.float32)
    out[..., :2] = camera.rays() * z[..., None]
    out[..., 2] = z
    return _nan_to_zero(out)


def _nan_to_zero(a: Float32) -> Float32:
    return np.where(np.isfinite(a), a, np.float32(0))
