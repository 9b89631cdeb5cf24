"""The part of OpenEXR that depth exports use: scan lines, uncompressed, ZIP or ZIPS.

The layout is that of "OpenEXR File Layout" of the Academy Software Foundation: a header of
attributes, a table of offsets, and blocks of scan lines, channel after channel in each line. ZIP
deflates the differences of neighbouring bytes, the even bytes of a block before the odd ones.

Implemented here, as OpenCV's decoder is disabled by default, and the package OpenEXR (3.5) crashes
on damaged headers, or prints to the standard output.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float32, UInt8
from tofuse.engine.errors import InputError
from tofuse.formats.files import reading
from tofuse.formats.images.images import MAX_IMAGE_BYTES, check_camera_size, check_pixels

MAGIC = b"\x76\x2f\x31\x01"
_SINGLE_SCAN_LINES = 2  # the version, with none of the flags for tiles, parts or deep data
_LONG_NAMES = 0x400
_TYPES: tuple[np.dtype[Any], ...] = (np.dtype("<u4"), np.dtype("<f2"), np.dtype("<f4"))
_LINES = {0: 1, 2: 1, 3: 16}  # per block, by compression: none, ZIPS, ZIP
_COMPRESSIONS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
_MAX_CHANNELS = 64


@dataclass(frozen=True)
class _Header:
    width: int
    height: int
    top: int
    compression: int
    channels: dict[str, np.dtype[Any]]
    end: int


def parse_exr(data: bytes, path: str | Path) -> dict[str, Float32]:
    """Decode an image: each channel's name to its (H, W) float32 values.

    Raises
    ------
    InputError
        If it is damaged or cut off, or of an unsupported kind (tiles, other compressions).
    """
    with reading.about(path, "copy the file again"):
        return _parsed(data)


def read_exr_depth(path: str | Path, size: tuple[int, int] | None = None) -> Float32:
    """Read the depth (H, W) of an image: its only channel, of several R, Z or Y.

    For errors see `parse_exr`; also if it isn't of `size` (width, height).
    """
    channels = parse_exr(reading.read_bytes(path, limit=MAX_IMAGE_BYTES), path)
    name = next((n for n in ("R", "Z", "Y") if n in channels), next(iter(channels)))
    with reading.about(path):
        height, width = channels[name].shape
        check_camera_size(width, height, size)
    return channels[name]


def _parsed(data: bytes) -> dict[str, Float32]:
    header = _header(data)
    lines = _LINES[header.compression]
    count = -(-header.height // lines)
    row = header.width * sum(kind.itemsize for kind in header.channels.values())
    offsets = _unpack(f"<{count}Q", data, header.end)
    image = np.zeros((header.height, row), np.uint8)
    decoded = np.zeros(header.height, bool)
    for offset in offsets:
        y, size = _unpack("<iI", data, offset)
        start = y - header.top
        if not 0 <= start < header.height or start % lines:
            raise _damaged("a block is outside the image")
        rows = min(lines, header.height - start)
        block = data[offset + 8 : offset + 8 + size]
        if len(block) < size:
            raise InputError("is cut off")
        pixels = _block(block, rows * row, header.compression)
        image[start : start + rows] = pixels.reshape(rows, row)
        decoded[start : start + rows] = True
    if not decoded.all():
        raise _damaged("scan lines are missing")
    out: dict[str, Float32] = {}
    offset_in_row = 0
    for name, kind in header.channels.items():
        step = header.width * kind.itemsize
        values = np.ascontiguousarray(image[:, offset_in_row : offset_in_row + step]).view(kind)
        with np.errstate(invalid="ignore"):
            out[name] = values.astype(np.float32)
        offset_in_row += step
    return out


def _block(data: bytes, size: int, compression: int) -> UInt8:
    """Return the `size` bytes of a block, which is stored as is if compression didn't help."""
    if compression == 0 or len(data) == size:
        if len(data) != size:
            raise _damaged("a block has the wrong size")
        return np.frombuffer(data, np.uint8)
    try:
        raw = zlib.decompressobj().decompress(data, size + 1)
    except zlib.error as error:
        raise _damaged("a block can't be decompressed") from error
    if len(raw) != size:
        raise _damaged("a block decompresses to the wrong size")
    differences = np.frombuffer(raw, np.uint8).copy()
    differences[1:] += np.uint8(128)
    values = np.cumsum(differences, dtype=np.uint8)
    out = np.empty(size, np.uint8)
    half = (size + 1) // 2
    out[0::2], out[1::2] = values[:half], values[half:]
    return out


def _header(data: bytes) -> _Header:
    if not data.startswith(MAGIC):
        raise InputError("is empty" if not data else "is not an OpenEXR image")
    (version,) = _unpack("<I", data, 4)
    if version & ~_LONG_NAMES != _SINGLE_SCAN_LINES:
        raise InputError(
            "is an OpenEXR image of tiles or several parts",
            remedy="write it as scan lines of one part",
        )
    offset = 8
    attributes: dict[str, bytes] = {}
    while data[offset : offset + 1] != b"\0":
        name, offset = _name(data, offset)
        _, offset = _name(data, offset)
        (size,) = _unpack("<I", data, offset)
        offset += 4
        attributes[name] = data[offset : offset + size]
        if len(attributes[name]) < size:
            raise InputError("is cut off within its header")
        offset += size
    offset += 1
    missing = [n for n in ("channels", "compression", "dataWindow") if n not in attributes]
    if missing:
        raise _damaged(f"no {missing[0]}")
    (compression,) = _unpack("<B", attributes["compression"], 0)
    if compression not in _LINES:
        kind = _COMPRESSIONS[compression] if compression < len(_COMPRESSIONS) else str(compression)
        raise InputError(f"is compressed by {kind}", remedy="write it with ZIP, ZIPS or none")
    left, top, right, bottom = _unpack("<4i", attributes["dataWindow"], 0)
    width, height = right - left + 1, bottom - top + 1
    check_pixels(width, height)
    return _Header(width, height, top, compression, _channels(attributes["channels"]), offset)


def _channels(data: bytes) -> dict[str, np.dtype[Any]]:
    out: dict[str, np.dtype[Any]] = {}
    offset = 0
    while data[offset : offset + 1] != b"\0":
        name, offset = _name(data, offset)
        kind, _, x_sampling, y_sampling = _unpack("<4I", data, offset)
        offset += 16
        if kind >= len(_TYPES) or x_sampling != 1 or y_sampling != 1 or name in out:
            raise _damaged(f"channel {name!r:.40} can't be read")
        out[name] = _TYPES[kind]
        if len(out) > _MAX_CHANNELS:
            raise _damaged("too many channels")
    if not out:
        raise _damaged("no channels")
    return out


def _name(data: bytes, offset: int) -> tuple[str, int]:
    end = data.find(b"\0", offset, offset + 256)
    if end <= offset:
        raise _damaged("its header is invalid")
    return data[offset:end].decode("latin-1"), end + 1


def _unpack(layout: str, data: bytes, offset: int) -> tuple[int, ...]:
    if offset < 0 or offset + struct.calcsize(layout) > len(data):
        raise InputError("is cut off")
    return struct.unpack_from(layout, data, offset)


def _damaged(reason: str) -> InputError:
    return InputError(f"is a damaged OpenEXR image ({reason})")
