"""Stitching of the pieces of a surface that were extracted from regions of its blocks.

A vertex is identified by its cell: the number of the block among all, and that of the voxel in it.
The region that owns the block creates it; faces of other regions refer to it by its id. So nothing
is matched by distance, and nothing is duplicated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float32, Int32, Int64, UInt8
from tofuse.engine.compute import Spill
from tofuse.engine.fusion.cloud import grey_of
from tofuse.engine.fusion.clustering_kernels import flatten_groups, union_faces
from tofuse.engine.fusion.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Piece:
    """The surface of the blocks that a region owns.

    Attributes
    ----------
    ids
        (K,) ids of vertices: the V owned, ascending, then others that its faces refer to.
    points, normals, intensity, sigma, views
        Of the owned vertices, V rows; see `Mesh`, and `to_rgb`.
    faces
        (M, 3) rows of `ids`.
    blocks, counts
        (B,) numbers of the owned blocks, ascending, and the number of faces of each.
    """

    ids: Int64
    points: Float32
    normals: Float32
    intensity: Float32
    sigma: Float32
    views: Int32
    faces: Int32
    blocks: Int64
    counts: Int64

    def __len__(self) -> int:
        return len(self.points)

    @property
    def owned_ids(self) -> Int64:
        """Ids of the owned vertices."""
        return self.ids[: len(self)]


def stitch(pieces: Spill[Piece], blocks: int, island: int) -> Mesh:
    """Stitch the pieces of all blocks, without islands.

    Vertices are in the order of their ids, faces in that of their blocks, as for a single region.
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
    indices = range(len(pieces))
    ids = np.sort(np.concatenate([pieces.get(k).owned_ids for k in indices]))
    intensity = np.empty((len(ids), pieces.get(0).intensity.shape[1]), np.float32)
    group = np.arange(len(ids), dtype=np.int32)
    used = np.zeros(len(ids), bool)
    for k in indices:
        piece = pieces.get(k)
        rows = _rows(piece, ids)
        intensity[rows[: len(piece)]] = piece.intensity
        faces = rows[piece.faces]
        used[faces] = True
        union_faces(faces, group)
    flatten_groups(group)
    color = to_rgb(intensity)  # with those of islands, for the range of brightness
    del intensity
    used &= np.bincount(group, minlength=len(ids))[group] >= island
    del group
    counts = np.zeros(blocks, np.int64)
    for k in indices:
        piece = pieces.get(k)
        block = np.repeat(piece.blocks, piece.counts)
        used_faces = used[_rows(piece, ids)[piece.faces[:, 0]]]
        counts += np.bincount(block[used_faces], minlength=blocks)
    new_row = np.cumsum(used, dtype=np.int32) - np.int32(1)
    starts = np.cumsum(counts) - counts
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
    for k in indices:
        piece = pieces.get(k)
        rows = _rows(piece, ids)
        used_owned = used[rows[: len(piece)]]
        target = new_row[rows[: len(piece)][used_owned]]
        mesh.vertices[target], mesh.normals[target] = (
            piece.points[used_owned],
            piece.normals[used_owned],
        )
        mesh.sigma[target], mesh.views[target] = piece.sigma[used_owned], piece.views[used_owned]
        used_faces = used[rows[piece.faces[:, 0]]]
        block = np.repeat(piece.blocks, piece.counts)[used_faces]
        earlier = np.searchsorted(block, block)  # faces of earlier blocks of this piece
        mesh.faces[starts[block] + np.arange(len(block)) - earlier] = new_row[
            rows[piece.faces[used_faces]]
        ]
    return mesh


def _rows(piece: Piece, ids: Int64) -> Int32:
    """Return the rows of the vertices of a piece among all, by their ids."""
    return np.searchsorted(ids, piece.ids).astype(np.int32)


def to_rgb(intensity: Float32) -> UInt8 | None:
    """Return RGB (N, 3) of intensity (N, C): three channels are RGB, one the root of the albedo."""
    channels = intensity.shape[1]
    if channels == 3:
        return np.round(intensity).clip(0, 255).astype(np.uint8)
    return grey_of(intensity[:, 0].astype(float) ** 2) if channels else None
