"""Lenses whose polynomial leads from the pixel to the ray, not the other way."""

from __future__ import annotations

import numpy as np

from tofuse.geometry.cameras import BrownConrady, RayTable


def inverse_brown(lens: BrownConrady) -> RayTable:
    """Return the camera that librealsense calls "inverse Brown-Conrady": `lens` backwards."""
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    v, u = np.mgrid[: lens.height, : lens.width]
    slopes = (np.stack([u, v], axis=-1) - centre) / focal
    points = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    return RayTable(((lens.project(points) - centre) / focal).astype(np.float32))
