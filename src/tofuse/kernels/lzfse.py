"""One block of LZFSE (Apple's codec): entropy-coded literals and copies.

Follows the block format of Apple's reference, github.com/lzfse/lzfse: values are coded by
tabled asymmetric numeral systems (Duda 2013), and the bit streams are read from their end.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Int64, UInt8
from tofuse.kernels.jit import kernel

# States of the four tables: literal runs, copy lengths, distances, literals.
STATES = (64, 64, 256, 1024)

_RUN_BITS = np.array([0] * 16 + [2, 3, 5, 8], np.int64)
_COPY_BITS = np.array([0] * 16 + [3, 5, 8, 11], np.int64)
_DISTANCE_BITS = np.repeat(np.arange(16, dtype=np.int64), 4)
_NO_BITS = np.zeros(256, np.int64)


def _bases(bits: Int64) -> Int64:
    """Each symbol's values follow those of the symbol before."""
    return np.concatenate([[0], np.cumsum(1 << bits)[:-1]]).astype(np.int64)


_RUN_BASE, _COPY_BASE, _DISTANCE_BASE = map(_bases, (_RUN_BITS, _COPY_BITS, _DISTANCE_BITS))
_LITERAL_BASE = np.arange(256, dtype=np.int64)


@kernel
def _table(
    counts: Int64,
    extra: Int64,
    base: Int64,
    shifts: Int64,
    deltas: Int64,
    more: Int64,
    least: Int64,
) -> bool:
    """Fill a decoder's table from how many of its states each symbol has; False if too many."""
    states = shifts.size
    at = 0
    for symbol in range(counts.size):
        count = counts[symbol]
        if count == 0:
            continue
        if at + count > states:
            return False
        shift = 0
        while count << shift < states:
            shift += 1
        low = ((2 * states) >> shift) - count
        for j in range(count):
            if j < low:
                shifts[at] = shift
                deltas[at] = ((count + j) << shift) - states
            else:
                shifts[at] = shift - 1
                deltas[at] = (j - low) << (shift - 1)
            more[at] = extra[symbol]
            least[at] = base[symbol]
            at += 1
    # States that no symbol has are never reached in a sound stream.
    for k in range(at, states):
        shifts[k] = -1
    return True


@kernel
def _bits(source: UInt8, position: int, count: int) -> int:
    """Return `count` bits below 40 from a bit position on, the least significant first."""
    value = np.int64(0)
    first = position >> 3
    last = (position + count + 7) >> 3
    for k in range(first, last):
        value |= np.int64(source[k]) << ((k - first) << 3)
    return int((value >> (position & 7)) & ((1 << count) - 1))


@kernel
def lzfse_block(
    literal_stream: UInt8,
    literal_skip: int,
    literal_states: Int64,
    literal_count: int,
    copy_stream: UInt8,
    copy_skip: int,
    copy_states: Int64,
    copy_count: int,
    counts: Int64,
    out: UInt8,
    start: int,
) -> int:
    """Decode one block into `out` (M,) from `start` on.

    Parameters
    ----------
    literal_stream, copy_stream
        Bytes of the two bit streams.
    literal_skip, copy_skip
        Unused bits at the end of each, 0 to 7.
    literal_states
        (4,) first states of the interleaved literals.
    copy_states
        (3,) first states of literal runs, copy lengths and distances.
    literal_count, copy_count
        How many literals and copies there are.
    counts
        (360,) states of each symbol: 20 runs, 20 lengths, 64 distances, 256 literals.

    Returns the position after the last byte written, or -1 if the block is damaged.
    """
    shifts = np.empty(1024, np.int64)
    deltas = np.empty(1024, np.int64)
    more = np.empty(1024, np.int64)
    least = np.empty(1024, np.int64)
    if not _table(counts[104:], _NO_BITS, _LITERAL_BASE, shifts, deltas, more, least):
        return -1
    literals = np.empty(literal_count + 4, np.uint8)
    states = literal_states.copy()
    position = 8 * literal_stream.size - literal_skip
    for k in range(literal_count):
        state = states[k & 3]
        shift = shifts[state]
        if shift < 0 or position < shift:
            return -1
        position -= shift
        literals[k] = least[state]
        states[k & 3] = deltas[state] + _bits(literal_stream, position, shift)

    for k in range(3):
        size = 256 if k == 2 else 64
        begin = 256 * k
        symbols = counts[:20] if k == 0 else (counts[20:40] if k == 1 else counts[40:104])
        extra = _RUN_BITS if k == 0 else (_COPY_BITS if k == 1 else _DISTANCE_BITS)
        base = _RUN_BASE if k == 0 else (_COPY_BASE if k == 1 else _DISTANCE_BASE)
        if not _table(
            symbols,
            extra,
            base,
            shifts[begin : begin + size],
            deltas[begin : begin + size],
            more[begin : begin + size],
            least[begin : begin + size],
        ):
            return -1
    now = copy_states.copy()
    values = np.zeros(3, np.int64)
    position = 8 * copy_stream.size - copy_skip
    o = start
    used = 0
    distance = np.int64(0)
    for _ in range(copy_count):
        for k in range(3):
            at = 256 * k + now[k]
            shift = shifts[at]
            if shift < 0 or position < shift + more[at]:
                return -1
            position -= shift + more[at]
            value = _bits(copy_stream, position, shift + more[at])
            now[k] = deltas[at] + (value >> more[at])
            values[k] = least[at] + (value & ((np.int64(1) << more[at]) - 1))
        run, length = values[0], values[1]
        if values[2] > 0:
            distance = values[2]
        if used + run > literal_count or o + run + length > out.size:
            return -1
        for _ in range(run):
            out[o] = literals[used]
            o += 1
            used += 1
        if length > 0 and (distance <= 0 or distance > o):
            return -1
        # Byte by byte: the copy may overlap what it writes.
        for _ in range(length):
            out[o] = out[o - distance]
            o += 1
    return o
