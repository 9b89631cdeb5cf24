"""Pixels of images: colour sampled at the pixels of depth, values of files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Intp, UInt8
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame
from tofuse.formats.cameras import camera_file


def finite_float32(values: NDArray[Any]) -> Float32:
    """Return numbers of a file as float32, 0 where they are not finite."""
    with np.errstate(all="ignore"):
        return np.nan_to_num(values.astype(np.float32), posinf=0, neginf=0)


# A point is occluded if another one in its cell is nearer by more than this fraction.
OCCLUSION_FRACTION = 0.05


def sampled_color(
    frame: RangeFrame, image: UInt8, color: camera_file.ColorCamera | None, where: str | Path
) -> UInt8:
    """Return the colour (H, W, 3) of the depth pixels, by projecting their points into an image.

    Black where the point is outside of the colour image, or occluded there by a nearer surface that
    the depth camera observes too. Without a colour camera (None) the image has the pixels of depth.

    Raises
    ------
    InputError
        Naming `where`, if the image does not have the size of its camera.
    """
    camera_file.check_size(image, frame.camera if color is None else color.camera, where)
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
    inside[inside] = ~_occluded(u[inside] // cell, v[inside] // cell, points[inside, 2])
    sampled = np.zeros((len(u), 3), np.uint8)
    sampled[inside] = image[v[inside], u[inside]]
    out = np.zeros((*frame.depth.shape, 3), np.uint8)
    out[frame.valid] = sampled
    return out


def _cell(frame: RangeFrame, color: camera_file.ColorCamera) -> int:
    """Size in colour pixels of cells that each contain points of a continuous surface."""
    pitch = float(np.nanmedian(np.abs(np.diff(frame.camera.rays()[..., 0], axis=1))))
    return max(1, int(np.ceil(2 * pitch * color.camera.fx)))


def _occluded(u: Intp, v: Intp, z: Float64) -> Bool:
    """Whether each point is behind the nearest one of its cell."""
    if len(z) == 0:
        return np.zeros(0, bool)
    nearest = np.full((int(v.max()) + 1, int(u.max()) + 1), np.inf)
    np.minimum.at(nearest, (v, u), z)
    return np.asarray(z > nearest[v, u] * (1 + OCCLUSION_FRACTION))


def resized(image: UInt8, size: tuple[int, int], where: Path, *, same_view: bool = True) -> UInt8:
    """Return an image (H, W, 3) downscaled by area to the `size` (width, height) of depth.

    One that does not have the `same_view` as depth may have another aspect ratio.
    """
    import cv2

    height, width = image.shape[:2]
    # With another aspect ratio it has another view than depth.
    if same_view and abs(width * size[1] - height * size[0]) > 0.02 * height * size[0]:
        raise InputError(
            f"is {width} x {height} pixels, depth {size[0]} x {size[1]}: another aspect ratio",
            where=where,
            remedy="export the images again",
        )
    out: UInt8 = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return out
