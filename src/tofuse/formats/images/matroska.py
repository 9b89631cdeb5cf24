"""The part of Matroska that camera recordings use: tracks, blocks, attachments, tags.

Follows RFC 8794 (EBML) and RFC 9559 (Matroska). Only the headers of elements are read when a file
is opened; blocks are read on demand. A truncated file is used up to its end.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tofuse.engine.errors import InputError
from tofuse.formats.files import reading

MAGIC = b"\x1a\x45\xdf\xa3"

_SEGMENT, _CLUSTER = 0x18538067, 0x1F43B675
_INFO, _TRACKS, _TAGS, _ATTACHMENTS = 0x1549A966, 0x1654AE6B, 0x1254C367, 0x1941A469
_TOP_LEVEL = {_INFO, _TRACKS, _TAGS, _ATTACHMENTS, _CLUSTER, 0x114D9B74, 0x1C53BB6B, 0x1043A770}
_TRACK, _VIDEO, _TAG, _SIMPLE_TAG, _FILE = 0xAE, 0xE0, 0x7373, 0x67C8, 0x61A7
_BLOCK_GROUP, _BLOCK, _SIMPLE_BLOCK, _TIME = 0xA0, 0xA1, 0xA3, 0xE7
_LACED = 0x06

_MAX_VALUE = 64 << 20  # bytes of an element that is read into memory
_MAX_BLOCK = 256 << 20
_MAX_BLOCKS = 20_000_000


@dataclass(frozen=True)
class Block:
    """One frame of a track: its time, and the range of its bytes in the file."""

    time_ns: int
    offset: int
    size: int
    laced: bool


@dataclass
class Track:
    """One track and its blocks in file order.

    `private` is the codec's private data; `duration_ns` is that of a frame, 0 where not given.
    """

    number: int
    name: str = ""
    private: bytes = b""
    width: int = 0
    height: int = 0
    duration_ns: int = 0
    blocks: list[Block] = field(default_factory=list)


class Matroska:
    """An open Matroska file.

    Attributes
    ----------
    tracks
        In file order.
    tags, attachments
        By name.
    complete
        False if the file was cut off within an element; what precedes is used.

    Raises
    ------
    InputError
        If it can't be read or is not a Matroska file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tracks: list[Track] = []
        self.tags: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.complete = True
        self._scale_ns = 1_000_000
        self._blocks = 0
        self._resume = 0
        with reading.readable(path), path.open("rb") as self._file:
            self._size = os.fstat(self._file.fileno()).st_size
            if self._read_at(0, 4) != MAGIC:
                raise InputError("is not a Matroska file", where=path, remedy="check the file")
            self._parse()

    def read(self, block: Block) -> bytes:
        """Return the bytes of a block; InputError if it is cut off, or laced (several frames)."""
        if block.laced or block.size > _MAX_BLOCK:
            raise InputError(
                f"has a block at byte {block.offset} that isn't a single frame", where=self.path
            )
        data = reading.read_part(self.path, block.offset, block.size)
        if len(data) < block.size:
            raise InputError("is cut off", where=self.path, remedy="copy the file again")
        return data

    def _read_at(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)

    def _parse(self) -> None:
        for kind, start, end, _ in self._elements(0, self._size):
            if kind != _SEGMENT:
                continue
            for top, begin, stop, sized in self._elements(start, end):
                if top == _CLUSTER:
                    self._cluster(begin, stop, sized)
                elif top == _INFO:
                    self._scale_ns = self._numbers(begin, stop).get(0x2AD7B1, 1_000_000)
                elif top == _TRACKS:
                    self._for_each(_TRACK, begin, stop, self._track)
                elif top == _TAGS:
                    self._for_each(_TAG, begin, stop, self._tag)
                elif top == _ATTACHMENTS:
                    self._for_each(_FILE, begin, stop, self._attachment)

    def _elements(self, offset: int, end: int) -> Iterator[tuple[int, int, int, bool]]:
        """Yield each element's number, begin, end, and whether its size is known."""
        while offset < end:
            head = self._read_at(offset, 12)
            kind, first = _variable(head, 0, keep_marker=True)
            size, second = _variable(head, first)
            if not first or not second or kind == 0:
                self.complete = False
                return
            begin = offset + second
            if begin > end:  # a header that doesn't fit into its parent
                self.complete = False
                return
            sized = size != (1 << 7 * (second - first)) - 1
            stop = begin + size if sized else end
            if stop > end:
                # The file was cut off, or an element declares too large a size.
                self.complete = False
                stop = end
            yield kind, begin, stop, sized
            offset = self._resume if not sized and kind == _CLUSTER else stop

    def _cluster(self, begin: int, end: int, sized: bool) -> None:
        time = 0
        self._resume = end
        for kind, start, stop, _ in self._elements(begin, end):
            if not sized and kind in _TOP_LEVEL:
                # A cluster of unknown size ends where the next element of its parent begins.
                self._resume = self._header_offset(start, kind)
                return
            if kind == _TIME:
                time = _unsigned(self._read_at(start, min(stop - start, 8)))
            elif kind == _SIMPLE_BLOCK:
                self._block(start, stop, time)
            elif kind == _BLOCK_GROUP:
                for inner, first, last, _ in self._elements(start, stop):
                    if inner == _BLOCK:
                        self._block(first, last, time)

    def _header_offset(self, start: int, kind: int) -> int:
        """Return the offset of the header of an element whose content begins at `start`."""
        name = kind.to_bytes(4, "big")
        head = self._read_at(max(start - 12, 0), min(start, 12))
        return max(start - 12, 0) + head.rfind(name)

    def _block(self, start: int, stop: int, time: int) -> None:
        head = self._read_at(start, 11)
        number, position = _variable(head, 0)
        if not position or len(head) < position + 3 or stop < start + position + 3:
            self.complete = False
            return
        (relative,) = struct.unpack_from(">h", head, position)
        track = next((t for t in self.tracks if t.number == number), None)
        self._blocks += 1
        if track is None or self._blocks > _MAX_BLOCKS:
            return
        offset = start + position + 3
        laced = bool(head[position + 2] & _LACED)
        time_ns = (time + relative) * self._scale_ns
        track.blocks.append(Block(time_ns, offset, stop - offset, laced))

    def _for_each(self, target: int, begin: int, end: int, handle: object) -> None:
        for kind, start, stop, _ in self._elements(begin, end):
            if kind == target:
                handle(start, stop)  # type: ignore[operator]

    def _values(self, begin: int, end: int) -> dict[int, bytes]:
        """The bytes of each element between two offsets, except of very large ones."""
        return {
            kind: self._read_at(start, stop - start)
            for kind, start, stop, _ in self._elements(begin, end)
            if stop - start <= _MAX_VALUE
        }

    def _numbers(self, begin: int, end: int) -> dict[int, int]:
        values = self._values(begin, end)
        return {kind: _unsigned(data) for kind, data in values.items() if 0 < len(data) <= 8}

    def _track(self, begin: int, end: int) -> None:
        values, numbers = self._values(begin, end), self._numbers(begin, end)
        track = Track(
            numbers.get(0xD7, 0),
            _text(values.get(0x536E, b"")),
            values.get(0x63A2, b""),
            duration_ns=numbers.get(0x23E383, 0),
        )
        for kind, start, stop, _ in self._elements(begin, end):
            if kind == _VIDEO:
                sizes = self._numbers(start, stop)
                track.width, track.height = sizes.get(0xB0, 0), sizes.get(0xBA, 0)
        self.tracks.append(track)

    def _tag(self, begin: int, end: int) -> None:
        for kind, start, stop, _ in self._elements(begin, end):
            if kind == _SIMPLE_TAG:
                values = self._values(start, stop)
                self.tags[_text(values.get(0x45A3, b""))] = _text(values.get(0x4487, b""))

    def _attachment(self, begin: int, end: int) -> None:
        values = self._values(begin, end)
        self.attachments[_text(values.get(0x466E, b""))] = values.get(0x465C, b"")


def _variable(data: bytes, offset: int, *, keep_marker: bool = False) -> tuple[int, int]:
    """Return a variable-length integer and the position after it; 0, 0 if there is none.

    `keep_marker` leaves the length marker in it, as in element numbers.
    """
    if offset >= len(data) or data[offset] == 0:
        return 0, 0
    length = 9 - data[offset].bit_length()
    if offset + length > len(data):
        return 0, 0
    value = int.from_bytes(data[offset : offset + length], "big")
    return value if keep_marker else value & ((1 << 7 * length) - 1), offset + length


def _unsigned(data: bytes) -> int:
    return int.from_bytes(data, "big")


def _text(data: bytes) -> str:
    return data.split(b"\0", 1)[0].decode("utf-8", "replace")
