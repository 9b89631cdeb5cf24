"""The texture atlas of a surface: where each triangle is in the texture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.arrays import Float32, Int32, Intp
from tofuse.fusion.mesh import Mesh

MARGIN = 1.4  # texels around each triangle that are painted too
_PADDING = 3  # texels between charts
_MIN_CELL, _MAX_CELL = 6, 16  # texels per cell of the plain atlas
_BATCH = 1000  # triangles that the library divides into charts together


@dataclass(frozen=True, eq=False)
class Atlas:
    """A flat layout of a mesh.

    Attributes
    ----------
    vertices
        (N,) rows of the mesh's vertices; one in several charts occurs more than once.
    faces
        (M, 3) rows of `vertices`.
    places
        (N, 2) column and row in the texture, centres of texels at whole numbers.
    size
        Edge of the texture.
    """

    vertices: Int32
    faces: Int32
    places: Float32
    size: int

    @property
    def uv(self) -> Float32:
        """(N, 2) places from the upper left corner, 0 to 1."""
        return np.asarray((self.places + 0.5) / self.size, np.float32)


def unwrap(mesh: Mesh, size: int) -> Atlas:
    """Parametrise a mesh: in large charts by the library of the extra `texture`, else plainly."""
    try:
        import xatlas
    except ImportError:
        return plain_atlas(mesh, size)
    return _by_xatlas(xatlas, mesh, size)


def plain_atlas(mesh: Mesh, size: int) -> Atlas:
    """Give each triangle half of a square cell, its longest edge along the diagonal.

    Cells have 6 to 16 texels: a mesh of few triangles gets a smaller texture than `size`, one of
    very many a larger one.
    """
    count = len(mesh.faces)
    columns = max(1, int(np.ceil(np.sqrt((count + 1) // 2))))
    cell = int(np.clip(size // columns, _MIN_CELL, _MAX_CELL))
    size = columns * cell
    p = mesh.vertices[mesh.faces].astype(float)
    edges = np.linalg.norm(p[:, [2, 0, 1]] - p[:, [1, 2, 0]], axis=2)  # opposite each corner
    first = np.argmax(edges, axis=1)  # its corner is the right angle
    order = (first[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(mesh.faces, order, 1)
    number = np.arange(count)
    at = np.stack([number // 2 % columns, number // 2 // columns], -1) * cell
    low, high = 1.0, cell - 4.0
    lower = np.array([[low, low], [high, low], [low, high]])
    corners = np.where((number % 2 == 0)[:, None, None], lower, cell - 1 - lower)
    places = (at[:, None] + corners).reshape(-1, 2).astype(np.float32)
    rows = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    back = np.argsort(order, axis=1)  # the corners in the order of the mesh
    rows = np.take_along_axis(rows, back, 1)
    return Atlas(faces.reshape(-1).astype(np.int32), rows, places, size)


def _by_xatlas(xatlas: Any, mesh: Mesh, size: int) -> Atlas:
    atlas = xatlas.Atlas()
    parts = _parts(mesh)
    used = []
    for part in parts:
        vertices, corners = np.unique(mesh.faces[part], return_inverse=True)
        atlas.add_mesh(
            mesh.vertices[vertices],
            corners.reshape(-1, 3).astype(np.uint32),
            mesh.normals[vertices],
        )
        used.append(vertices)
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_iterations = 1
    packing.resolution = size - 2 * _PADDING
    packing.padding = _PADDING
    packing.bilinear = True
    atlas.generate(charts, packing)
    extent = np.array([atlas.width, atlas.height], float)
    size = int(max(extent))
    rows, uvs, faces, first = [], [], np.empty((len(mesh.faces), 3), np.int32), 0
    for k, (part, vertices) in enumerate(zip(parts, used, strict=True)):
        row, corners, uv = atlas[k]
        rows.append(vertices[row])
        uvs.append(uv)
        faces[part] = corners.astype(np.int64) + first
        first += len(row)
    places = (np.concatenate(uvs).astype(float) * extent - 0.5).clip(0, size - 1)
    return Atlas(np.concatenate(rows).astype(np.int32), faces, places.astype(np.float32), size)


def _parts(mesh: Mesh) -> list[Intp]:
    """Return the faces (K,) of each part of the mesh, halved across its longest side until small.

    The library compares all pairs of neighbouring charts, which for 60,000 triangles takes ten
    times as long as in parts. The cuts add 6 % more charts.
    """
    middles = mesh.vertices[mesh.faces].mean(1)
    small, large = [], [np.arange(len(mesh.faces))]
    while large:
        faces = large.pop()
        if len(faces) <= _BATCH:
            small.append(faces)
            continue
        axis = int(np.ptp(middles[faces], axis=0).argmax())
        order = faces[np.argsort(middles[faces, axis], kind="stable")]
        large += [order[len(order) // 2 :], order[: len(order) // 2]]
    return small
