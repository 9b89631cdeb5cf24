"""Pieces of a surface, made of regions of its blocks, put together.

A vertex is named by its cell: the number of the block among all, and that of the voxel in it. It is
made by the region that owns the block; others that have faces to it know it by name. So nothing is
compared by distance, and nothing is there twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.fusion.cloud import grey_of
from tofuse.fusion.mesh import Mesh

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Piece:
    """The surface of a region's own blocks.

    Attributes
    ----------
    names
        (K,) of vertices: V of its own, ascending, and then others that its faces go to.
    points, normals, tints, sigma, views
        Of its own vertices, V rows; see `Mesh`, and `colored`.
    faces
        (M, 3) rows of `names`.
    blocks, counts
        (B,) numbers of its own blocks, ascending, and how many faces each has, in this order.
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


def stitched(pieces: list[Piece], blocks: int) -> Mesh:
    """Put together the pieces of all of so many blocks, and empty the list.

    Vertices come in the order of their names, faces in that of their blocks: as if all blocks had
    been one region.
    """
    names = np.sort(np.concatenate([piece.names[: len(piece.points)] for piece in pieces]))
    counts = np.zeros(blocks, np.int64)
    for piece in pieces:
        counts[piece.blocks] = piece.counts
    firsts = np.cumsum(counts) - counts
    total = len(names)
    points, normals = np.empty((total, 3), np.float32), np.empty((total, 3), np.float32)
    tints = np.empty((total, pieces[0].tints.shape[1]), np.float32)
    sigma, views = np.empty(total, np.float32), np.empty(total, np.int32)
    faces = np.empty((int(counts.sum()), 3), np.int32)
    while pieces:
        piece = pieces.pop()
        place = np.searchsorted(names, piece.names).astype(np.int32)
        own = place[: len(piece.points)]
        points[own], normals[own], tints[own] = piece.points, piece.normals, piece.tints
        sigma[own], views[own] = piece.sigma, piece.views
        before = np.cumsum(piece.counts) - piece.counts
        rows = np.repeat(firsts[piece.blocks] - before, piece.counts) + np.arange(len(piece.faces))
        faces[rows] = place[piece.faces]
    return Mesh(points, faces, normals, colored(tints), sigma, views, np.zeros(3))


def colored(tints: Float32) -> NDArray[np.uint8] | None:
    """Colours (N, 3) of light (N, C): RGB of three channels, grey of the root of the albedo."""
    channels = tints.shape[1]
    if channels == 3:
        return np.round(tints).clip(0, 255).astype(np.uint8)
    return grey_of(tints[:, 0].astype(float) ** 2) if channels else None
