"""Organised clouds: points in rows and columns, on the rays of a camera's pixels."""

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
from tofuse.geometry.se3 import MAX_COORDINATE_M
from tofuse.recordings.frames import RangeFrame

SAMPLES = 8
# Largest distance of a point from its pixel's ray: errors of rounding to 0.1 mm and float32.
TOLERANCE_M = 5e-4
TOLERANCE_FRACTION = 1e-4
# Largest deviation from a pinhole camera to be considered one: 0.01 px is 0.2 mm at 10 m.
PINHOLE_PIXELS = 0.01
MAX_SLOPE = 100.0  # of a ray: 89.4 degrees off the axis
# Largest mean deviation of x/z along a column of pixels, as a fraction of its range in the image.
COLUMN_FRACTION = 0.05
MIN_CELLS = 256
MIN_SPREAD_M = 0.1  # of z in a pixel, to determine the origin of its ray


@dataclass(frozen=True)
class Raster:
    """The arrangement of points in rows and columns.

    Attributes
    ----------
    width, height
        Of the image in pixels.
    signs
        Factors of x, y and z that make x right, y down and z forward.
    """

    width: int
    height: int
    signs: tuple[int, int, int] = (1, 1, 1)

    @property
    def reversed_axes(self) -> str:
        """The axes that are reversed, in words; empty if none."""
        names = [name for name, sign in zip("xyz", self.signs, strict=True) if sign < 0]
        return f"{' and '.join(names)} run{'s'[: len(names) == 1]}" if names else ""

    def image(self, points: Float32) -> Float32:
        """Return points (N, 3) as an image (H, W, 3) with corrected signs."""
        return points.reshape(self.height, self.width, 3) * np.array(self.signs, np.float32)


def find_raster(points: Float32, width: int | None = None) -> Raster | None:
    """Return the raster of points (N, 3) that are stored row by row; None if they form no image.

    Unless given, the width is the divisor of N with which x/z varies least along columns, for
    aspect ratios up to 2.
    """
    count = len(points)
    measured = np.isfinite(points).all(1) & (points[:, 2] != 0)
    if count < MIN_CELLS or measured.sum() < 0.05 * count:
        return None
    forward = np.median(np.sign(points[measured, 2])) >= 0
    with np.errstate(all="ignore"):
        slopes = points[:, :2] / np.abs(points[:, 2:])
        measured &= (np.abs(slopes) < MAX_SLOPE).all(1)
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


def _raster_fit(slopes: NDArray[np.floating], z_sign: int) -> tuple[float, Raster] | None:
    """The variation of slopes (H, W, 2) along columns and rows, and the raster; None if none."""
    height, width = slopes.shape[:2]
    signs, worst = [], 0.0
    for axis in (0, 1):
        lines = slopes[..., axis] if axis == 0 else slopes[..., axis].T
        lines = lines[:: max(1, len(lines) // 64)]
        used = np.isfinite(lines).sum(0) >= 2
        if used.sum() < 0.5 * lines.shape[1]:
            return None
        centre = np.nanmedian(lines[:, used], axis=0)
        spread = float(np.nanpercentile(centre, 95) - np.nanpercentile(centre, 5))
        deviation = float(np.nanmean(np.abs(lines[:, used] - centre)))
        rising = np.diff(centre)
        sign = 1 if np.median(rising) > 0 else -1
        if not deviation < COLUMN_FRACTION * spread or np.mean(rising * sign > 0) < 0.8:
            return None
        signs.append(sign)
        worst = max(worst, deviation / spread)
    return worst, Raster(width, height, (signs[0], signs[1], z_sign))


def ray_origin_offset(images: Sequence[Float32]) -> float:
    """Return the distance in m at which the pixels' rays meet behind the origin; 0 if unknown.

    Determined from pixels whose z varies between images (H, W, 3): x = a (z + distance).
    """
    if len({image.shape for image in images}) != 1:
        return 0.0
    z = np.stack([np.where(_measured(image), image[..., 2], np.nan) for image in images])
    z = z.astype(float)
    numerator = denominator = 0.0
    with np.errstate(all="ignore"):
        count = np.isfinite(z).sum(0)
        mean = np.nansum(z, 0) / count
        centred = np.where(np.isfinite(z), z - mean, 0.0)
        spread = (centred**2).sum(0)
        usable = (count > 1) & (spread > MIN_SPREAD_M**2)
        for axis in (0, 1):
            x = np.stack([image[..., axis] for image in images]).astype(float)
            x = np.where(np.isfinite(z), x, 0.0)
            slope = (centred * x).sum(0) / spread
            intercept = x.sum(0) / count - slope * mean
            numerator += float((spread * slope * intercept)[usable].sum())
            denominator += float((spread * slope**2)[usable].sum())
    return numerator / denominator if denominator > 0 else 0.0


def common_camera(images: Sequence[Float32]) -> Camera | None:
    """Return the camera whose pixels' rays contain the points (H, W, 3) of all images, or None."""
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
    has_ray = np.asarray(np.isfinite(rays).all(-1))
    error = np.abs((fit.rays() - rays)[has_ray]) * (fit.fx, fit.fy)
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
    """Return points (H, W, 3) with columns (H * W, ...) as an image of `camera`.

    Raises
    ------
    InputError
        If the points are not on its rays.
    """
    shape = (camera.height, camera.width)
    if points.shape[:2] != shape:
        raise InputError(
            f"is organised as {points.shape[1]} x {points.shape[0]}, the previous clouds "
            f"{camera.width} x {camera.height}",
            where=where,
            remedy="keep the clouds of each camera apart",
        )
    z = points[..., 2]
    measured = _measured(points)
    rays = camera.rays()
    has_ray = np.asarray(np.isfinite(rays).all(-1))
    if not _fits(points, measured & has_ray, rays):
        raise InputError(
            "has points off the rays of the previous clouds",
            where=where,
            remedy="keep the clouds of each camera apart",
        )
    if (measured & ~has_ray).any():
        # Pixels without measurements in the sampled clouds get the ray of their point.
        point_slopes = points[..., :2] / np.where(measured, z, np.nan)[..., None]
        camera = RayTable(np.where(has_ray[..., None], rays, point_slopes))
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
    """Rays (H, W, 2) by least squares over the images, NaN where unknown; None if inconsistent."""
    numerator = np.zeros((*images[0].shape[:2], 2))
    denominator = np.zeros(images[0].shape[:2])
    masks = []
    for image in images:
        if (image[..., 2] < 0).any():
            return None
        measured = _measured(image)
        z = np.where(measured, image[..., 2], 0).astype(float)
        masks.append(measured)
        numerator += np.where(measured[..., None], image[..., :2], 0) * z[..., None]
        denominator += z**2
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = numerator / np.where(denominator > 0, denominator, np.nan)[..., None]
    if (np.abs(slopes) > MAX_SLOPE).any():
        return None
    rays = slopes.astype(np.float32)
    fits = all(_fits(image, mask, rays) for image, mask in zip(images, masks, strict=True))
    return rays if fits else None


def _fits(points: Float32, mask: Bool, rays: Float32) -> bool:
    z = points[mask][:, 2:]
    residual = np.abs(points[mask][:, :2] - rays[mask] * z)
    return bool((residual <= TOLERANCE_M + TOLERANCE_FRACTION * z).all())


def _measured(points: Float32) -> Bool:
    """Mask of valid points; some programs write the origin instead of NaN for missing ones."""
    return np.asarray((np.abs(points) < MAX_COORDINATE_M).all(-1) & (points[..., 2] > 0))
