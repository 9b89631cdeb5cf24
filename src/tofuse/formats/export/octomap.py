"""Octrees of OctoMap: binary files (``.bt``) of free and occupied voxels.

After a header in text, the inner nodes follow in depth-first order, two bytes each with two bits
per child: 0 unknown, 1 free, 2 occupied, 3 an inner node. Child k is in the upper half of x, y, z
where bit 0, 1, 2 of k is set. Eight equal children are one leaf.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Bool, Int64, Intp, UInt8
from tofuse.engine.errors import InputError
from tofuse.formats.files import atomic

_DEPTH = 16  # levels of an octree of OctoMap
_CENTER = 1 << _DEPTH - 1  # key of the voxel that begins at the origin
_FREE, _OCCUPIED, _INNER = 1, 2, 3


def write_octomap(
    path: str | Path, free: Bool, occupied: Bool, first: Intp, voxel_m: float
) -> None:
    """Write a grid as an octree.

    Parameters
    ----------
    path
        The file.
    free, occupied
        (X, Y, Z) masks.
    first
        (3,) index of the first voxel: voxel i covers i to i + 1 voxel sizes along each axis.
    voxel_m
        Voxel size, m.

    Raises
    ------
    InputError
        If the grid is larger than an octree can be.
    OutputError
        If the file can't be written.
    """
    known = free | occupied
    keys = np.argwhere(known) + first + _CENTER
    if keys.size and not ((keys >= 0) & (keys < 2 * _CENTER)).all():
        raise InputError(
            f"is more than {_CENTER} voxels from the origin", where=path, remedy="use larger voxels"
        )
    states = np.where(occupied[known], _OCCUPIED, _FREE).astype(np.uint8)
    codes = _interleaved(keys)
    order = np.argsort(codes)
    positions, nodes, size = _inner_nodes(codes[order], states[order])
    header = f"""# Octomap OcTree binary file
# (feel free to add / change comments, but leave the first line as it is!)
#
id OcTree
size {size}
res {voxel_m!r}
data
"""
    data = nodes[np.argsort(positions, kind="stable")].astype("<u2")
    atomic.write_bytes(path, header.encode(), data.tobytes())


def _interleaved(keys: Int64) -> Int64:
    """(N,) position of voxels on the Z-order curve, from their keys (N, 3)."""
    codes = np.zeros(len(keys), np.int64)
    for bit in range(_DEPTH):
        for axis in range(3):
            codes |= (keys[:, axis] >> bit & 1) << 3 * bit + axis
    return codes


def _inner_nodes(codes: Int64, states: UInt8) -> tuple[Int64, Int64, int]:
    """Return where the inner nodes begin on the Z-order curve, those above first; their children.

    And the number of all nodes.
    """
    positions, nodes, n_nodes = [], [], 1
    for level in range(1, _DEPTH + 1):
        parents, starts, counts = np.unique(codes >> 3, return_index=True, return_counts=True)
        child = states.astype(np.int64) << 2 * (codes & 7)
        packed = np.add.reduceat(child, starts) if len(child) else child
        equal = (counts == 8) & (np.isin(packed, (0x5555, 0xAAAA))) & (level < _DEPTH)
        positions.append(parents[~equal] << 3 * level)
        nodes.append(packed[~equal])
        n_nodes += int(counts[~equal].sum())
        leaf = states[starts] if len(states) else states
        codes, states = parents, np.where(equal, leaf, _INNER).astype(np.uint8)
    # The position of a node is that of its first child: the sort by position must be stable.
    return np.concatenate(positions[::-1]), np.concatenate(nodes[::-1]), n_nodes
