"""The texture atlas of a surface: where each triangle is in the texture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float32, Int32, Intp
from tofuse.engine.fusion.mesh import Mesh

MARGIN = 1.4  # texels around each triangle that are painted too
_PADDING = 3  # texels between charts
_MIN_CELL, _MAX_CELL = 6, 16  # texels per cell of the plain atlas
_MAX_PART = 1000  # maximum triangles that the library divides into charts jointly


@dataclass(frozen=True, eq=False)
class Atlas:
    """A flat layout of a mesh.

    Attributes
    ----------
    vertices
        (N,) rows of the mesh's vertices; a vertex in several charts occurs more than once.
    faces
        (M, 3) rows of `vertices`.
    texels
        (N, 2) column and row in the texture, centres of texels at integers.
    size
        Edge of the texture.
    """

    vertices: Int32
    faces: Int32
    texels: Float32
    size: int

    @property
    def uv(self) -> Float32:
        """(N, 2) texture coordinates from the upper left corner, 0 to 1."""
        return np.asarray((self.texels + 0.5) / self.size, np.float32)


def unwrap(mesh: Mesh, size: int) -> Atlas:
    """Parametrise a mesh: in charts by the library of the extra `texture`, else per triangle."""
    try:
        import xatlas
    except ImportError:
        return plain_atlas(mesh, size)
    return _unwrap_by_xatlas(xatlas, mesh, size)


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
    right_angle = np.argmax(edges, axis=1)  # its corner is the right angle
    order = (right_angle[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(mesh.faces, order, 1)
    number = np.arange(count)
    origin = np.stack([number // 2 % columns, number // 2 // columns], -1) * cell
    low, high = 1.0, cell - 4.0
    lower = np.array([[low, low], [high, low], [low, high]])
    corners = np.where((number % 2 == 0)[:, None, None], lower, cell - 1 - lower)
    texels = (origin[:, None] + corners).reshape(-1, 2).astype(np.float32)
    rows = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    inverse = np.argsort(order, axis=1)  # the corners in the order of the mesh
    rows = np.take_along_axis(rows, inverse, 1)
    return Atlas(faces.reshape(-1).astype(np.int32), rows, texels, size)


def _unwrap_by_xatlas(xatlas: Any, mesh: Mesh, size: int) -> Atlas:
    atlas = xatlas.Atlas()
    parts = _split(mesh)
    part_vertices = []
    for part in parts:
        vertices, corners = np.unique(mesh.faces[part], return_inverse=True)
        atlas.add_mesh(
            mesh.vertices[vertices],
            corners.reshape(-1, 3).astype(np.uint32),
            mesh.normals[vertices],
        )
        part_vertices.append(vertices)
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_iterations = 1
    packing.resolution = size - 2 * _PADDING
    packing.padding = _PADDING
    packing.bilinear = True
    atlas.generate(charts, packing)
    extent = np.array([atlas.width, atlas.height], float)
    size = int(max(extent))
    rows, uvs, faces, offset = [], [], np.empty((len(mesh.faces), 3), np.int32), 0
    for k, (part, vertices) in enumerate(zip(parts, part_vertices, strict=True)):
        row, corners, uv = atlas[k]
        rows.append(vertices[row])
        uvs.append(uv)
        faces[part] = corners.astype(np.int64) + offset
        offset += len(row)
    texels = (np.concatenate(uvs).astype(float) * extent - 0.5).clip(0, size - 1)
    return Atlas(np.concatenate(rows).astype(np.int32), faces, texels.astype(np.float32), size)


def _split(mesh: Mesh) -> list[Intp]:
    """Return the faces (K,) of each part of the mesh, halved across its longest side until small.

    The library compares all pairs of neighbouring charts, which for 60,000 triangles takes ten
    times as long as in parts. The cuts add 6 % more charts.
    """
    centroids = mesh.vertices[mesh.faces].mean(1)
    parts, pending = [], [np.arange(len(mesh.faces))]
    while pending:
        faces = pending.pop()
        if len(faces) <= _MAX_PART:
            parts.append(faces)
            continue
        axis = int(np.ptp(centroids[faces], axis=0).argmax())
        order = faces[np.argsort(centroids[faces, axis], kind="stable")]
        pending += [order[len(order) // 2 :], order[: len(order) // 2]]
    return parts
