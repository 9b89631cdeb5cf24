"""LZFSE streams (Apple's codec), in which Record3D stores depth.

The layout is that of Apple's reference implementation, github.com/lzfse/lzfse: blocks, each of
which begins with four bytes that identify its kind. Implemented here, as there are no wheels of a
decoder for Linux.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from tofuse.arrays import Int64, UInt8
from tofuse.errors import InputError

_END, _RAW, _TABLED, _PACKED, _SMALL = b"bvx$", b"bvx-", b"bvx1", b"bvx2", b"bvxn"
_HEADER = 32
_SYMBOLS = 360

# A symbol's count has 2 to 14 bits; the lowest five determine their number.
_TWO = {0b00: 0, 0b10: 1}
_THREE = {0b001: 2, 0b101: 3}
_FIVE = {0b00011: 4, 0b01011: 5, 0b10011: 6, 0b11011: 7}


def lzfse_decompress(data: bytes, size: int, path: str | Path) -> bytes:
    """Decompress a stream of exactly `size` bytes; `path` names it in errors.

    Raises
    ------
    InputError
        If it is damaged, cut off, of another size, or contains unsupported blocks.
    """
    out = np.empty(size, np.uint8)
    offset = done = 0
    while True:
        kind = data[offset : offset + 4]
        if kind == _END:
            break
        if kind not in (_RAW, _PACKED):
            names = {_TABLED: "uncompressed tables", _SMALL: "LZVN"}
            problem = (
                f"uses {names[kind]}, which is not supported" if kind in names else "is damaged"
            )
            raise InputError(f"{problem} (LZFSE)", where=path, remedy="export the recording again")
        (count,) = _unpack("<I", data, offset + 4, path)
        if done + count > size:
            raise _damaged(path)
        if kind == _RAW:
            block = np.frombuffer(data[offset + 8 : offset + 8 + count], np.uint8)
            if len(block) < count:
                raise _damaged(path)
            out[done : done + count] = block
            offset += 8 + count
        else:
            offset = _packed(data, offset, out[: done + count], done, path)
        done += count
    if done != size:
        raise InputError(
            f"decompresses to {done} bytes, not {size}", where=path, remedy="copy it again"
        )
    return out.tobytes()


def _packed(data: bytes, offset: int, out: UInt8, done: int, path: str | Path) -> int:
    """Decode a block with packed tables to the end of `out`; return the next block's offset."""
    from tofuse.kernels.lzfse import STATES, lzfse_block

    _, _, first, second, third = _unpack("<4sIQQQ", data, offset, path)

    def field(word: int, shift: int, bits: int) -> int:
        return int(word) >> shift & ((1 << bits) - 1)

    literal_bytes, copy_bytes = field(first, 20, 20), field(second, 40, 20)
    literal_skip, copy_skip = 7 - field(first, 60, 3), 7 - field(second, 60, 3)
    header = field(third, 0, 32)
    literal_states = np.array([field(second, 10 * k, 10) for k in range(4)], np.int64)
    copy_states = np.array([field(third, 32 + 10 * k, 10) for k in range(3)], np.int64)
    end = offset + header + literal_bytes + copy_bytes
    if (
        header < _HEADER
        or end > len(data)
        or (copy_states >= STATES[:3]).any()
        or literal_skip > 8 * literal_bytes
        or copy_skip > 8 * copy_bytes
    ):
        raise _damaged(path)
    counts = _counts(data[offset + _HEADER : offset + header], path)
    payload = np.frombuffer(data, np.uint8, literal_bytes + copy_bytes, offset + header)
    stop = lzfse_block(
        payload[:literal_bytes],
        literal_skip,
        literal_states,
        field(first, 0, 20),
        payload[literal_bytes:],
        copy_skip,
        copy_states,
        field(first, 40, 20),
        counts,
        out,
        done,
    )
    if stop != len(out):
        raise _damaged(path)
    return end


def _counts(data: bytes, path: str | Path) -> Int64:
    """Unpack the number of states of each of the 360 symbols."""
    bits, remaining = int.from_bytes(data, "little"), 8 * len(data)
    out = np.zeros(_SYMBOLS, np.int64)
    for k in range(_SYMBOLS if data else 0):
        if bits & 3 in _TWO:
            used, out[k] = 2, _TWO[bits & 3]
        elif bits & 7 in _THREE:
            used, out[k] = 3, _THREE[bits & 7]
        elif bits & 31 in _FIVE:
            used, out[k] = 5, _FIVE[bits & 31]
        elif bits & 15 == 7:
            used, out[k] = 8, 8 + (bits >> 4 & 15)
        else:
            used, out[k] = 14, 24 + (bits >> 4 & 1023)
        bits >>= used
        remaining -= used
        if remaining < 0:
            raise _damaged(path)
    return out


def _unpack(layout: str, data: bytes, offset: int, path: str | Path) -> tuple[int, ...]:
    if offset + struct.calcsize(layout) > len(data):
        raise _damaged(path)
    return struct.unpack_from(layout, data, offset)


def _damaged(path: str | Path) -> InputError:
    return InputError("is a damaged or cut off LZFSE stream", where=path, remedy="copy it again")
