"""The texture atlas of a surface: where each triangle is in the texture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Int32, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.fusion.atlas_kernels import NO_TRIANGLE, draw_triangles
from tofuse.engine.fusion.mesh import Mesh

MARGIN = 1.4  # texels around each triangle that are painted too
_PADDING = 3  # texels between charts
_MIN_CELL, _MAX_CELL = 6, 16  # texels per cell of the plain atlas
# Of charts: first edge of a texture that is tried, factor by which they are scaled down until they
# fit, and where that ends.
_FIRST_EDGE, _SHRINK, _MIN_SCALE = 256, 0.93, 0.01
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

    def drawn(self) -> tuple[Int32, Float32]:
        """Return the triangle (size, size) of each texel, and its place (size, size, 2) in it."""
        owner = np.full((self.size, self.size), NO_TRIANGLE, np.int32)
        coordinates = np.zeros((self.size, self.size, 2), np.float32)
        draw_triangles(self.texels[self.faces], MARGIN, owner, coordinates)
        return owner, coordinates


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
    texels = _in_cells(mesh.vertices[mesh.faces], columns, cell)
    rows = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    vertices = mesh.faces.reshape(-1).astype(np.int32)
    return Atlas(vertices, rows, texels.reshape(-1, 2).astype(np.float32), columns * cell)


def _in_cells(corners: Float32, columns: int, cell: int) -> Float64:
    """Return texels (M, 3, 2) of triangles (M, 3, 3), two in a square cell."""
    p = corners.astype(float)
    edges = np.linalg.norm(p[:, [2, 0, 1]] - p[:, [1, 2, 0]], axis=2)  # opposite each corner
    order = (np.argmax(edges, axis=1)[:, None] + np.arange(3)) % 3  # the right angle is the first
    number = np.arange(len(p))
    origin = np.stack([number // 2 % columns, number // 2 // columns], -1) * cell
    low, high = 1.0, cell - 4.0
    lower = np.array([[low, low], [high, low], [low, high]])
    texels: Float64 = np.where((number % 2 == 0)[:, None, None], lower, cell - 1 - lower)
    texels = texels + origin[:, None]
    inverse = np.argsort(order, axis=1)[..., None]  # the corners in the order of the mesh
    return np.take_along_axis(texels, inverse, 1)


def chart_atlas(faces: Int32, label: Int32, pixels: Float32, size: int) -> Atlas:
    """Lay out charts, connected triangles of the same label, as rectangles.

    Parameters
    ----------
    faces, label
        (M, 3) rows of vertices and (M,) what the triangles are seen by: charts of triangles that
        are seen by different things are apart.
    pixels
        (M, 3, 2) where their corners are seen.
    size
        Maximum edge of the texture: if the charts do not fit, they are scaled down.
    """
    chart = _connected(faces, label)
    count = int(chart.max(initial=-1)) + 1
    order = np.argsort(chart, kind="stable")
    first = np.searchsorted(chart[order], np.arange(count))
    low = np.minimum.reduceat(pixels[order].min(1), first)
    extent = np.maximum.reduceat(pixels[order].max(1), first) - low
    edge, scale = min(_FIRST_EDGE, size), 1.0
    while True:
        sides = np.ceil(scale * extent).astype(np.intp) + 2 * _PADDING
        if sides.prod(1).sum() <= edge * edge and sides.max() <= edge:
            origin, height = _on_shelves(sides, edge)
            if height <= edge:
                break
        if 2 * edge <= size:
            edge *= 2
        elif scale > _MIN_SCALE:
            scale *= _SHRINK
        else:  # of very many charts, whose margins alone do not fit
            edge *= 2
    texels = scale * (pixels - low[chart][:, None]) + (origin[chart][:, None] + _PADDING)
    # A vertex is shared within a chart.
    key = chart[:, None].astype(np.int64) * (int(faces.max()) + 1) + faces
    _, shared, row = np.unique(key, return_index=True, return_inverse=True)
    return Atlas(
        faces.reshape(-1)[shared].astype(np.int32),
        row.reshape(-1, 3).astype(np.int32),
        texels.reshape(-1, 2)[shared].astype(np.float32),
        edge,
    )


def _connected(faces: Int32, label: Int32) -> Int32:
    """Return the number (M,) of the chart of each triangle."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1).astype(np.int64)
    key = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    shared = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    a, b = order[shared] // 3, order[shared + 1] // 3
    same = label[a] == label[b]
    return parts_of(len(faces), np.stack([a[same], b[same]], 1)).astype(np.int32)


def _on_shelves(extent: Intp, edge: int) -> tuple[Intp, int]:
    """Place rectangles of sizes (C, 2) side by side in rows, the highest first.

    Returns their upper left corners (C, 2), and the height of all rows.
    """
    order = np.lexsort((-extent[:, 0], -extent[:, 1]))
    corners = []
    left = top = row_height = 0
    for width, height in extent[order].tolist():
        if left + width > edge:
            left, top, row_height = 0, top + row_height, 0
        corners.append((left, top))
        left += width
        row_height = max(row_height, height)
    origin = np.empty_like(extent)
    origin[order] = corners
    return origin, top + row_height


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
