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

from tofuse.errors import InputError

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
    about: dict[str, Any]
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
    at = data.find(BEGIN)
    while at >= 0 and len(frames) < _MAX_FRAMES:
        at += len(BEGIN)
        try:
            chunks, at = _chunks(data, at, f"{path}: frame {len(frames)}")
            frames.append(chunks)
        except InputError as error:
            frames.append(error)
        at = data.find(BEGIN, at)
    if not frames:
        raise InputError("is not a PCIC stream", where=path, remedy="check the file")
    return frames


def _chunks(data: bytes, at: int, where: str) -> tuple[dict[int, Chunk], int]:
    chunks: dict[int, Chunk] = {}
    while data[at : at + 4] != END:
        if at + _HEAD > len(data):
            raise InputError("is cut off", where=where, remedy="copy the file again")
        words = struct.unpack_from("<9I", data, at)
        kind, size, head, version, width, height, format_, time_us = words[:8]
        if not _HEAD <= head <= size or at + size > len(data):
            raise InputError(f"is cut off or damaged in chunk {kind}", where=where)
        seconds = nanoseconds = 0
        about: dict[str, Any] = {}
        if version >= 2 and head >= 48:
            seconds, nanoseconds = struct.unpack_from("<2I", data, at + 40)
        if version >= 3 and head > 48:
            about = _json(data[at + 48 : at + head])
        chunks[kind] = Chunk(
            kind,
            width,
            height,
            format_,
            time_us,
            seconds,
            nanoseconds,
            about,
            at + head,
            at + size,
        )
        at += size
    return chunks, at + 4


def _json(data: bytes) -> dict[str, Any]:
    try:
        about = json.loads(data.split(b"\0", 1)[0])
    except (ValueError, RecursionError):
        return {}
    return about if isinstance(about, dict) else {}


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
