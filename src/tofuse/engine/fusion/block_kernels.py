"""Sparse blocks of voxels, identified by keys in open-addressed hash tables (Nießner et al. 2013).

Space is divided into blocks of 8 x 8 x 8 voxels, of which only those near surfaces are stored. A
block has a 63-bit key; tables use linear probing. The voxels of each octant (4 x 4 x 4) of a block
are contiguous in memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float32, Int32, Int64, UInt8, UInt16
from tofuse.engine.compute import kernel

EDGE = 8  # voxels along the edge of a block
VOXELS = EDGE**3
EMPTY = -1  # empty slot of a table
HALF = 1 << 20  # block indices are from -HALF to HALF - 1
_MASK = (1 << 21) - 1


class Blocks(NamedTuple):
    """B blocks of voxels with signed distances.

    Attributes
    ----------
    keys, numbers
        (B,) of the blocks, and their global numbers, which do not depend on the blocks in memory.
    distance, weight
        (B, VOXELS) mean distance in m, and sum of the weights in 1/m^2.
    view_count
        (B, VOXELS) number of views whose surface is within the truncation distance.
    color, color_count
        (B, VOXELS, C) mean colour or amplitude over those of these views that have one, and (B,
        VOXELS) their number; C may be 0, and then there is no number.
    free_weight
        (B, 8) weight of free-space observations of whole octants, not yet in `distance`.
    """

    keys: Int64
    numbers: Int64
    distance: Float32
    weight: Float32
    view_count: UInt16
    color: Float32
    color_count: UInt16
    free_weight: Float32


@kernel
def block_key(i: int, j: int, k: int) -> int:
    """Return the key of the block (i, j, k), each from -2^20 to 2^20 - 1."""
    return ((i + HALF) << 42) | ((j + HALF) << 21) | (k + HALF)


@kernel
def block_of(key: int) -> tuple[int, int, int]:
    """Return the block (i, j, k) of a key."""
    return (key >> 42) - HALF, ((key >> 21) & _MASK) - HALF, (key & _MASK) - HALF


@kernel
def slot_of(table: Int64, key: int) -> int:
    """Return the slot of `key` in the table (2^n,), or the empty slot for it."""
    # Fibonacci hashing: the upper bits of the product depend on all bits of the key.
    hashed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    mask = len(table) - 1
    slot = np.int64(hashed >> np.uint64(32)) & mask
    while table[slot] != EMPTY and table[slot] != key:
        slot = (slot + 1) & mask
    return int(slot)


@kernel
def _enlarged(table: Int64) -> Int64:
    larger = np.full(2 * len(table), EMPTY, np.int64)
    for key in table:
        if key != EMPTY:
            larger[slot_of(larger, key)] = key
    return larger


@kernel
def voxel_index(i: int, j: int, k: int) -> int:
    """Return the index within its block of the voxel (i, j, k), each from 0 to 7."""
    octant = (i & 4) << 6 | (j & 4) << 5 | (k & 4) << 4
    return int(octant | (i & 3) << 4 | (j & 3) << 2 | (k & 3))


@kernel
def voxel_of(number: int) -> tuple[int, int, int]:
    """Return the voxel (i, j, k) of an index within its block."""
    i = (number >> 6) & 4 | (number >> 4) & 3
    j = (number >> 5) & 4 | (number >> 2) & 3
    k = (number >> 4) & 4 | number & 3
    return i, j, k


@kernel
def insert_keys(table: Int64, count: int, keys: Int64) -> tuple[Int64, int]:
    """Insert keys; return the table, replaced by a larger one if necessary, and its new count."""
    for key in keys:
        slot = slot_of(table, key)
        if table[slot] == EMPTY:
            table[slot] = key
            count += 1
            if 2 * count > len(table):
                table = _enlarged(table)
    return table, count


@kernel
def parent_of(key: int) -> tuple[int, int]:
    """Return the key of the block that contains a cube of half its size, and the cube's octant."""
    i, j, k = block_of(key)
    return block_key(i >> 1, j >> 1, k >> 1), (i & 1) << 2 | (j & 1) << 1 | (k & 1)


@kernel
def index_of(keys: Int64) -> tuple[Int64, Int32]:
    """Return a hash table of distinct keys (B,), and the row of the key in each of its slots."""
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, EMPTY, np.int64)
    rows = np.full(size, -1, np.int32)
    for b in range(len(keys)):
        slot = slot_of(table, keys[b])
        table[slot] = keys[b]
        rows[slot] = b
    return table, rows


@kernel
def mark_octants(cubes: Int64, table: Int64, rows: Int32, masks: UInt8) -> None:
    """Set the bits in `masks` (B,) of the octants of blocks that are among the given cubes.

    `table` and `rows` are those of `index_of`; cubes of other blocks are ignored.
    """
    for cube in cubes:
        key, octant = parent_of(cube)
        slot = slot_of(table, key)
        if table[slot] == key:
            masks[rows[slot]] |= np.uint8(1 << octant)


@kernel
def neighbours_of(keys: Int64, out: Int32) -> None:
    """Write the rows of the 3 x 3 x 3 blocks around each block, itself included; -1 if missing.

    `keys` (B,) are distinct. Column 9 a + 3 b + c of `out` (B, 27) is the block at the offset
    (a - 1, b - 1, c - 1).
    """
    table, rows = index_of(keys)
    for b in range(len(keys)):
        i, j, k = block_of(keys[b])
        for n in range(27):
            key = block_key(i + n // 9 - 1, j + n // 3 % 3 - 1, k + n % 3 - 1)
            slot = slot_of(table, key)
            out[b, n] = rows[slot] if table[slot] == key else -1
