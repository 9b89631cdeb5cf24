"""TIFF images of one channel, checked before they are decoded."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from tofuse.engine.errors import InputError
from tofuse.formats.files import reading
from tofuse.formats.images.images import MAX_IMAGE_BYTES, check_camera_size, check_pixels, decoded

# Tags of the TIFF 6.0 specification.
_WIDTH, _HEIGHT, _SAMPLES = 256, 257, 277
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
        problem = "is empty" if not data else "is not a TIFF image"
        raise InputError(problem)
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
    check_pixels(width, height, path)
    if channels != 1:
        raise InputError(f"has {channels} channels", remedy="store one channel")
    if not complete:
        raise InputError("is cut off before its end")
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
