"""Smooth bodies as blends of simple shapes, and their triangulation.

A shape is a function of the (approximate) signed distance of points (..., 3) in m,
negative inside. Shapes are blended by Quilez's polynomial smooth minimum, and triangulated by
naive surface nets (Gibson 1998), which are closed wherever the shape lies inside the grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.lab.world import Mesh

Shape = Callable[[Float64], Float64]


def ellipsoid(centre: ArrayLike, radii: ArrayLike) -> Shape:
    """Ellipsoid along the axes; the distance is exact to first order at the surface."""
    c, r = np.asarray(centre, float), np.asarray(radii, float)

    def distance(p: Float64) -> Float64:
        q = (p - c) / r
        k0 = np.linalg.norm(q, axis=-1)
        k1 = np.linalg.norm(q / r, axis=-1)
        return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)

    return distance


def limb(start: ArrayLike, end: ArrayLike, radius: float, end_radius: float) -> Shape:
    """Capsule whose radius changes linearly from start to end."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    axis = b - a

    def distance(p: Float64) -> Float64:
        fraction = np.clip((p - a) @ axis / (axis @ axis), 0.0, 1.0)
        nearest = a + fraction[..., None] * axis
        return np.linalg.norm(p - nearest, axis=-1) - (radius + fraction * (end_radius - radius))

    return distance


def blend(shapes: Sequence[tuple[Shape, float]]) -> Shape:
    """Smooth union of (shape, blending width in m with those before it)."""

    def distance(p: Float64) -> Float64:
        total = shapes[0][0](p)
        for shape, width in shapes[1:]:
            d = shape(p)
            h = np.maximum(width - np.abs(total - d), 0.0) / width
            total = np.minimum(total, d) - 0.25 * width * h * h
        return total

    return distance


def surface_net(shape: Shape, low: ArrayLike, high: ArrayLike, step: float) -> Mesh:
    """Triangulate a shape on a grid with cells of `step` m between two corners."""
    start = np.asarray(low, float)
    size = np.ceil((np.asarray(high, float) - start) / step).astype(int) + 1
    axes = [start[k] + step * np.arange(size[k]) for k in range(3)]
    value = shape(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    inside = value < 0
    cells = tuple(size - 1)

    total = np.zeros((*cells, 3))
    crossings = np.zeros(cells)
    quads = []
    index = np.arange(np.prod(cells)).reshape(cells)
    for axis in range(3):
        a = np.moveaxis(value, axis, 0)[:-1]
        b = np.moveaxis(value, axis, 0)[1:]
        cut = (a < 0) != (b < 0)
        fraction = np.where(cut, a / np.where(cut, a - b, 1.0), 0.0)
        cut, fraction = np.moveaxis(cut, 0, axis), np.moveaxis(fraction, 0, axis)
        j, k = (axis + 1) % 3, (axis + 2) % 3
        # Each cell has four edges along this axis.
        for dj in (0, 1):
            for dk in (0, 1):
                window: list[slice] = [slice(None)] * 3
                window[j] = slice(dj, cells[j] + dj)
                window[k] = slice(dk, cells[k] + dk)
                crossed, position = cut[tuple(window)], fraction[tuple(window)]
                crossings += crossed
                total[..., axis] += position
                total[..., j] += dj * crossed
                total[..., k] += dk * crossed
        quads.append(_quads(cut, inside, index, axis))
    used = np.flatnonzero(crossings.ravel())
    corner = np.stack(np.unravel_index(used, cells), -1)
    vertices = start + step * (corner + total.reshape(-1, 3)[used] / crossings.ravel()[used, None])
    vertices = project_to_surface(shape, vertices, step)
    vertex_index = np.full(index.size, -1)
    vertex_index[used] = np.arange(len(used))
    q = vertex_index[np.concatenate(quads)]
    # Split along the shorter diagonal.
    p = vertices[q]
    short = np.linalg.norm(p[:, 0] - p[:, 2], axis=1) <= np.linalg.norm(p[:, 1] - p[:, 3], axis=1)
    first = np.where(short[:, None], q[:, [0, 1, 2]], q[:, [0, 1, 3]])
    second = np.where(short[:, None], q[:, [0, 2, 3]], q[:, [1, 2, 3]])
    return Mesh.of(vertices, np.concatenate([first, second]))


def _quads(cut: Bool, inside: Bool, index: Int64, axis: int) -> Int64:
    """(Q, 4) cells around each cut edge along an axis, counter-clockwise seen from outside."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    window: list[slice] = [slice(None)] * 3
    window[j], window[k] = slice(1, -1), slice(1, -1)
    edges = np.argwhere(cut[tuple(window)])
    edges[:, [j, k]] += 1
    cells = []
    for dj, dk in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
        cell = edges.copy()
        cell[:, j] += dj
        cell[:, k] += dk
        cells.append(index[tuple(cell.T)])
    quads = np.stack(cells, -1)
    return np.where(inside[tuple(edges.T)][:, None], quads, quads[:, ::-1])


def project_to_surface(shape: Shape, vertices: Float64, step: float) -> Float64:
    """Project vertices onto the surface along its gradient, by at most half a cell."""
    points = vertices
    h = 1e-4
    for _ in range(3):
        slope = np.stack(
            [(shape(points + e) - shape(points - e)) / (2 * h) for e in h * np.eye(3)], -1
        )
        norm2 = np.maximum((slope * slope).sum(-1), 0.05)
        points = points - (shape(points) / norm2)[:, None] * slope
    displacement = points - vertices
    length = np.linalg.norm(displacement, axis=-1, keepdims=True)
    return vertices + displacement * np.minimum(1.0, 0.5 * step / np.maximum(length, 1e-12))
