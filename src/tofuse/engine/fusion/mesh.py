"""A surface of triangles: islands, decimation.

Edge collapse by quadric error (Garland and Heckbert 1997), by fast-simplification.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Intp, UInt8
from tofuse.engine.compute import ProcessLock
from tofuse.engine.errors import InputError
from tofuse.engine.fusion.cloud import Cloud, has_color
from tofuse.engine.fusion.clustering_kernels import (
    flatten_groups,
    has_area,
    quadric_sums,
    union_faces,
)
from tofuse.engine.fusion.geometry_record import Exportable, GeometryRecord

# The library collapses edges in 100 passes: in pass k those with an error, the sum of squared
# distances from planes, below 1e-9 (k + 3) ** _GROWTH. So the limit of a distance starts at 1.6e-4
# and grows 200-fold. With a slow growth edges are collapsed nearly in the order of their errors.
_AGGRESSIVENESS = 3
# Unit of length in the library, relative to the spacing of the vertices: the limit starts at 3 % of
# the spacing, whatever the size of the object.
_UNITS_PER_SPACING = 200.0
# If these passes do not suffice, more follow with a larger unit, unless they remove hardly any.
_UNIT_FACTOR, _MIN_REMOVED = 100.0, 0.1

# The library's state is global.
_LOCK = ProcessLock()


def collapse_edges(
    vertices: Float32, faces: Int32, count: int, spacing: float
) -> tuple[Intp, Float64]:
    """Collapse edges until at most `count` triangles remain, or no more can be removed.

    Parameters
    ----------
    vertices
        (N, 3) m, finite.
    faces
        (M, 3) rows of vertices. None is degenerate.
    count
        Number of triangles to reach.
    spacing
        Distance between neighbouring vertices, m.

    Returns
    -------
    group
        (N,) number of the group of vertices that were merged into one.
    positions
        (G, 3) position of each group, m.
    """
    from fast_simplification import simplify  # slow to import

    centroid = vertices.mean(0, dtype=float)
    positions = vertices - centroid
    merged_into = np.arange(len(vertices))
    unit = _UNITS_PER_SPACING * spacing
    while len(faces) > count:
        with _LOCK:
            new_positions, remaining, collapses = simplify(
                positions / unit,
                faces,
                target_count=count,
                agg=_AGGRESSIVENESS,
                return_collapses=True,
            )
        parent = np.arange(len(vertices))
        parent[collapses[:, 1]] = collapses[:, 0]
        while (parent[parent] != parent).any():
            parent = parent[parent]
        merged_into = parent[merged_into]
        reduced = len(remaining) <= max(count, (1 - _MIN_REMOVED) * len(faces))
        # The library numbers the remaining vertices in the order of their old numbers.
        faces = with_distinct_corners(parent[faces])
        positions[np.unique(faces)] = new_positions * unit
        if not reduced:
            break
        unit *= _UNIT_FACTOR
    kept, group = np.unique(merged_into, return_inverse=True)
    return group, positions[kept] + centroid


def with_distinct_corners(faces: Intp) -> Int32:
    """Return the triangles of three different vertices."""
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)].astype(np.int32)


# Of an overview: 8 MB as glTF, with 32 bytes a vertex and 12 a triangle.
OVERVIEW_FACES, OVERVIEW_VERTICES = 250_000, 155_000
# Damping of a merged vertex towards the centroid, relative to the planes around it.
_DAMPING = 0.02
# Maximum number of triangles from which the mean size is estimated.
_MAX_SAMPLED = 100_000
# Maximum number of triangles whose edges are collapsed at a time: about 0.4 GB of memory, which the
# library keeps.
_MAX_COLLAPSED = 1_000_000
# Vertices with a smaller cosine between their normals are on different sides of a thin sheet.
_MAX_OPPOSITE_COSINE = -0.3


@dataclass(frozen=True, eq=False)
class Mesh(Exportable):
    """Triangles in the world frame.

    Attributes
    ----------
    vertices
        (N, 3) float32 in m.
    faces
        (M, 3) int32 rows of `vertices`, counter-clockwise seen from outside.
    normals
        (N, 3) float32 unit normals, outwards.
    color
        (N, 3) uint8 RGB (albedo as grey where there is no colour), or None.
    sigma
        (N,) float32 standard deviation of each vertex along its normal, m, from the noise of the
        views; and from the errors of their poses once these are estimated (`pose_errors`).
    views
        (N,) int32, number of views that observed each vertex.
    """

    vertices: Float32
    faces: Int32
    normals: Float32
    color: UInt8 | None
    sigma: Float32
    views: Int32

    @classmethod
    def of(cls, record: GeometryRecord) -> Mesh:
        """Return the mesh of a file's record; what it lacks of normals and scalars is zero."""
        zeros = np.zeros(len(record))
        faces, normals = record.faces, record.normals
        return cls(
            record.points.astype(np.float32),
            np.zeros((0, 3), np.int32) if faces is None else faces,
            np.zeros((len(record), 3), np.float32) if normals is None else normals,
            record.color,
            record.scalars.get("sigma", zeros).astype(np.float32),
            record.scalars.get("views", zeros).astype(np.int32),
        )

    def __len__(self) -> int:
        return len(self.vertices)

    def __repr__(self) -> str:
        return f"Mesh: {len(self):,} vertices, {len(self.faces):,} faces"

    def record(self) -> GeometryRecord:
        """Return points in the world frame, with the other columns of a file."""
        scalars = {"views": self.views, "sigma": self.sigma}
        return GeometryRecord(self.vertices, self.faces, self.normals, self.color, scalars=scalars)

    def cloud(self) -> Cloud:
        """Return the vertices as a cloud."""
        return Cloud(self.vertices, self.normals, self.color, self.views, self.sigma)

    def rows(self, faces: Bool) -> Mesh:
        """Return the mesh of the faces (M,) that are True, without unused vertices."""
        kept = self.faces[faces]
        used = np.zeros(len(self), bool)
        used[kept.ravel()] = True
        new_row = np.cumsum(used, dtype=np.int32) - 1
        return self.with_vertices(used, new_row[kept])

    def with_vertices(self, used: Bool | Int32, faces: Int32 | Intp) -> Mesh:
        """Return the mesh of a subset of the vertices.

        Parameters
        ----------
        used
            Mask (N,) of the vertices, or their rows (K,).
        faces
            (M, 3) rows of the subset.
        """
        return replace(
            self,
            vertices=self.vertices[used],
            faces=faces.astype(np.int32).reshape(-1, 3),
            normals=self.normals[used],
            color=None if self.color is None else self.color[used],
            sigma=self.sigma[used],
            views=self.views[used],
        )

    @property
    def spacing(self) -> float:
        """Edge of a square of two triangles of the mean area, m."""
        return float(np.sqrt(self._double_area))

    @property
    def _double_area(self) -> float:
        """Twice the mean area of a triangle, estimated from some of them, m^2; 0 without any."""
        sampled = self.faces[:: max(1, -(-len(self.faces) // _MAX_SAMPLED))]
        a, b, c = (self.vertices[sampled[:, k]] for k in range(3))
        double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return float(double_area.mean(dtype=float)) if len(sampled) else 0.0

    def without_islands(self, min_vertices: int) -> Mesh:
        """Return the mesh without connected pieces of fewer than `min_vertices` vertices."""
        if len(self.faces) == 0:
            return self.rows(np.zeros(0, bool))
        piece = np.arange(len(self), dtype=np.int32)
        union_faces(self.faces, piece)
        flatten_groups(piece)
        return self.rows((np.bincount(piece)[piece] >= min_vertices)[self.faces[:, 0]])

    def decimated(self, faces: int) -> Mesh:
        """Return the mesh reduced to at most `faces` triangles by collapsing edges.

        A vertex has the mean normal, colour and variance of the vertices merged into it, and their
        maximum number of views. Very large meshes are first reduced by `clustered`, which takes
        less memory; as are those of too many pieces for collapsing edges to suffice.

        Raises
        ------
        InputError
            If so few triangles leave nothing of it.
        """
        if len(self.faces) <= faces:
            return self
        mesh = self._without_degenerate()
        if len(mesh.faces) > _MAX_COLLAPSED:
            mesh = mesh.clustered(max(faces, _MAX_COLLAPSED))._without_degenerate()
        if len(mesh.faces) <= faces:
            return mesh
        group, positions = collapse_edges(mesh.vertices, mesh.faces, faces, mesh.spacing)
        remaining = with_distinct_corners(group[mesh.faces])
        if len(remaining) <= faces:
            reduced = mesh._merge_groups(group, np.bincount(group), remaining, positions)
        else:
            reduced = mesh.clustered(faces)
        reduced = reduced._without_degenerate()
        if not len(reduced.faces):
            raise InputError(
                f"{faces} are too few for the surface: none is left",
                where="faces",
                remedy="pass more",
            )
        return reduced

    def _without_degenerate(self) -> Mesh:
        """Return the mesh of the triangles that have an area and are finite."""
        valid = np.empty(len(self.faces), bool)
        has_area(self.vertices, self.faces, valid)
        return self.rows(valid)

    def clustered(self, faces: int) -> Mesh:
        """Return the mesh simplified to at most `faces` triangles: faster than `decimated`.

        Vertex clustering (Rossignac and Borrel 1993), separately for both sides of thin structures,
        with the vertex that is closest to the planes of the adjacent triangles (Lindstrom 2000), so
        that edges and corners stay sharp. The mesh is empty if cells of its size leave more.
        """
        if len(self.faces) <= faces:
            return self
        largest = 2 * float(np.ptp(self.vertices, axis=0).max())
        # Two triangles a cell, if it is flat.
        cell = float(np.sqrt(self._double_area * len(self.faces) / faces))
        while True:
            group, count = self._cluster(cell)
            remaining = with_distinct_corners(group[self.faces])
            if len(remaining) <= faces:
                positions = self._optimal_positions(group, count, cell)
                return self._merge_groups(group, count, remaining, positions)
            if cell > largest:
                return self.rows(np.zeros(len(self.faces), bool))
            # A larger step than a flat surface would need.
            cell *= float(np.clip((len(remaining) / faces) ** 0.6, 1.02, 2.0))

    @cached_property
    def overview(self) -> Mesh:
        """The surface, clustered until a browser on a phone can show it.

        At most `OVERVIEW_FACES` triangles and `OVERVIEW_VERTICES` vertices: 8 MB as glTF.
        """
        faces, shown = OVERVIEW_FACES, self.clustered(OVERVIEW_FACES)
        while len(shown) > OVERVIEW_VERTICES:
            faces = int(0.8 * faces)
            shown = self.clustered(faces)
        return shown

    def _cluster(self, cell_m: float) -> tuple[Intp, Intp]:
        """Return the group of each vertex (N,), and the size of each group (G,)."""
        key = np.zeros(len(self), np.int64)
        for coordinate in self.vertices.T:  # one axis at a time takes a third of the memory
            cell = np.floor(coordinate.astype(float) / cell_m).astype(np.int64)
            cell -= cell.min()
            key = key * (cell.max() + 1) + cell
        _, first, number = np.unique(key, return_index=True, return_inverse=True)
        # The sides of a thin sheet stay separate.
        behind = (
            np.einsum("ni,ni->n", self.normals, self.normals[first[number]]) < _MAX_OPPOSITE_COSINE
        )
        side = 2 * number + behind
        count = np.bincount(side, minlength=2 * len(first))
        return (np.cumsum(count > 0) - 1)[side], count[count > 0]

    def _merge_groups(self, group: Intp, count: Intp, faces: Int32, positions: Float64) -> Mesh:
        """Return the mesh of groups (N,) of vertices, of sizes (G,), at positions (G, 3), m."""
        normals = _means(self.normals, group, count)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])
        max_views = np.zeros(len(count), np.int32)
        np.maximum.at(max_views, group, self.views)
        merged = Mesh(
            positions.astype(np.float32),
            faces,
            normals.astype(np.float32),
            self._mean_color(group, len(count)),
            np.sqrt(_means(self.sigma.astype(float) ** 2, group, count)).astype(np.float32),
            max_views,
        )
        return merged.rows(np.ones(len(faces), bool))

    def _mean_color(self, group: Intp, groups: int) -> UInt8 | None:
        """Return the mean (G, 3) of the colours of each group; black if none has a colour."""
        if self.color is None:
            return None
        colored = has_color(self.color)
        count = np.maximum(np.bincount(group[colored], minlength=groups), 1)
        sums = [np.bincount(group[colored], c[colored].astype(float), groups) for c in self.color.T]
        return np.round(np.stack(sums, -1) / count[:, None]).astype(np.uint8)

    def _optimal_positions(self, group: Intp, count: Intp, cell_m: float) -> Float64:
        """Return the position (G, 3) of each group by least squares on its triangles' planes.

        Unconstrained directions stay at the centroid; the step is at most half a cell.
        """
        centroids = _means(self.vertices, group, count)
        A = np.zeros((len(centroids), 3, 3))
        b = np.zeros((len(centroids), 3))
        quadric_sums(self.vertices, self.faces, group, centroids, A, b)
        A += np.triu(A, 1).transpose(0, 2, 1)
        trace = np.maximum(np.trace(A, axis1=1, axis2=2), 1e-12)
        step = np.linalg.solve(A + _DAMPING * trace[:, None, None] * np.eye(3), b[..., None])[
            ..., 0
        ]
        return centroids + step.clip(-0.5 * cell_m, 0.5 * cell_m)


def _means(values: NDArray[np.generic], group: Intp, count: Intp) -> Float64:
    """Return the means (G, ...) of values (N, ...) of groups of sizes (G,)."""
    columns = values.reshape(len(values), -1).T
    sums = [np.bincount(group, column.astype(float), len(count)) for column in columns]
    return np.stack(sums, -1).reshape(-1, *values.shape[1:]) / count.reshape(
        -1, *(1,) * (values.ndim - 1)
    )
