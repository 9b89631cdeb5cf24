"""PCIC streams of ifm's cameras: frames, each of chunks between "star" and "stop".

Each chunk has a header of little-endian words (kind, size, header size, version, width, height,
pixel format, timestamp in us, frame, status, seconds, nanoseconds), followed by JSON since version
3.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.errors import InputError

BEGIN, END = b"star", b"stop"
_HEAD = 36
_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<u8", "<f8")
_MAX_SIDE = 8192
_MAX_FRAMES = 1 << 20


@dataclass(frozen=True)
class Chunk:
    """One chunk of a frame: its header, and the range of its bytes in the stream."""

    kind: int
    width: int
    height: int
    format: int
    time_us: int
    seconds: int
    nanoseconds: int
    metadata: dict[str, Any]
    start: int
    end: int

    @property
    def time(self) -> float:
        """Timestamp in s of the camera's clock."""
        if self.seconds or self.nanoseconds:
            return self.seconds + self.nanoseconds / 1e9
        return self.time_us / 1e6


def pcic_frames(data: bytes, path: str | Path) -> list[dict[int, Chunk] | InputError]:
    """Find the frames of a stream: for each its chunks by kind, or the error if it is damaged.

    Raises
    ------
    InputError
        If there are no frames.
    """
    frames: list[dict[int, Chunk] | InputError] = []
    offset = data.find(BEGIN)
    while offset >= 0 and len(frames) < _MAX_FRAMES:
        offset += len(BEGIN)
        try:
            chunks, offset = _chunks(data, offset, f"{path}: frame {len(frames)}")
            frames.append(chunks)
        except InputError as error:
            frames.append(error)
        offset = data.find(BEGIN, offset)
    if not frames:
        raise InputError("is not a PCIC stream", where=path, remedy="check the file")
    return frames


def _chunks(data: bytes, offset: int, where: str) -> tuple[dict[int, Chunk], int]:
    chunks: dict[int, Chunk] = {}
    while data[offset : offset + 4] != END:
        if offset + _HEAD > len(data):
            raise InputError("is cut off", where=where, remedy="copy the file again")
        words = struct.unpack_from("<9I", data, offset)
        kind, size, header_size, version, width, height, format_, time_us = words[:8]
        if not _HEAD <= header_size <= size or offset + size > len(data):
            raise InputError(f"is cut off or damaged in chunk {kind}", where=where)
        seconds = nanoseconds = 0
        metadata: dict[str, Any] = {}
        if version >= 2 and header_size >= 48:
            seconds, nanoseconds = struct.unpack_from("<2I", data, offset + 40)
        if version >= 3 and header_size > 48:
            metadata = _json(data[offset + 48 : offset + header_size])
        chunks[kind] = Chunk(
            kind,
            width,
            height,
            format_,
            time_us,
            seconds,
            nanoseconds,
            metadata,
            offset + header_size,
            offset + size,
        )
        offset += size
    return chunks, offset + 4


def _json(data: bytes) -> dict[str, Any]:
    try:
        metadata = json.loads(data.split(b"\0", 1)[0])
    except (ValueError, RecursionError):
        return {}
    return metadata if isinstance(metadata, dict) else {}


def chunk_image(data: bytes, chunk: Chunk, where: str) -> NDArray[Any]:
    """Return the image (H, W) of a chunk, which may be followed by other bytes.

    Raises
    ------
    InputError
        If it is not an image, or is cut off.
    """
    if chunk.format >= len(_TYPES) or not (
        1 <= chunk.width <= _MAX_SIDE and 1 <= chunk.height <= _MAX_SIDE
    ):
        raise InputError(
            f"chunk {chunk.kind} is not an image ({chunk.width} x {chunk.height}, "
            f"format {chunk.format})",
            where=where,
        )
    kind = np.dtype(_TYPES[chunk.format])
    count = chunk.width * chunk.height
    if chunk.end - chunk.start < count * kind.itemsize:
        raise InputError(f"chunk {chunk.kind} is cut off", where=where, remedy="copy it again")
    return np.frombuffer(data, kind, count, chunk.start).reshape(chunk.height, chunk.width)
