"""Lenses as makers' software tells them."""

from __future__ import annotations

import numpy as np

from tofuse.geometry.cameras import DISTORTION_ORDER, MODELS, BrownConrady, Pinhole, RayTable
from tofuse.recordings.camera_file import checked_lens


def inverse_brown(lens: BrownConrady) -> RayTable:
    """Return the camera that librealsense calls "inverse Brown-Conrady": `lens` backwards."""
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    v, u = np.mgrid[: lens.height, : lens.width]
    slopes = (np.stack([u, v], axis=-1) - centre) / focal
    points = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    return RayTable(((lens.project(points) - centre) / focal).astype(np.float32))


def plainest_lens(
    size: tuple[int, int], values: dict[str, float], k: dict[str, float], where: str
) -> Pinhole:
    """Return a rational lens, or a Brown-Conrady or pinhole one where its numbers are all 0.

    Parameters
    ----------
    size
        Width and height in pixels.
    values, k
        Focal lengths and centre in pixels, and the coefficients of the rational model, by name.
    where
        For errors, see `checked_lens`.
    """
    brown = DISTORTION_ORDER["brown"]
    name = "pinhole"
    if any(value for key, value in k.items() if key not in brown):
        name = "rational"
    elif any(k.values()):
        name = "brown"
    kept = {key: k[key] for key in DISTORTION_ORDER[name]}
    return checked_lens(MODELS[name], size, values | kept, where)
