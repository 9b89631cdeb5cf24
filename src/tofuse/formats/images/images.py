"""PNG, JPEG, PGM, NumPy and raw images, checked before they are decoded.

OpenCV fills the missing part of a truncated file with zeros or grey, reports it at most on stderr,
and allocates any size that a header declares. So the structure of a file is checked first.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import UInt8
from tofuse.engine.errors import InputError
from tofuse.formats.files import atomic, npz, reading

MAX_PIXELS = 1 << 26  # 8192 x 8192: far beyond any depth camera, and 400 MB of colour
MAX_IMAGE_BYTES = 1 << 29

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_COPY_AGAIN = "copy the file again"
_NOT_SOF = {0xC4, 0xC8, 0xCC}
_SPACE = rb"(?:\s+(?:#[^\n]*\n)?)+"
_PGM = re.compile(rb"P5" + (_SPACE + rb"(\d{1,5})") * 3 + rb"\s")


@dataclass(frozen=True)
class ImageHeader:
    """The size and type of an image, as its header declares them."""

    format: str
    width: int
    height: int
    channels: int
    bits: int

    def __str__(self) -> str:
        return f"{self.width} x {self.height}, {self.channels} x {self.bits} bits"


def read_header(path: str | Path) -> ImageHeader:
    """Read size and type of a PNG, JPEG, PGM or .npy without decoding it.

    Raises
    ------
    InputError
        If it is none of these, is cut off within its header, or declares an absurd size.
    """
    if Path(path).suffix.lower() == ".npy":
        image = _npy_image(path, None)
        height, width = image.shape
        return ImageHeader("npy", width, height, 1, 8 * image.itemsize)
    head = reading.read_head(path, 64)
    with reading.about(path, _COPY_AGAIN):
        return _header(
            head if head.startswith(_PNG) else reading.read_bytes(path, limit=MAX_IMAGE_BYTES)
        )


def _header(data: bytes) -> ImageHeader:
    if data.startswith(_PNG):
        header = _png_header(data)
    elif data.startswith(b"\xff\xd8"):
        header = _jpeg_header(data)
    elif pgm := _PGM.match(data):
        width, height, max_value = (int(text) for text in pgm.groups())
        if not 0 < max_value < 1 << 16:
            raise InputError(f"declares values up to {max_value}")
        header = ImageHeader("pgm", width, height, 1, 16 if max_value > 255 else 8)
    else:
        problem = "is empty" if not data else "is neither a PNG, a JPEG nor a binary PGM image"
        raise InputError(problem)
    check_pixels(header.width, header.height)
    return header


def check_pixels(width: int, height: int) -> None:
    """Raise InputError unless an image may have this size."""
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise InputError(
            f"declares {width} x {height} pixels",
            remedy=f"use an image of 1 to {MAX_PIXELS} pixels",
        )


def check_camera_size(width: int, height: int, size: tuple[int, int] | None) -> None:
    """Raise InputError unless an image has the size of its camera, if known."""
    if size is not None and (width, height) != size:
        raise InputError(
            f"is {width} x {height} pixels, the camera {size[0]} x {size[1]}",
            remedy="use the camera description of these images",
        )


def _png_header(data: bytes) -> ImageHeader:
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise InputError("is cut off within its header")
    width, height, bits, color = struct.unpack(">IIBB", data[16:26])
    if color not in _PNG_CHANNELS:
        raise InputError("is a damaged PNG (no such colour type)")
    return ImageHeader("png", width, height, _PNG_CHANNELS[color], bits)


def _jpeg_header(data: bytes) -> ImageHeader:
    offset = 2
    while offset + 9 < len(data):
        if data[offset] != 0xFF:
            break
        marker = data[offset + 1]
        if marker == 0xFF:
            offset += 1
            continue
        (length,) = struct.unpack(">H", data[offset + 2 : offset + 4])
        if 0xC0 <= marker <= 0xCF and marker not in _NOT_SOF:
            bits, height, width, channels = struct.unpack(">BHHB", data[offset + 4 : offset + 10])
            return ImageHeader("jpeg", width, height, channels, bits)
        offset += 2 + length
    raise InputError("is a damaged or cut off JPEG")


def _check_complete(data: bytes) -> None:
    """Raise InputError unless a PNG has all its chunks, each with its checksum."""
    view = memoryview(data)
    offset = len(_PNG)
    while offset + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, offset)
        end = offset + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(view[offset + 4 : end - 4]) != checksum:
            raise InputError("is damaged (wrong checksum of a PNG chunk)")
        if data[offset + 4 : offset + 8] == b"IEND":
            return
        offset = end
    raise InputError("is cut off before its end")


def check_first_size(files: Sequence[Path], size: tuple[int, int], where: str, remedy: str) -> None:
    """Compare the size of the first images with (width, height), stated by `where`.

    Raises
    ------
    InputError
        If that of all of them differs. Errors of a single file are raised when it is read.
    """
    problems: list[InputError] = []
    for path in files[:5]:
        try:
            header = read_header(path)
        except InputError:
            continue
        if (header.width, header.height) == size:
            return
        problem = f"is {header.width} x {header.height} pixels, {where} {size[0]} x {size[1]}"
        problems.append(InputError(problem, where=path, remedy=remedy))
    if problems:
        raise problems[0]


def first_size(files: Sequence[Path]) -> tuple[int, int]:
    """Return (width, height) of the first image with a readable header."""
    nothing = InputError("has no images", where="depth", remedy="check the recording")
    header = reading.first_readable(files, read_header, nothing)
    return header.width, header.height


def read_image(
    path: str | Path, *, size: tuple[int, int] | None = None, dtype: str | None = None
) -> NDArray[Any]:
    """Read a PNG, JPEG or PGM as it is stored: (H, W) grey, or (H, W, 3) RGB; uint8 or uint16.

    Also the numbers (H, W) of an .npy file, which may have any type.

    Parameters
    ----------
    path
        The file.
    size
        Expected (width, height).
    dtype
        Expected type of its single channel, "uint8" or "uint16" (depth, amplitude, confidence).

    Raises
    ------
    InputError
        If it can't be read, is cut off or damaged, or isn't of that size and type.
    """
    if Path(path).suffix.lower() == ".npy":
        return _npy_image(path, size)
    return parse_image(
        reading.read_bytes(path, limit=MAX_IMAGE_BYTES), path, size=size, dtype=dtype
    )


def _npy_image(path: str | Path, size: tuple[int, int] | None) -> NDArray[Any]:
    image = npz.read_npy(path)
    with reading.about(path, "save (H, W) floats in metres, or integers"):
        if image.ndim != 2 or image.dtype.kind not in "uif":
            raise InputError(f"is {image.dtype} of shape {image.shape}")
        height, width = image.shape
        check_pixels(width, height)
        check_camera_size(width, height, size)
    return image


def parse_image(
    data: bytes, path: str | Path, *, size: tuple[int, int] | None = None, dtype: str | None = None
) -> NDArray[Any]:
    """Decode a PNG, JPEG or PGM in memory; `path` names it in errors. See `read_image`."""
    with reading.about(path, _COPY_AGAIN):
        return _parsed(data, size, dtype)


def _parsed(data: bytes, size: tuple[int, int] | None, dtype: str | None) -> NDArray[Any]:
    header = _header(data)
    check_camera_size(header.width, header.height, size)
    if dtype is not None and (header.channels != 1 or f"uint{header.bits}" != dtype):
        raise InputError(
            f"has {header.channels} channels of {header.bits} bits",
            remedy=f"store one channel of {dtype}",
        )
    if header.format == "pgm":
        return _pgm_pixels(data, header)
    if header.format == "png":
        _check_complete(data)
    elif data.rfind(b"\xff\xd9") < 0:
        raise InputError("is cut off before its end")
    return _decode(data, header)


def _pgm_pixels(data: bytes, header: ImageHeader) -> NDArray[Any]:
    match = _PGM.match(data)
    assert match is not None
    dtype = np.dtype(">u2" if header.bits == 16 else "u1")
    count = header.width * header.height
    if len(data) < match.end() + count * dtype.itemsize:
        raise InputError("is cut off before its end")
    image = np.frombuffer(data, dtype, count, match.end()).reshape(header.height, header.width)
    return image.astype(dtype.newbyteorder("="))


def _decode(data: bytes, header: ImageHeader) -> NDArray[Any]:
    import cv2

    grey = header.channels < 3
    # The EXIF orientation of a phone would rotate the image relative to its depth.
    flags = cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
    flags |= cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    image = decoded(data, flags, (header.height, header.width))
    return image if grey else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def decoded(data: bytes, flags: int, shape: tuple[int, int]) -> NDArray[Any]:
    """Decode an image by OpenCV with its `flags`.

    Raises
    ------
    InputError
        If that fails, or the image has another (height, width).
    """
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != shape:
        raise InputError("can't be decoded")
    return image


def read_color(path: str | Path) -> UInt8:
    """Read a PNG or JPEG as (H, W, 3) uint8 RGB; grey is replicated, 16 bits are reduced to 8."""
    return as_color(read_image(path))


def as_color(image: NDArray[Any]) -> UInt8:
    """Return an image of `read_image` as (H, W, 3) uint8 RGB."""
    if image.dtype == np.uint16:
        image = (image.astype(np.uint16) >> 8).astype(np.uint8)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return image.astype(np.uint8, copy=False)


def read_raw(path: str | Path, dtype: str, size: tuple[int, int], remedy: str) -> NDArray[Any]:
    """Read a file that consists of the pixels of one image, (H, W, ...).

    Parameters
    ----------
    path
        The file.
    dtype
        NumPy's name of the type of a pixel; "3<f4" are three channels of float32.
    size
        (width, height).
    remedy
        The remedy if the file has another size.

    Raises
    ------
    InputError
        If it can't be read, or has another size.
    """
    data = reading.read_bytes(path, limit=MAX_IMAGE_BYTES)
    pixel, (width, height) = np.dtype(dtype), size
    if len(data) != pixel.itemsize * width * height:
        raise InputError(
            f"has {len(data)} bytes, not {pixel.itemsize} for each of {width} x {height} pixels",
            where=path,
            remedy=remedy,
        )
    return np.frombuffer(data, pixel).reshape(height, width, *pixel.shape)


# Tags of the TIFF 6.0 specification.
_WIDTH, _HEIGHT, _ORIENTATION, _SAMPLES = 256, 257, 274, 277
_PIECES = ((273, 279), (324, 325))  # offsets and sizes of strips, or of tiles
_CODES = {1: "B", 3: "H", 4: "I"}  # of the integer types
_MAX_TAGS = 256


def read_tiff(path: str | Path, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """Read the first image of a TIFF file: (H, W) of uint8, uint16, float32 or float64.

    Parameters
    ----------
    path
        The file.
    size
        Expected (width, height).

    Raises
    ------
    InputError
        If it is not a TIFF of one channel, is cut off or damaged, or of another size.
    """
    import cv2

    data = reading.read_bytes(path, limit=MAX_IMAGE_BYTES)
    with reading.about(path, "copy the file again"):
        width, height = tiff_size(data)
        check_camera_size(width, height, size)
        image = decoded(data, cv2.IMREAD_UNCHANGED, (height, width))
        if image.ndim != 2 or image.dtype.kind not in "uf":
            raise InputError("can't be decoded", remedy="store one channel as TIFF")
    return image


def tiff_size(data: bytes) -> tuple[int, int]:
    """Return width and height of the first image, after checking that its data is complete.

    Raises
    ------
    InputError
        See `read_tiff`.
    """
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        raise InputError("is empty" if not data else "is not a TIFF image")
    try:
        tags = _tags(data, order)
        width, height = tags[_WIDTH][0], tags[_HEIGHT][0]
        channels = tags.get(_SAMPLES, [1])[0]
        pieces = [(tags[a], tags[b]) for a, b in _PIECES if a in tags and b in tags]
        complete = bool(pieces) and all(
            len(starts) == len(sizes)
            and all(start + count <= len(data) for start, count in zip(starts, sizes, strict=True))
            for starts, sizes in pieces
        )
    except (struct.error, KeyError, IndexError, ValueError) as error:
        raise InputError("is a damaged TIFF") from error
    check_pixels(width, height)
    if channels != 1:
        raise InputError(f"has {channels} channels", remedy="store one channel")
    if not complete:
        raise InputError("is cut off before its end")
    if tags.get(_ORIENTATION, [1]) != [1]:  # OpenCV would turn the image relative to its camera
        raise InputError("is turned or mirrored by its tag Orientation", remedy="set that to 1")
    return width, height


def _tags(data: bytes, order: str) -> dict[int, list[int]]:
    """The integer values of the tags of the first directory."""
    (directory,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, directory)
    if count > _MAX_TAGS:
        raise ValueError(count)
    tags = {}
    for k in range(count):
        tag, kind, number = struct.unpack_from(order + "HHI", data, directory + 2 + 12 * k)
        if kind not in _CODES:
            continue
        start = directory + 2 + 12 * k + 8
        size = struct.calcsize(order + _CODES[kind]) * number
        if size > 4:
            (start,) = struct.unpack_from(order + "I", data, start)
        if start + size > len(data):
            raise ValueError(number)
        tags[tag] = list(struct.unpack_from(f"{order}{number}{_CODES[kind]}", data, start))
    return tags


def png_bytes(image: NDArray[np.generic]) -> bytes:
    """Encode (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, as PNG."""
    import cv2

    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise InputError(
            f"is an array of shape {image.shape} and type {image.dtype}",
            where="image",
            remedy="pass (H, W) uint8 or uint16, or (H, W, 3) uint8",
        )
    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    pixels: NDArray[Any] = image
    ok, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise InputError(f"of shape {image.shape} can't be encoded as PNG", where="image")
    return bytes(data)


def jpeg_bytes(image: UInt8, quality: int = 92) -> bytes:
    """Encode (H, W, 3) uint8 RGB as JPEG."""
    import cv2

    pixels: NDArray[Any] = np.ascontiguousarray(np.asarray(image, np.uint8)[..., ::-1])
    ok, data = cv2.imencode(
        ".jpg",
        pixels,
        [
            *(cv2.IMWRITE_JPEG_QUALITY, quality),
            *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
        ],
    )
    if not ok:
        raise InputError(f"of shape {image.shape} can't be encoded as JPEG", where="image")
    return bytes(data)


def write_png(path: str | Path, image: NDArray[np.generic]) -> None:
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB; see `replacing` for errors."""
    atomic.write_bytes(path, png_bytes(image))
