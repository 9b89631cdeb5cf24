"""Stitching of the pieces of a surface that were extracted from regions of its blocks.

A vertex is identified by its cell: the number of the block among all, and that of the voxel in it.
The region that owns the block creates it; faces of other regions refer to it by name. So nothing is
matched by distance, and nothing is duplicated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float32, Int32, Int64, UInt8
from tofuse.files.spill import Spill
from tofuse.fusion.cloud import grey_of
from tofuse.fusion.mesh import Mesh
from tofuse.kernels.clustering import flatten_groups, union_faces


@dataclass(frozen=True, eq=False)
class Piece:
    """The surface of a region's own blocks.

    Attributes
    ----------
    names
        (K,) of vertices: V of its own, ascending, then others that its faces refer to.
    points, normals, tints, sigma, views
        Of its own vertices, V rows; see `Mesh`, and `colored`.
    faces
        (M, 3) rows of `names`.
    blocks, counts
        (B,) numbers of its own blocks, ascending, and the number of faces of each, in this order.
    """

    names: Int64
    points: Float32
    normals: Float32
    tints: Float32
    sigma: Float32
    views: Int32
    faces: Int32
    blocks: Int64
    counts: Int64

    def __len__(self) -> int:
        return len(self.points)

    @property
    def own_names(self) -> Int64:
        """Names of its own vertices."""
        return self.names[: len(self)]


def stitch(pieces: Spill[Piece], blocks: int, island: int) -> Mesh:
    """Stitch the pieces of all blocks, without islands.

    Vertices are in the order of their names, faces in that of their blocks, as for a single region.
    Pieces are read one at a time, so that little memory is needed besides the result.

    Parameters
    ----------
    pieces
        A piece of each region.
    blocks
        Number of all blocks.
    island
        Connected surfaces of fewer vertices are left out.
    """
    each = range(len(pieces))
    names = np.sort(np.concatenate([pieces.get(k).own_names for k in each]))
    tints = np.empty((len(names), pieces.get(0).tints.shape[1]), np.float32)
    group = np.arange(len(names), dtype=np.int32)
    used = np.zeros(len(names), bool)
    for k in each:
        piece = pieces.get(k)
        place = _places(piece, names)
        tints[place[: len(piece)]] = piece.tints
        faces = place[piece.faces]
        used[faces] = True
        union_faces(faces, group)
    flatten_groups(group)
    color = colored(tints)  # with those of islands, for the range of brightness
    del tints
    used &= np.bincount(group, minlength=len(names))[group] >= island
    del group
    counts = np.zeros(blocks, np.int64)
    for k in each:
        piece = pieces.get(k)
        block = np.repeat(piece.blocks, piece.counts)
        kept = used[_places(piece, names)[piece.faces[:, 0]]]
        counts += np.bincount(block[kept], minlength=blocks)
    place_of = np.cumsum(used, dtype=np.int32) - np.int32(1)
    firsts = np.cumsum(counts) - counts
    total = int(used.sum())
    mesh = Mesh(
        np.empty((total, 3), np.float32),
        np.empty((int(counts.sum()), 3), np.int32),
        np.empty((total, 3), np.float32),
        None if color is None else color[used],
        np.empty(total, np.float32),
        np.empty(total, np.int32),
        np.zeros(3),
    )
    for k in each:
        piece = pieces.get(k)
        place = _places(piece, names)
        own = used[place[: len(piece)]]
        to = place_of[place[: len(piece)][own]]
        mesh.vertices[to], mesh.normals[to] = piece.points[own], piece.normals[own]
        mesh.sigma[to], mesh.views[to] = piece.sigma[own], piece.views[own]
        kept = used[place[piece.faces[:, 0]]]
        block = np.repeat(piece.blocks, piece.counts)[kept]
        before = np.searchsorted(block, block)  # faces of earlier blocks of this piece
        mesh.faces[firsts[block] + np.arange(len(block)) - before] = place_of[
            place[piece.faces[kept]]
        ]
    return mesh


def _places(piece: Piece, names: Int64) -> Int32:
    """Return the rows of the vertices of a piece among all, by their names."""
    return np.searchsorted(names, piece.names).astype(np.int32)


def colored(tints: Float32) -> UInt8 | None:
    """Return colours (N, 3) of tints (N, C): three channels are RGB, one the root of the albedo."""
    channels = tints.shape[1]
    if channels == 3:
        return np.round(tints).clip(0, 255).astype(np.uint8)
    return grey_of(tints[:, 0].astype(float) ** 2) if channels else None
