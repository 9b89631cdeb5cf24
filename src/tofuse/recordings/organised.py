"""Organised clouds: points in rows and columns that lie on the rays of a camera's pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Bool, Float32, UInt8
from tofuse.errors import InputError
from tofuse.geometry.cameras import Camera, RayTable
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.sources import FARTHEST_M

SAMPLES = 8
# How far a point may lie from its pixel's ray: what rounding to 0.1 mm and float32 can do.
TOLERANCE_M = 5e-4
TOLERANCE_SHARE = 1e-4
# A lens this near to a pinhole is one: 0.01 px is 0.2 mm at 10 m.
PINHOLE_PIXELS = 0.01
STEEPEST = 100.0  # slope of a ray: 89.4 degrees off the axis
# Along a column of pixels x/z changes little: by less than this share of the image's width.
COLUMN_SHARE = 0.05
MIN_CELLS = 256
MIN_SPREAD_M = 0.1  # of z in a pixel, to tell where its ray begins


@dataclass(frozen=True)
class Raster:
    """How points lie in rows and columns.

    Attributes
    ----------
    width, height
        Of the image.
    signs
        Of x, y and z, so that x is right, y down and z forward.
    """

    width: int
    height: int
    signs: tuple[int, int, int] = (1, 1, 1)

    @property
    def turned(self) -> str:
        """Which axes run against the pixels, in words; empty if none."""
        names = [name for name, sign in zip("xyz", self.signs, strict=True) if sign < 0]
        return f"{' and '.join(names)} run{'s'[: len(names) == 1]}" if names else ""

    def image(self, points: Float32) -> Float32:
        """Return points (N, 3) as (H, W, 3)."""
        return points.reshape(self.height, self.width, 3) * np.array(self.signs, np.float32)


def find_raster(points: Float32, width: int | None = None) -> Raster | None:
    """Return how points (N, 3), written row by row, lie in the pixels of an image, or None.

    The width, where it isn't told, is that of N's divisors with which x/z changes least along
    columns: the image is at most twice as wide as it is high, or twice as high as wide.
    """
    count = len(points)
    measured = np.isfinite(points).all(1) & (points[:, 2] != 0)
    if count < MIN_CELLS or measured.sum() < 0.05 * count:
        return None
    forward = np.median(np.sign(points[measured, 2])) >= 0
    with np.errstate(all="ignore"):
        slopes = points[:, :2] / np.abs(points[:, 2:])
        measured &= (np.abs(slopes) < STEEPEST).all(1)
        slopes[~measured] = np.nan
    widths = [width] if width else range(math.isqrt(count // 2), math.isqrt(2 * count) + 1)
    best: tuple[float, Raster] | None = None
    for candidate in widths:
        if candidate < 2 or count % candidate:
            continue
        fit = _raster_fit(slopes.reshape(-1, candidate, 2), 1 if forward else -1)
        if fit is not None and (best is None or fit[0] < best[0]):
            best = fit
    return None if best is None else best[1]


def _raster_fit(slopes: NDArray[np.floating], forward: int) -> tuple[float, Raster] | None:
    """Return how much slopes (H, W, 2) change along columns and rows, and the raster."""
    height, width = slopes.shape[:2]
    signs, worst = [], 0.0
    for axis in (0, 1):
        lines = slopes[..., axis] if axis == 0 else slopes[..., axis].T
        lines = lines[:: max(1, len(lines) // 64)]
        seen = np.isfinite(lines)
        used = seen.sum(0) >= 2
        if used.sum() < 0.5 * lines.shape[1]:
            return None
        middle = np.nanmedian(lines[:, used], axis=0)
        spread = float(np.nanpercentile(middle, 95) - np.nanpercentile(middle, 5))
        off = float(np.nanmean(np.abs(lines[:, used] - middle)))
        rising = np.diff(middle)
        sign = 1 if np.median(rising) > 0 else -1
        if not off < COLUMN_SHARE * spread or np.mean(rising * sign > 0) < 0.8:
            return None
        signs.append(sign)
        worst = max(worst, off / spread)
    return worst, Raster(width, height, (signs[0], signs[1], forward))


def origin_behind(images: Sequence[Float32]) -> float:
    """Return how far behind the origin the rays of the pixels meet, in m; 0 if it can't be told.

    A pixel whose z changes from image to image tells it: x is a (z + behind).
    """
    if len({image.shape for image in images}) != 1:
        return 0.0
    z = np.stack([np.where(_measured(image), image[..., 2], np.nan) for image in images])
    z = z.astype(float)
    top = bottom = 0.0
    with np.errstate(all="ignore"):
        count = np.isfinite(z).sum(0)
        mean = np.nansum(z, 0) / count
        around = np.where(np.isfinite(z), z - mean, 0.0)
        spread = (around**2).sum(0)
        told = (count > 1) & (spread > MIN_SPREAD_M**2)
        for axis in (0, 1):
            x = np.stack([image[..., axis] for image in images]).astype(float)
            x = np.where(np.isfinite(z), x, 0.0)
            slope = (around * x).sum(0) / spread
            start = x.sum(0) / count - slope * mean
            top += float((spread * slope * start)[told].sum())
            bottom += float((spread * slope**2)[told].sum())
    return top / bottom if bottom > 0 else 0.0


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


def _fits(points: Float32, mask: Bool, rays: Float32) -> bool:
    z = points[mask][:, 2:]
    off = np.abs(points[mask][:, :2] - rays[mask] * z)
    return bool((off <= TOLERANCE_M + TOLERANCE_SHARE * z).all())


def _measured(points: Float32) -> Bool:
    """Mask of points; some programs write the origin, not NaN, where nothing came back."""
    return np.asarray((np.abs(points) < FARTHEST_M).all(-1) & (points[..., 2] > 0))
