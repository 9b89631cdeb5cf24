"""Colour of what a depth camera sees, from a colour camera beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.arrays import Bool, Float64, Intp, UInt8
from tofuse.recordings.camera_file import ColorCamera, check_size
from tofuse.recordings.frames import RangeFrame

# A point is hidden if another one, nearer by more than this share, lands beside it.
HIDDEN_SHARE = 0.05


def sampled_color(
    frame: RangeFrame, image: UInt8, color: ColorCamera | None, where: str | Path
) -> UInt8:
    """Colour (H, W, 3) of each valid depth pixel, from where its point lands in the image.

    Black where the point is out of the colour image, or hidden there by a nearer surface that the
    depth camera sees too. Without a camera of its own (None) the image is of the depth pixels.

    Raises
    ------
    InputError
        If the image, which comes from `where`, isn't of its camera's size.
    """
    check_size(image, frame.camera if color is None else color.camera, where)
    if color is None:
        return image
    T = color.T_color_depth
    points = frame.points @ T[:3, :3].T + T[:3, 3]
    uv = color.camera.project(points)
    with np.errstate(invalid="ignore"):
        pixel = np.nan_to_num(np.rint(uv), nan=-1.0, posinf=-1.0, neginf=-1.0)
    u, v = np.clip(pixel, -1, 1 << 20).astype(np.intp).T
    inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
    cell = _cell(frame, color)
    hidden = _hidden(u[inside] // cell, v[inside] // cell, points[inside, 2])
    inside[inside] = ~hidden
    seen = np.zeros((len(u), 3), np.uint8)
    seen[inside] = image[v[inside], u[inside]]
    out = np.zeros((*frame.depth.shape, 3), np.uint8)
    out[frame.valid] = seen
    return out


def _cell(frame: RangeFrame, color: ColorCamera) -> int:
    """Width in colour pixels of cells in which a closed surface leaves no hole."""
    rays = frame.camera.rays()
    pitch = float(np.nanmedian(np.abs(np.diff(rays[..., 0], axis=1))))
    return max(1, int(np.ceil(2 * pitch * color.camera.fx)))


def _hidden(u: Intp, v: Intp, z: Float64) -> Bool:
    """Whether each point lies behind the nearest one of its cell."""
    if len(z) == 0:
        return np.zeros(0, bool)
    nearest = np.full((int(v.max()) + 1, int(u.max()) + 1), np.inf)
    np.minimum.at(nearest, (v, u), z)
    return np.asarray(z > nearest[v, u] * (1 + HIDDEN_SHARE))
