"""A surface of triangles, and what is done with one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofuse.fusion.cloud import Cloud

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
UInt8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the world frame.

    Attributes
    ----------
    vertices
        (N, 3) float32 in m, relative to `offset`.
    faces
        (M, 3) int32 rows of `vertices`, counter-clockwise seen from outside.
    normals
        (N, 3) float32 unit normals, outwards.
    color
        (N, 3) uint8 RGB (albedo as grey where there is no colour), or None.
    sigma
        (N,) float32, how well the vertex is known along its normal as the views' noise tells, m.
    views
        (N,) int32, how many views saw it.
    offset
        (3,) float64.
    """

    vertices: Float32
    faces: Int32
    normals: Float32
    color: UInt8 | None
    sigma: Float32
    views: Int32
    offset: Float64

    def __len__(self) -> int:
        return len(self.vertices)

    def cloud(self) -> Cloud:
        """Return the vertices as a cloud."""
        return Cloud(self.vertices, self.normals, self.color, self.views, self.offset, self.sigma)

    def rows(self, faces: NDArray[np.bool_]) -> Mesh:
        """Return the mesh of the faces (M,) that are True, without vertices that no face has."""
        kept = self.faces[faces]
        used = np.zeros(len(self), bool)
        used[kept.ravel()] = True
        place = np.cumsum(used, dtype=np.int32) - 1
        return replace(
            self,
            vertices=self.vertices[used],
            faces=place[kept].astype(np.int32).reshape(-1, 3),
            normals=self.normals[used],
            color=None if self.color is None else self.color[used],
            sigma=self.sigma[used],
            views=self.views[used],
        )

    def without_islands(self, least: int) -> Mesh:
        """Return the mesh without its connected pieces of fewer than `least` vertices."""
        if len(self.faces) == 0:
            return self.rows(np.zeros(0, bool))
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        a, b = self.faces[:, [0, 1]].T, self.faces[:, [1, 2]].T
        i, j = np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
        links = coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(len(self),) * 2)
        _, piece = connected_components(links, directed=False)
        return self.rows((np.bincount(piece)[piece] >= least)[self.faces[:, 0]])

    def simplified(self, cell_m: float) -> Mesh:
        """Return the mesh with the vertices in each cube of a grid put together at their mean.

        The vertex clustering of Rossignac and Borrel (1993): quick, and good enough to look at.
        """
        if len(self) == 0:
            return self
        cell = np.floor(self.vertices.astype(float) / cell_m).astype(np.int64)
        cell -= cell.min(0)
        extent = cell.max(0) + 1
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        _, group, count = np.unique(key, return_inverse=True, return_counts=True)

        def mean(values: NDArray[np.generic]) -> Float64:
            columns = values.reshape(len(values), -1).astype(float).T
            sums = [np.bincount(group, column, len(count)) for column in columns]
            return np.stack(sums, -1).reshape(-1, *values.shape[1:]) / count.reshape(
                -1, *(1,) * (values.ndim - 1)
            )

        normals = mean(self.normals)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])
        faces = group[self.faces].astype(np.int32).reshape(-1, 3)
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        most = np.zeros(len(count), np.int32)
        np.maximum.at(most, group, self.views)
        merged = Mesh(
            mean(self.vertices).astype(np.float32),
            faces,
            normals.astype(np.float32),
            None if self.color is None else np.round(mean(self.color)).astype(np.uint8),
            np.sqrt(mean(self.sigma.astype(float) ** 2)).astype(np.float32),
            most,
            self.offset,
        )
        return merged.rows(np.ones(len(faces), bool))
