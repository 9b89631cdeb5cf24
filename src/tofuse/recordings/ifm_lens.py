"""Frames of ifm's O3R heads, with which unit and lens are stored."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32, Float64
from tofuse.errors import InputError
from tofuse.geometry.cameras import RayTable
from tofuse.recordings.camera_file import MAX_SLOPE
from tofuse.recordings.frames import RangeFrame

BOUGUET, FISHEYE = 0, 2
# version, units of distance and amplitude, 3 factors, 6 of the mounting, model and parameters.
_INFO = struct.Struct("<I2f3f6fI32f")
_PARAMETERS = 10
_INVALID = 1  # bit of the flags


@dataclass(frozen=True)
class HeadInfo:
    """Unit of the distances in m, and model and parameters of the lens."""

    distance_unit_m: float
    model: int
    parameters: tuple[float, ...]

    def metres(self, image: NDArray[Any]) -> Float32:
        """Convert distances or their noise to m: integers are counts, floats are in m already."""
        out = image.astype(np.float32)
        return out if image.dtype.kind == "f" else out * np.float32(self.distance_unit_m)


def read_info(data: bytes, where: str) -> HeadInfo:
    """Read the head's information on a frame (chunk 420): unit of distance and lens.

    Raises
    ------
    InputError
        If it is cut off or implausible.
    """
    if len(data) < _INFO.size:
        raise InputError("is cut off", where=where, remedy="copy the file again")
    _, unit, *values = _INFO.unpack_from(data)
    model, parameters = values[10], tuple(values[11:21])
    return checked_info(float(unit), int(model), parameters, where)


def checked_info(unit: float, model: int, parameters: tuple[float, ...], where: str) -> HeadInfo:
    """Return the information with a unit in m, a lens model and its first ten parameters.

    Raises
    ------
    InputError
        If they are implausible.
    """
    if not 1e-6 < unit < 1 or len(parameters) != _PARAMETERS or not np.isfinite(parameters).all():
        raise InputError("has implausible calibration values", where=where, remedy="copy it again")
    return HeadInfo(unit, model, parameters)


def head_frame(
    index: int,
    timestamp: float,
    info: HeadInfo,
    where: str,
    distance: NDArray[Any],
    *,
    flags: NDArray[Any] | None = None,
    noise: NDArray[Any] | None = None,
    amplitude: NDArray[Any] | None = None,
) -> RangeFrame:
    """Return a frame of a head.

    Parameters
    ----------
    index, timestamp
        Of the frame, s.
    info
        Unit and lens.
    where
        The recording or camera, for errors.
    distance, noise
        (H, W) radial distance and its standard deviation, see `HeadInfo.metres`.
    flags
        (H, W) bits for each pixel, which mark invalid ones.
    amplitude
        (H, W) counts.

    Raises
    ------
    InputError
        If the flags are not integers, or the lens is implausible.
    """
    depth = info.metres(distance)
    if flags is not None:
        if flags.dtype.kind not in "ui":
            raise InputError("has flags that are not integers", where=where)
        depth = np.where(flags & _INVALID, np.float32(0), depth)
    if amplitude is not None:
        amplitude = np.nan_to_num(amplitude.astype(np.float32), posinf=0, neginf=0)
    return RangeFrame(
        index,
        timestamp,
        head_camera(info, distance.shape[1], distance.shape[0], where),
        depth,
        "range",
        amplitude,
        sigma_image=None
        if noise is None
        else np.nan_to_num(info.metres(noise), posinf=0, neginf=0),
    )


@lru_cache(maxsize=16)
def head_camera(info: HeadInfo, width: int, height: int, where: str) -> RayTable:
    """Return the rays (H, W) of a lens by the maker's back-projection model.

    Unlike OpenCV's, its polynomials map pixels to rays, and pixel coordinates start at corners.
    """
    model = info.model
    if model not in (BOUGUET, FISHEYE):
        raise InputError(f"has the lens model {model}, not 0 or 2", where=where)
    fx, fy, cx, cy, skew, *k = info.parameters
    if not (1 < fx < 1e5 and 1 < fy < 1e5):
        raise InputError(f"has focal lengths of {fx:g} and {fy:g} pixels", where=where)
    v, u = np.mgrid[:height, :width] + 0.5
    y = (v - cy) / fy
    x = (u - cx) / fx - skew * y
    with np.errstate(all="ignore"):
        rays = _bouguet(x, y, k) if model == BOUGUET else _fisheye(x, y, k)
        rays[~(np.abs(rays) < MAX_SLOPE).all(-1)] = np.nan
    return RayTable(rays.astype(np.float32))


def _bouguet(x: Float64, y: Float64, k: list[float]) -> Float64:
    r2 = x * x + y * y
    radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    return np.stack(
        [
            radial * x + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            radial * y + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
        ],
        -1,
    )


def _fisheye(x: Float64, y: Float64, k: list[float]) -> Float64:
    """Rays of a fisheye: the angle is a polynomial in the radius, which k[4] limits."""
    radius = np.hypot(x, y)
    s = np.minimum(radius, k[4]) ** 2
    theta = radius * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    scale = np.where(radius > 0, np.tan(theta) / np.where(radius > 0, radius, 1), 1.0)
    scale[~((theta >= 0) & (theta < np.pi / 2))] = np.nan
    return np.stack([x * scale, y * scale], -1)
