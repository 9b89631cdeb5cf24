"""Levels of detail of a surface, cut into tiles, for display at any distance.

Level 0 is the surface. Each further one merges the vertices of the full surface in cubes twice as
large (see `Mesh.simplified`), and is split only then. So tiles of one level share the vertices at
their borders, without cracks between them. Tiles grow with the cubes: eight of a level are in one
of the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64, Int64
from tofuse.fusion.mesh import Mesh

TileIndex = tuple[int, int, int]

# Edge of a tile in edges of its triangles: some 128^2 cells of two triangles for each surface
# through it; 1 to 2 MB.
_TRIANGLES_PER_EDGE = 128


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail.

    Attributes
    ----------
    number
        0 is the surface itself.
    error_m
        Edge of the cubes whose vertices are merged, m, which bounds the error; 0 for level 0.
    mesh
        The mesh of all tiles.
    order, tile_indices, ends
        (M,) faces sorted by tile; index of each tile along x, y, z; (T,) end of its faces.
    """

    number: int
    error_m: float
    mesh: Mesh
    order: Int64
    tile_indices: tuple[TileIndex, ...]
    ends: Int64

    def tiles(self) -> Iterator[tuple[TileIndex, Mesh]]:
        """Yield each tile, with separate vertices."""
        starts = np.concatenate([[0], self.ends])[:-1]
        for index, start, end in zip(self.tile_indices, starts, self.ends, strict=True):
            yield index, _submesh(self.mesh, self.order[start:end])


def levels(mesh: Mesh) -> Iterator[Level]:
    """Yield the levels of a surface with faces, the finest first; the last is a single tile."""
    origin = mesh.vertices.min(0).astype(float)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    # No finer than single precision, even if all triangles are slivers.
    edge = max(mesh.spacing, 1e-6 * size, 1e-9)
    number, error = 0, 0.0
    while True:
        level = _split_into_tiles(
            number, error, mesh, origin, _TRIANGLES_PER_EDGE * edge * 2**number
        )
        yield level
        if len(level.tile_indices) <= 1:
            return
        number += 1
        error = edge * 2.0**number
        mesh = mesh.simplified(error)


def _split_into_tiles(
    number: int, error_m: float, mesh: Mesh, origin: Float64, size: float
) -> Level:
    """Assign each face to the tile of its centroid."""
    key, extents = np.zeros(len(mesh.faces), np.int64), []
    for axis in range(3):
        coordinate = mesh.vertices[:, axis].astype(float)
        a, b, c = mesh.faces.T
        centroid = (coordinate[a] + coordinate[b] + coordinate[c]) / 3
        # Faces that merging moved outside stay with their neighbours.
        index = np.maximum(np.floor((centroid - origin[axis]) / size), 0).astype(np.int64)
        extents.append(int(index.max(initial=0)) + 1)
        key = key * extents[-1] + index
    tile_keys, counts = np.unique(key, return_counts=True)
    tile_indices = np.stack(np.unravel_index(tile_keys, extents), 1).tolist()
    return Level(
        number,
        error_m,
        mesh,
        np.argsort(key, kind="stable"),
        tuple((i, j, k) for i, j, k in tile_indices),
        np.cumsum(counts),
    )


def _submesh(mesh: Mesh, faces: Int64) -> Mesh:
    """Return a subset of the faces with their vertices."""
    used, vertex_index = np.unique(mesh.faces[faces], return_inverse=True)
    return mesh.with_vertices(used, vertex_index)
