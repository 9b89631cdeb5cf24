"""A recording of arrays in memory: `tofuse.from_arrays`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounds
from tofuse.engine.cameras import Camera, Pinhole, RayTable, pinhole_values
from tofuse.engine.errors import InputError, signals_as_themselves
from tofuse.engine.frames.depth_counts import check_sign, is_marked_invalid
from tofuse.engine.frames.frames import AmplitudeKind, DepthKind, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.parts import check_number
from tofuse.engine.times import check_seconds

# The unit of integer depth for nearly all cameras.
_MILLIMETRES = 1e-3
# A larger median of depth can't be in metres.
_MAX_MEDIAN_M = 200.0


@signals_as_themselves()
def from_arrays(
    depth: ArrayLike | Sequence[ArrayLike],
    camera: Camera | ArrayLike,
    *,
    color: ArrayLike | Sequence[ArrayLike | None] | None = None,
    amplitude: ArrayLike | Sequence[ArrayLike | None] | None = None,
    confidence: ArrayLike | Sequence[ArrayLike | None] | None = None,
    timestamps: ArrayLike | None = None,
    reference: ArrayLike | None = None,
    odometry: ArrayLike | None = None,
    depth_kind: DepthKind = "z",
    depth_unit_m: float | None = None,
    amplitude_kind: AmplitudeKind = "raw",
) -> Recording:
    """Return a recording of images in memory.

    Parameters
    ----------
    depth
        (N, H, W), or N images (H, W); 0 or NaN where invalid, in integers also 65535 and the
        largest value of their type. Floats are in metres and integers in millimetres, unless
        `depth_unit_m` is given.
    camera
        A camera, or the matrix K (3, 3) of a pinhole camera without distortion, in pixels of the
        depth images.
    color
        (N, H, W, 3) uint8 RGB at the pixels of depth; or N images, None for frames without one, as
        of `amplitude` and `confidence`.
    amplitude
        (N, H, W) counts, of the kind `amplitude_kind`.
    confidence
        (N, H, W) uint8, higher is better, 0 where nothing was measured.
    timestamps
        (N,) s, or datetime64 or timedelta64, or dates and durations of Python; 30 images per second
        unless given.
    reference
        (N, 4, 4) T_world_camera, NaN where unknown; used only for comparison.
    odometry
        (N, 4, 4) T_world_camera of odometry, NaN where unknown.
    depth_kind
        "z", or "range" along the rays.
    depth_unit_m
        Metres per unit of depth.
    amplitude_kind
        See `RangeFrame`.

    Raises
    ------
    InputError
        If shapes or types do not fit, or the depth can't be in the assumed unit.
    """
    images = _images("depth", depth, None, "iuf", has_gaps=False)
    shape = images[0].shape
    if len({image.dtype.kind == "f" for image in images}) > 1:
        raise InputError(
            "contains integers and floats, which are in different units",
            where="depth",
            remedy="pass images of one type",
        )
    if len(shape) != 2:
        raise InputError(f"has images of shape {shape}", where="depth", remedy="pass (N, H, W)")
    checked_camera = _camera(camera, shape, len(images))
    times = _times(timestamps, len(images))
    colors = _optional("color", color, images, np.uint8, 3)
    amplitudes = _optional("amplitude", amplitude, images, np.float32)
    confidences = _optional("confidence", confidence, images, np.uint8)
    to_metres = _to_metres(images, depth_unit_m)
    frames = []
    for k, image in enumerate(images):
        metres = to_metres(image)
        valid = (metres > 0) & (metres < se3.MAX_COORDINATE_M)
        frames.append(
            RangeFrame(
                k,
                float(times[k]),
                checked_camera,
                np.where(valid, metres, 0).astype(np.float32),
                depth_kind,
                amplitude_image=None if amplitudes is None else amplitudes[k],
                confidence_image=None if confidences is None else confidences[k],
                color_image=None if colors is None else colors[k],
                amplitude_kind=amplitude_kind,
            )
        )
    source = ArraySource(
        frames,
        _poses("reference", reference, len(frames)),
        _poses("odometry", odometry, len(frames)),
    )
    return Recording.of(source, "arrays", "arrays")


def _images(
    name: str,
    values: Any,
    shape: tuple[int, ...] | None,
    kinds: str = "iufb",
    *,
    has_gaps: bool = True,
) -> list[Any]:
    """The images as arrays (H, W, ...), None where there is none and `has_gaps`."""
    try:
        # A masked pixel has no value; `asarray` would return what is under the mask.
        images: list[Any] = [v if v is None else np.ma.filled(v, 0) for v in values]
    except TypeError as error:
        # Of tensors on a GPU it is the error that says what to do.
        raise InputError(
            f"is not an array of images ({error})", where=name, remedy="pass (N, H, W)"
        ) from error
    if not images:
        raise InputError("contains no image", where=name)
    missing = next((k for k, image in enumerate(images) if image is None), None)
    if missing is not None and not has_gaps:
        raise InputError(f"image {missing} is None", where=name, remedy="leave out such frames")
    expected = images[0].shape if shape is None else shape
    for k, image in enumerate(images):
        if image is None:
            continue
        if image.dtype.kind not in kinds:
            raise InputError(
                f"image {k} is of type {image.dtype}",
                where=name,
                remedy=f"pass integers or floats (N, {', '.join(map(str, expected))})",
            )
        if image.shape != expected:
            raise InputError(
                f"image {k} is of shape {image.shape}, not {expected}",
                where=name,
                remedy=f"pass (N, {', '.join(map(str, expected))})",
            )
    return images


def _optional(
    name: str,
    values: Any,
    images: list[NDArray[Any]],
    dtype: type[np.generic],
    channels: int | None = None,
) -> list[NDArray[Any] | None] | None:
    if values is None:
        return None
    shape = images[0].shape if channels is None else (*images[0].shape, channels)
    converted = _images(name, values, shape)
    if len(converted) != len(images):
        raise InputError(
            f"contains {quantities.count(len(converted), 'image')}, and depth {len(images)}",
            where=name,
        )
    wrong = [image.dtype for image in converted if image is not None and image.dtype != np.uint8]
    if dtype is np.uint8 and wrong:
        raise InputError(f"is {wrong[0]}", where=name, remedy="use uint8, from 0 to 255")
    return [image if image is None else image.astype(dtype, copy=False) for image in converted]


def _to_metres(
    images: list[NDArray[Any]], unit_m: float | None
) -> Callable[[NDArray[Any]], Float64]:
    is_integer = images[0].dtype.kind in "iu"
    scale = unit_m if unit_m is not None else (_MILLIMETRES if is_integer else 1.0)
    check_number(scale, Bounds(0, exclusive=True), "depth_unit_m")
    if unit_m is None and is_integer and images[0].dtype.itemsize == 1:
        raise InputError(
            f"is {images[0].dtype}, which ends at 255 mm",
            where="depth",
            remedy="pass images of 16 bits, or depth_unit_m",
        )
    if unit_m is None and not is_integer:
        sample = np.concatenate([image[::7, ::7].ravel() for image in images[:8]])
        sample = sample[np.isfinite(sample) & (sample > 0)]
        if len(sample) and np.median(sample) > _MAX_MEDIAN_M:
            raise InputError(
                f"has a median of {np.median(sample):.4g}, which can't be metres",
                where="depth",
                remedy="use depth_unit_m=0.001 if it is in millimetres",
            )

    def to_metres(image: NDArray[Any]) -> Float64:
        metres = image.astype(np.float64) * scale
        metres[is_marked_invalid(image)] = 0
        check_sign(image, "depth")
        return metres

    return to_metres


def _camera(camera: Camera | ArrayLike, shape: tuple[int, ...], count: int) -> Camera:
    height, width = shape
    if isinstance(camera, Pinhole | RayTable):
        if (camera.height, camera.width) != (height, width):
            is_last = (camera.height, camera.width) == (count, height)
            raise InputError(
                f"has {camera.width} x {camera.height} pixels, and depth {width} x {height}",
                where="camera",
                remedy="frames come first: pass numpy.moveaxis(depth, -1, 0)"
                if is_last
                else "pass the camera of these images, which are (N, H, W)",
            )
        return camera
    try:
        K = np.asarray(camera, float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"is {quantities.one(type(camera).__name__)}, neither a camera nor a matrix",
            where="camera",
            remedy="pass K (3, 3), or a camera such as tofuse.Pinhole",
        ) from error
    values = pinhole_values(K, (count, height, width), "camera")
    if not (-0.5 <= values["cx"] <= width - 0.5 and -0.5 <= values["cy"] <= height - 0.5):
        raise InputError(
            f"has its centre ({values['cx']:.0f}, {values['cy']:.0f}) outside of images of "
            f"{width} x {height} pixels",
            where="camera",
            remedy="pass the K of the depth images; for a part of an image, a tofuse.Pinhole",
        )
    return Pinhole(width, height, **values)


def _times(timestamps: ArrayLike | None, count: int) -> Float64:
    if timestamps is None:
        return np.arange(count) / 30
    given = np.asarray(timestamps)
    is_number = given.dtype.kind in "iuf"
    times = _seconds(given)
    if times.shape != (count,):
        raise InputError(
            f"have shape {times.shape}, and depth {count} images",
            where="timestamps",
            remedy="pass one for each image, in seconds",
        )
    is_wrong = ~np.isfinite(times)
    is_wrong[1:] |= ~(np.diff(times) > 0)
    if is_wrong.any():
        k = int(is_wrong.argmax())
        raise InputError(
            f"are not numbers that ascend: that of image {k} is {given[k]!s}",
            where="timestamps",
            remedy="use seconds, and leave out images that repeat",
        )
    if is_number and count > 1:
        check_seconds(times)
    return times


def _seconds(times: NDArray[Any]) -> Float64:
    """Timestamps as numbers; dates and durations in seconds since the epoch, or since zero."""
    if times.dtype.kind in "iuf":
        return times.astype(float)
    if times.dtype.kind not in "mM":
        return np.array([_seconds_of(time) for time in times.flat], float).reshape(times.shape)
    missing = np.isnat(times)
    ns = times.astype(f"{times.dtype.kind}8[ns]").astype(np.int64)
    return np.where(missing, np.nan, ns // 10**9 + ns % 10**9 / 1e9)


def _seconds_of(time: object) -> float:
    """A date of Python, as NumPy's in UTC unless it states its zone, or a duration; else NaN."""
    if isinstance(time, datetime):
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    return time.total_seconds() if isinstance(time, timedelta) else np.nan


def _poses(name: str, values: ArrayLike | None, count: int) -> Float64 | None:
    return None if values is None else se3.check_poses(values, where=name, count=count)
