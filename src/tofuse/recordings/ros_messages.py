"""Decoding of ROS messages from rosbags: images, compressed depth, lenses and clouds."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32, UInt8
from tofuse.errors import InputError
from tofuse.files.images import as_color, parse_image
from tofuse.geometry.cameras import DISTORTION_ORDER, MODELS, Pinhole
from tofuse.recordings.camera_file import checked_lens

ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
GREY = {"mono8": "u1", "8UC1": "u1", **ENCODINGS}
# Bytes per pixel, and the channels that are red, green and blue, or the packing of YUV.
_COLOR_LAYOUTS: dict[str, tuple[int, list[int] | str]] = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "mono8": (1, [0, 0, 0]),
    **dict.fromkeys(("yuv422", "uyvy"), (2, "uyvy")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, "yuyv")),
}
COLORS = frozenset(_COLOR_LAYOUTS) - {"mono8"}
_JPEG = b"\xff\xd8"
_PNG = b"\x89PNG\r\n\x1a\n"
_COMPRESSED_HEAD = 12
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_AMPLITUDES = ("intensity", "amplitude", "i")
_MAX_SIDE = 16384


def header_time(raw: Any, is2: bool) -> float:
    """Return the timestamp in s of the header at the beginning of a message; 0 if it is not set.

    After four bytes (ROS 1: the sequence number; ROS 2: the encoding) come seconds and nanoseconds.
    """
    head = bytes(raw[:12])
    if len(head) < 12:
        return 0.0
    big_endian = is2 and not head[1] & 1
    seconds, nanoseconds = struct.unpack_from(">II" if big_endian else "<II", head, 4)
    return seconds + nanoseconds / 1e9 if nanoseconds < 10**9 else 0.0


def image(message: Any, where: str, encodings: dict[str, str] = ENCODINGS) -> NDArray[Any]:
    """Return the (H, W) image of a message, without the padding of its rows.

    Raises
    ------
    InputError
        If it has another encoding, or is cut off.
    """
    if message.encoding not in encodings:
        raise InputError(f"has the encoding {message.encoding!r:.40}", where=where)
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(order + encodings[message.encoding])
    return np.ascontiguousarray(_rows(message, dtype.itemsize, where)).view(dtype)


def _rows(message: Any, pixel_bytes: int, where: str) -> UInt8:
    """(H, W * pixel_bytes) content of a message, without the padding of its rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE) or step < width * pixel_bytes:
        raise InputError(f"declares {width} x {height} pixels of {step} bytes per row", where=where)
    if len(data) < step * height:
        raise InputError("is cut off", where=where, remedy="check the bag")
    return data[: step * height].reshape(height, step)[:, : width * pixel_bytes]


def color_image(message: Any, where: str) -> UInt8:
    """Return the (H, W, 3) RGB image of a message.

    Raises
    ------
    InputError
        If it has another encoding, is cut off or damaged.
    """
    height, width = int(message.height), int(message.width)
    data = bytes(message.data)
    if data.startswith(_JPEG):
        return as_color(parse_image(data, where, size=(width, height)))
    encoding = str(message.encoding).lower()
    if encoding not in _COLOR_LAYOUTS:
        raise InputError(f"has the encoding {message.encoding!r:.40}", where=where)
    channels, order = _COLOR_LAYOUTS[encoding]
    pixels = _rows(message, channels, where).reshape(height, width, channels)
    if isinstance(order, str):
        if width % 2:
            raise InputError(f"is {width} pixels wide and {encoding}", where=where)
        import cv2

        code = {"uyvy": cv2.COLOR_YUV2RGB_UYVY, "yuyv": cv2.COLOR_YUV2RGB_YUY2}[order]
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), np.uint8)
    return np.ascontiguousarray(pixels[..., order])


