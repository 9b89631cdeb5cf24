"""Organised clouds: points in rows and columns that lie on the rays of a camera's pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.geometry.cameras import Camera, RayTable
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.sources import FARTHEST_M

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

SAMPLES = 8
# How far a point may lie from its pixel's ray: what rounding to 0.1 mm and float32 can do.
TOLERANCE_M = 5e-4
TOLERANCE_SHARE = 1e-4
# A lens this near to a pinhole is one: 0.01 px is 0.2 mm at 10 m.
PINHOLE_PIXELS = 0.01
STEEPEST = 100.0  # slope of a ray: 89.4 degrees off the axis


def common_camera(images: Sequence[Float32]) -> Camera | None:
    """Return the camera on whose pixels' rays the points (H, W, 3) of all images lie, or None."""
    if not images or len({image.shape for image in images}) > 1:
        return None
    rays = _common_rays(images)
    if rays is None:
        return None
    try:
        table = RayTable(rays)
        fit = table.fit
    except (InputError, np.linalg.LinAlgError):
        return None
    if min(fit.fx, fit.fy) < 0.1:
        return table
    known = np.asarray(np.isfinite(rays).all(-1))
    error = np.abs((fit.rays() - rays)[known]) * (fit.fx, fit.fy)
    return fit if error.max() < PINHOLE_PIXELS else table


def organised_frame(
    points: Float32,
    camera: Camera,
    index: int,
    timestamp: float,
    where: str | Path,
    *,
    amplitude: Float32 | None = None,
    color: UInt8 | None = None,
    normals: Float32 | None = None,
) -> RangeFrame:
    """Return points (H, W, 3) and what is known of each as an image of `camera`.

    Raises
    ------
    InputError
        If they aren't one.
    """
    shape = (camera.height, camera.width)
    if points.shape[:2] != shape:
        raise InputError(
            f"is organised as {points.shape[1]} x {points.shape[0]}, those before it "
            f"{camera.width} x {camera.height}",
            where=where,
            remedy="keep the clouds of each camera apart",
        )
    z = points[..., 2]
    measured = _measured(points)
    rays = camera.rays()
    known = np.asarray(np.isfinite(rays).all(-1))
    if not _fits(points, measured & known, rays):
        raise InputError(
            "has points off the rays of those before it",
            where=where,
            remedy="keep the clouds of each camera apart",
        )
    if (measured & ~known).any():
        # A pixel that saw nothing in the clouds looked at first brings its own ray.
        own = points[..., :2] / np.where(measured, z, np.nan)[..., None]
        camera = RayTable(np.where(known[..., None], rays, own))
    return RangeFrame(
        index,
        timestamp,
        camera,
        np.where(measured, z, np.float32(0)),
        "z",
        amplitude_image=None if amplitude is None else np.nan_to_num(amplitude).reshape(shape),
        color_image=None if color is None else color.reshape(*shape, 3),
        normal_image=None if normals is None else normals.reshape(*shape, 3),
    )


def _common_rays(images: Sequence[Float32]) -> Float32 | None:
    """Rays (H, W, 2) by least squares over the images, NaN where never seen; None if unfit."""
    above = np.zeros((*images[0].shape[:2], 2))
    below = np.zeros(images[0].shape[:2])
    masks = []
    for image in images:
        if (image[..., 2] < 0).any():
            return None
        measured = _measured(image)
        z = np.where(measured, image[..., 2], 0).astype(float)
        masks.append(measured)
        above += np.where(measured[..., None], image[..., :2], 0) * z[..., None]
        below += z**2
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = above / np.where(below > 0, below, np.nan)[..., None]
    if (np.abs(slopes) > STEEPEST).any():
        return None
    rays = slopes.astype(np.float32)
    fits = all(_fits(image, mask, rays) for image, mask in zip(images, masks, strict=True))
    return rays if fits else None


def _fits(points: Float32, mask: NDArray[np.bool_], rays: Float32) -> bool:
    z = points[mask][:, 2:]
    off = np.abs(points[mask][:, :2] - rays[mask] * z)
    return bool((off <= TOLERANCE_M + TOLERANCE_SHARE * z).all())


def _measured(points: Float32) -> NDArray[np.bool_]:
    """Mask of points; some programs write the origin, not NaN, where nothing came back."""
    return np.asarray((np.abs(points) < FARTHEST_M).all(-1) & (points[..., 2] > 0))
