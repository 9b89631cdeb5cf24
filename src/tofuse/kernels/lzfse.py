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
    """Return the first value of each symbol, which follows the last one of the symbol before."""
    return np.concatenate([[0], np.cumsum(1 << bits)[:-1]]).astype(np.int64)


_RUN_BASE, _COPY_BASE, _DISTANCE_BASE = map(_bases, (_RUN_BITS, _COPY_BITS, _DISTANCE_BITS))
_LITERAL_BASE = np.arange(256, dtype=np.int64)


@kernel
def _fill_table(
    counts: Int64,
    symbol_bits: Int64,
    symbol_base: Int64,
    state_bits: Int64,
    deltas: Int64,
    value_bits: Int64,
    value_base: Int64,
) -> bool:
    """Fill a decoding table, given the number of states of each symbol; False if too many."""
    states = state_bits.size
    index = 0
    for symbol in range(counts.size):
        count = counts[symbol]
        if count == 0:
            continue
        if index + count > states:
            return False
        shift = 0
        while count << shift < states:
            shift += 1
        threshold = ((2 * states) >> shift) - count
        for j in range(count):
            if j < threshold:
                state_bits[index] = shift
                deltas[index] = ((count + j) << shift) - states
            else:
                state_bits[index] = shift - 1
                deltas[index] = (j - threshold) << (shift - 1)
            value_bits[index] = symbol_bits[symbol]
            value_base[index] = symbol_base[symbol]
            index += 1
    # States without a symbol are never reached in a valid stream.
    for k in range(index, states):
        state_bits[k] = -1
    return True


@kernel
def _read_bits(source: UInt8, position: int, count: int) -> int:
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
        Numbers of literals and copies.
    counts
        (360,) number of states of each symbol: 20 runs, 20 lengths, 64 distances, 256 literals.

    Returns the position after the last byte written, or -1 if the block is damaged.
    """
    state_bits = np.empty(1024, np.int64)
    deltas = np.empty(1024, np.int64)
    value_bits = np.empty(1024, np.int64)
    value_base = np.empty(1024, np.int64)
    if not _fill_table(
        counts[104:], _NO_BITS, _LITERAL_BASE, state_bits, deltas, value_bits, value_base
    ):
        return -1
    literals = np.empty(literal_count + 4, np.uint8)
    states = literal_states.copy()
    position = 8 * literal_stream.size - literal_skip
    for k in range(literal_count):
        state = states[k & 3]
        bits = state_bits[state]
        if bits < 0 or position < bits:
            return -1
        position -= bits
        literals[k] = value_base[state]
        states[k & 3] = deltas[state] + _read_bits(literal_stream, position, bits)

    for k in range(3):
        size = 256 if k == 2 else 64
        begin = 256 * k
        symbols = counts[:20] if k == 0 else (counts[20:40] if k == 1 else counts[40:104])
        symbol_bits = _RUN_BITS if k == 0 else (_COPY_BITS if k == 1 else _DISTANCE_BITS)
        symbol_base = _RUN_BASE if k == 0 else (_COPY_BASE if k == 1 else _DISTANCE_BASE)
        if not _fill_table(
            symbols,
            symbol_bits,
            symbol_base,
            state_bits[begin : begin + size],
            deltas[begin : begin + size],
            value_bits[begin : begin + size],
            value_base[begin : begin + size],
        ):
            return -1
    copy_state = copy_states.copy()
    values = np.zeros(3, np.int64)
    position = 8 * copy_stream.size - copy_skip
    o = start
    literal = 0
    distance = np.int64(0)
    for _ in range(copy_count):
        for k in range(3):
            index = 256 * k + copy_state[k]
            bits = state_bits[index]
            if bits < 0 or position < bits + value_bits[index]:
                return -1
            position -= bits + value_bits[index]
            value = _read_bits(copy_stream, position, bits + value_bits[index])
            copy_state[k] = deltas[index] + (value >> value_bits[index])
            values[k] = value_base[index] + (value & ((np.int64(1) << value_bits[index]) - 1))
        run, length = values[0], values[1]
        if values[2] > 0:
            distance = values[2]
        if literal + run > literal_count or o + run + length > out.size:
            return -1
        for _ in range(run):
            out[o] = literals[literal]
            o += 1
            literal += 1
        if length > 0 and (distance <= 0 or distance > o):
            return -1
        # Byte by byte: the copy may overlap what it writes.
        for _ in range(length):
            out[o] = out[o - distance]
            o += 1
    return o