def decompressed(message: Any, where: str) -> NDArray[Any]:
    """Return the image of compressed_depth_image_transport: PNG, of inverse depth for floats."""
    data = bytes(message.data)
    start = data.find(_PNG, 0, 64)
    if start < 0:
        raise InputError("isn't compressed as PNG", where=where, remedy="record it as PNG or raw")
    counts = parse_image(data[start:], where, dtype="uint16")
    if not str(message.format).startswith("32FC1"):
        return counts
    if start < _COMPRESSED_HEAD:
        raise InputError("lacks the parameters of its depth", where=where)
    a, b = np.frombuffer(data, "<f4", 2, start - 8)
    with np.errstate(all="ignore"):
        depth = np.float32(a) / (counts.astype(np.float32) - np.float32(b))
    return np.where(counts > 0, depth, np.float32(np.nan)).astype(np.float32)


def decompressed_color(message: Any, where: str) -> UInt8:
    """Return the (H, W, 3) RGB image of compressed_image_transport: JPEG or PNG."""
    return as_color(parse_image(bytes(message.data), where))


@dataclass(frozen=True)
class Info:
    """A CameraInfo: size, focal lengths and centre by name, model and coefficients of the lens."""

    size: tuple[int, int]
    values: dict[str, float]
    model: str
    coefficients: list[float]


def camera_info(message: Any, where: str) -> Info:
    """Read a CameraInfo; its matrices are called k and d in ROS 2, K and D in ROS 1.

    Raises
    ------
    InputError
        If it has no matrix K.
    """
    K = np.asarray(getattr(message, "k", getattr(message, "K", ())), float)
    D = [float(v) for v in getattr(message, "d", getattr(message, "D", ()))]
    if K.shape != (9,):
        raise InputError("has no 3x3 matrix K", where=where, remedy="use --camera camera.json")
    values = {"fx": float(K[0]), "fy": float(K[4]), "cx": float(K[2]), "cy": float(K[5])}
    return Info((int(message.width), int(message.height)), values, str(message.distortion_model), D)


def lens(message: Any, where: str) -> Pinhole:
    """Return the lens of a CameraInfo.

    Raises
    ------
    InputError
        If its model is none of ROS's own, or it has more coefficients than the model.
    """
    info = camera_info(message, where)
    model, D = info.model, info.coefficients
    name = "pinhole"
    if any(D):
        if model in ("equidistant", "fisheye"):
            name = "fisheye"
        elif model == "plumb_bob" or (not model and len(D) == 5):
            name = "brown"
        elif model == "rational_polynomial":
            name = "rational"
        else:
            raise InputError(
                f"has the distortion model {model!r:.40}",
                where=where,
                remedy="use --camera camera.json",
            )
        if any(D[len(DISTORTION_ORDER[name]) :]):
            raise InputError(
                f"has {len(D)} coefficients for {model}", where=where, remedy="use --camera"
            )
    coefficients = dict(zip(DISTORTION_ORDER[name], D, strict=False))
    return checked_lens(MODELS[name], info.size, info.values | coefficients, where)


@dataclass(frozen=True)
class Cloud:
    """Points (N, 3) of a PointCloud2, their amplitude (N,) or None, and their organised size."""

    points: Float32
    amplitude: Float32 | None
    width: int
    height: int


def cloud(message: Any, where: str) -> Cloud:
    """Read a PointCloud2.

    Raises
    ------
    InputError
        If it lacks coordinates, or is cut off.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: f for f in message.fields if f.datatype in _FIELD_TYPES}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise InputError(f"has no field {missing[0]!r}", where=where, remedy="record x, y and z")
    count, step = int(message.width) * int(message.height), int(message.point_step)
    data = np.frombuffer(message.data, np.uint8)
    if step < 1 or count * step > len(data):
        raise InputError("is cut off", where=where, remedy="check the bag")
    rows = data[: count * step].reshape(count, step)

    def column(name: str) -> Float32:
        field = fields[name]
        dtype = np.dtype(order + _FIELD_TYPES[field.datatype])
        start = int(field.offset)
        if start + dtype.itemsize > step:
            raise InputError(f"has its field {name!r} outside of a point", where=where)
        values = np.ascontiguousarray(rows[:, start : start + dtype.itemsize]).view(dtype)[:, 0]
        with np.errstate(all="ignore"):
            return values.astype(np.float32)

    points = np.stack([column(name) for name in "xyz"], 1)
    amplitude = next((column(name) for name in _AMPLITUDES if name in fields), None)
    return Cloud(points, amplitude, int(message.width), int(message.height))
