"""Mesh simplification: connected components, quadrics and areas of triangles."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Int64
from tofuse.engine.compute import kernel

# Minimum height of a triangle relative to its longest edge: below it, float32 leaves no normal.
_MIN_HEIGHT = 1e-6


@kernel
def union_faces(faces: Int32, group: Int32) -> None:
    """Unite the vertices of each triangle in a union-find forest.

    Parameters
    ----------
    faces
        (M, 3) vertex indices.
    group
        (N,) parent of each vertex, initially itself; updated. Roots are the lowest index of a
        component. Find operations halve the paths (Tarjan and van Leeuwen 1984).
    """
    for m in range(len(faces)):
        for k in range(1, 3):
            a = faces[m, 0]
            b = faces[m, k]
            while group[a] != a:
                group[a] = group[group[a]]
                a = group[a]
            while group[b] != b:
                group[b] = group[group[b]]
                b = group[b]
            if a < b:
                group[b] = a
            elif b < a:
                group[a] = b


@kernel
def flatten_groups(group: Int32) -> None:
    """Replace the parent of each vertex (N,) by the root of its component; see `union_faces`."""
    for n in range(len(group)):
        group[n] = group[group[n]]  # parents have lower indices and are final


@kernel
def quadric_sums(
    vertices: Float32, faces: Int32, group: Int64, centres: Float64, A: Float64, b: Float64
) -> None:
    """Sum the quadrics of the triangles around each group of vertices (Lindstrom 2000).

    Each corner of a triangle adds the triangle's plane to its group, weighted by twice the area:
    n n^T to the upper triangle of A, and n times the signed distance n . (p - centre) of the plane
    from the group's centre to b.

    Parameters
    ----------
    vertices, faces
        (N, 3) m, and (M, 3) rows of them.
    group
        (N,) group of each vertex.
    centres
        (G, 3) centres of the groups, m.
    A, b
        (G, 3, 3) and (G, 3), added to.
    """
    p, n = np.empty((3, 3)), np.empty(3)
    for m in range(len(faces)):
        for k in range(3):
            for i in range(3):
                p[k, i] = vertices[faces[m, k], i]
        x0, y0, z0 = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
        x1, y1, z1 = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
        n[0] = y0 * z1 - z0 * y1
        n[1] = z0 * x1 - x0 * z1
        n[2] = x0 * y1 - y0 * x1
        area = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        for i in range(3):
            n[i] /= max(area, 1e-12)
        for k in range(3):
            g = group[faces[m, k]]
            height = 0.0
            for i in range(3):
                height += (p[k, i] - centres[g, i]) * n[i]
            for i in range(3):
                b[g, i] += area * n[i] * height
                for j in range(i, 3):
                    A[g, i, j] += area * n[i] * n[j]


@kernel
def has_area(vertices: Float32, faces: Int32, out: Bool) -> None:
    """Write to `out` (M,) whether each triangle is not degenerate.

    Parameters
    ----------
    vertices, faces
        (N, 3) m, and (M, 3) rows of them. Triangles of vertices that are not finite have no area.
    """
    e = np.empty((3, 3))
    for m in range(len(faces)):
        longest2 = 0.0
        for k in range(3):
            length2 = 0.0
            for i in range(3):
                e[k, i] = float(vertices[faces[m, (k + 1) % 3], i]) - vertices[faces[m, k], i]
                length2 += e[k, i] * e[k, i]
            longest2 = max(longest2, length2)
        x = e[0, 1] * e[1, 2] - e[0, 2] * e[1, 1]
        y = e[0, 2] * e[1, 0] - e[0, 0] * e[1, 2]
        z = e[0, 0] * e[1, 1] - e[0, 1] * e[1, 0]
        out[m] = np.sqrt(x * x + y * y + z * z) > _MIN_HEIGHT * longest2
