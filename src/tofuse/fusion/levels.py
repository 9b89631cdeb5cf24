"""A surface in levels of detail, cut into tiles: what is far away needs few triangles.

Level 0 is the surface. Each further one puts the vertices in cubes twice as large together (see
`Mesh.simplified`), all over the surface at once, and only then is it cut. So tiles of one level
share the vertices at their borders, and there are no cracks between them. Tiles grow with the
cubes: eight of a level lie in one of the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64, Int64
from tofuse.fusion.mesh import Mesh

Place = tuple[int, int, int]

# Edge of a tile in edges of its triangles: some 128^2 cells, of two triangles, for each surface
# that passes it; 1 to 2 MB.
_ACROSS = 128


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail.

    Attributes
    ----------
    number
        0 is the surface itself.
    error_m
        Edge of the cubes whose vertices are put together, m: how far off the level may be. 0 for
        the surface itself.
    mesh
        All of it.
    order, places, ends
        Faces (M,) by their tiles, of each tile where it is, in tiles, and where its faces end.
    """

    number: int
    error_m: float
    mesh: Mesh
    order: Int64
    places: tuple[Place, ...]
    ends: Int64

    def tiles(self) -> Iterator[tuple[Place, Mesh]]:
        """Each tile, with vertices of its own."""
        starts = np.concatenate([[0], self.ends])[:-1]
        for place, start, end in zip(self.places, starts, self.ends, strict=True):
            yield place, _part(self.mesh, self.order[start:end])


def levels(mesh: Mesh) -> Iterator[Level]:
    """Give the levels of a surface with faces, the finest first; the last one is a single tile."""
    origin = mesh.vertices.min(0).astype(float)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    # No finer than single precision holds, should all triangles be slivers.
    edge = max(mesh.spacing, 1e-6 * size, 1e-9)
    number, error = 0, 0.0
    while True:
        level = _cut(number, error, mesh, origin, _ACROSS * edge * 2**number)
        yield level
        if len(level.places) <= 1:
            return
        number += 1
        error = edge * 2.0**number
        mesh = mesh.simplified(error)


def _cut(number: int, error_m: float, mesh: Mesh, origin: Float64, size: float) -> Level:
    """Put each face into the tile of its middle."""
    key, extents = np.zeros(len(mesh.faces), np.int64), []
    for axis in range(3):
        along = mesh.vertices[:, axis].astype(float)
        a, b, c = mesh.faces.T
        middle = (along[a] + along[b] + along[c]) / 3
        # What moved out by being put together stays with its neighbours.
        place = np.maximum(np.floor((middle - origin[axis]) / size), 0).astype(np.int64)
        extents.append(int(place.max(initial=0)) + 1)
        key = key * extents[-1] + place
    found, counts = np.unique(key, return_counts=True)
    places = np.stack(np.unravel_index(found, extents), 1).tolist()
    return Level(
        number,
        error_m,
        mesh,
        np.argsort(key, kind="stable"),
        tuple((i, j, k) for i, j, k in places),
        np.cumsum(counts),
    )


def _part(mesh: Mesh, faces: Int64) -> Mesh:
    """Some faces, with the vertices that they have."""
    used, place = np.unique(mesh.faces[faces], return_inverse=True)
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=place.reshape(-1, 3).astype(np.int32),
        normals=mesh.normals[used],
        color=None if mesh.color is None else mesh.color[used],
        sigma=mesh.sigma[used],
        views=mesh.views[used],
    )
