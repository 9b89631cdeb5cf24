"""Triangle meshes and the primitives of which scenes consist."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.geometry import se3, triangles, unit_vectors

# Crease angle: edges below it are smoothed.
_CREASE_RAD = np.deg2rad(48.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, counter-clockwise seen from outside.

    Attributes
    ----------
    vertices
        (V, 3) in m.
    faces
        (F, 3) indices of vertices.
    surface
        (F,) surface id (material) of each triangle.
    """

    vertices: Float64
    faces: Int64
    surface: Int64

    @classmethod
    def of(cls, vertices: ArrayLike, faces: ArrayLike) -> Self:
        """Make a mesh of surface 0."""
        f = np.asarray(faces, np.int64).reshape(-1, 3)
        return cls(np.asarray(vertices, float).reshape(-1, 3), f, np.zeros(len(f), np.int64))

    def transformed(self, T: ArrayLike) -> Self:
        """Return the mesh transformed by a rigid motion (4, 4)."""
        return replace(self, vertices=se3.transform(T, self.vertices))

    def translated(self, x: float, y: float, z: float) -> Self:
        """Return the mesh translated by a vector in m."""
        return replace(self, vertices=self.vertices + np.array([x, y, z]))

    def warped(self, function: Callable[[Float64], Float64]) -> Self:
        """Return the mesh with a function (V, 3) -> (V, 3) applied to its vertices."""
        return replace(self, vertices=function(self.vertices))

    def of_surface(self, surface: int) -> Self:
        """Return the mesh with all triangles of one surface."""
        return replace(self, surface=np.full(len(self.faces), surface, np.int64))

    def corners(self) -> Float64:
        """(F, 3, 3) corners of the triangles."""
        return self.vertices[self.faces]


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Concatenate meshes."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + s for m, s in zip(meshes, starts[:-1], strict=True)]),
        np.concatenate([m.surface for m in meshes]),
    )


def face_normals(mesh: Mesh) -> Float64:
    """(F, 3) unit normals; zero for a triangle without area."""
    return unit_vectors(triangles.crosses(mesh.corners()))


def corner_normals(mesh: Mesh) -> Float64:
    """(F, 3, 3) unit normals at the corners, smooth across edges flatter than the crease angle.

    Each corner takes the area-weighted mean of the triangles that share its vertex and whose
    normals are within the crease angle of its own.
    """
    normals = face_normals(mesh)
    area = triangles.areas(mesh.corners())
    vertex = mesh.faces.ravel()
    order = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=len(mesh.vertices))
    start = np.cumsum(count) - count
    # All pairs (corner, triangle at the same vertex).
    repeats = count[vertex]
    corner = np.repeat(np.arange(len(vertex)), repeats)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    other = order[start[vertex[corner]] + within] // 3
    within_crease = np.einsum("ij,ij->i", normals[corner // 3], normals[other]) > np.cos(
        _CREASE_RAD
    )
    weight = np.where(within_crease, area[other], 0.0)
    total = np.zeros((len(vertex), 3))
    np.add.at(total, corner, weight[:, None] * normals[other])
    length = np.linalg.norm(total, axis=1, keepdims=True)
    face_normal = np.repeat(normals, 3, axis=0)
    return np.where(length > 1e-12, unit_vectors(total), face_normal).reshape(-1, 3, 3)


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
    """Cuboid of 12 triangles with the given edge lengths."""
    half = 0.5 * np.asarray(size, float)
    signs = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Mesh.of(np.asarray(centre, float) + signs * half, faces)


def box_between(low: ArrayLike, high: ArrayLike) -> Mesh:
    """Cuboid between two opposite corners."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    return box(np.abs(b - a), 0.5 * (a + b))


def inside_out(mesh: Mesh) -> Mesh:
    """Return the mesh with reversed triangle orientation."""
    return replace(mesh, faces=mesh.faces[:, ::-1].copy())


def quad(corner: ArrayLike, u: ArrayLike, v: ArrayLike) -> Mesh:
    """Parallelogram of 2 triangles spanned by u and v; its normal is u x v."""
    p, a, b = (np.asarray(q, float) for q in (corner, u, v))
    return Mesh.of([p, p + a, p + a + b, p + b], [(0, 1, 2), (0, 2, 3)])


def grid(points: ArrayLike, *, closed: bool = False) -> Mesh:
    """Sheet through (A, B, 3) points; `closed` joins the last column to the first.

    Coincident points are merged and degenerate triangles dropped, so that a row may collapse to a
    pole.
    """
    p = np.asarray(points, float)
    rows, columns = p.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    if closed:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    flat = p.reshape(-1, 3)
    _, keep, welded = np.unique(np.round(flat, 9), axis=0, return_index=True, return_inverse=True)
    faces = welded.reshape(-1)[faces]
    nondegenerate = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    return Mesh.of(flat[keep], faces[nondegenerate])


def lathe(profile: ArrayLike, segments: int = 16) -> Mesh:
    """Surface of revolution of a profile (K, 2) of (radius, z), z ascending, about the z axis."""
    rz = np.asarray(profile, float)
    angle = np.arange(segments) * (2 * np.pi / segments)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    points = np.empty((len(rz), segments, 3))
    points[..., :2] = rz[:, None, :1] * ring
    points[..., 2] = rz[:, 1:]
    return grid(points, closed=True)


def rod(
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
    end_radius: float | None = None,
    segments: int = 12,
) -> Mesh:
    """Closed cylinder or cone between two points."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(b - a))
    tip = radius if end_radius is None else end_radius
    z = (b - a) / length
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = se3.pose(np.stack([x, np.cross(z, x), z], 1), a)
    return lathe([(0, 0), (radius, 0), (tip, length), (0, length)], segments).transformed(T)


def superellipsoid(
    size: ArrayLike,
    roundness: tuple[float, float] = (1.0, 1.0),
    segments: tuple[int, int] = (8, 16),
) -> Mesh:
    """Superellipsoid with the given edge lengths (Barr 1981).

    `roundness` is (from pole to pole, around): 1 an ellipsoid, towards 0 a box.
    """
    half = 0.5 * np.asarray(size, float)
    rows, columns = segments
    # Steps uniform in angle would concentrate at the edges of a boxy shape.
    eta = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    omega = np.arange(columns) * (2 * np.pi / columns)

    def power(a: Float64, exponent: float) -> Float64:
        return np.sign(a) * np.abs(np.where(np.abs(a) < 1e-12, 0.0, a)) ** exponent

    ce, se = power(np.cos(eta), roundness[0]), power(np.sin(eta), roundness[0])
    co, so = power(np.cos(omega), roundness[1]), power(np.sin(omega), roundness[1])
    points = np.empty((rows + 1, columns, 3))
    points[..., 0] = half[0] * ce[:, None] * co
    points[..., 1] = half[1] * ce[:, None] * so
    points[..., 2] = half[2] * se[:, None]
    return grid(points, closed=True)
