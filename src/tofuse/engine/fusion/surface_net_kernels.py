"""The zero level set of signed distances in blocks, by surface nets (Gibson 1998).

Each cell of eight adjacent voxels that the surface passes through has one vertex, the mean of the
points where the surface crosses the cell's edges; the four cells around a crossed edge make two
triangles. Blocks are those of `tsdf_kernels`; cells extend into the adjacent blocks, so that there
are no seams.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Int32, Int64
from tofuse.engine.compute import kernel
from tofuse.engine.fusion.block_kernels import EDGE, VOXELS, Blocks, block_of, voxel_index, voxel_of

_SIDE = EDGE + 1


class Vertices(NamedTuple):
    """N vertices of a surface net.

    Attributes
    ----------
    points, normals
        (N, 3) world frame, m, and (N, 3) normalised gradient.
    colors
        (N, C) mean colour of the corners that have one; 0 if none has.
    sigma
        (N,) inverse root of the corners' mean weight, m.
    views
        (N,) largest number of views among the corners.
    """

    points: Float64
    normals: Float32
    colors: Float32
    sigma: Float32
    views: Int32


@kernel
def _locate(i: int, j: int, k: int) -> tuple[int, int]:
    """Return neighbour and voxel of (i, j, k), each from -1 to EDGE, relative to a block."""
    n = 9 * ((i >> 3) + 1) + 3 * ((j >> 3) + 1) + (k >> 3) + 1
    return n, voxel_index(i & 7, j & 7, k & 7)


@kernel
def _load_distances(
    b: int, neighbours: Int32, distance: Float32, weight: Float32, min_weight: float, out: Float32
) -> bool:
    """Write distances (9, 9, 9) of a block and the next voxels, NaN if unknown; do signs differ?"""
    below = False
    above = False
    for i in range(_SIDE):
        for j in range(_SIDE):
            for k in range(_SIDE):
                n, v = _locate(i, j, k)
                row = neighbours[b, n]
                d = np.float32(np.nan)
                if row >= 0 and weight[row, v] > min_weight:
                    d = distance[row, v]
                    below |= d < 0
                    above |= d >= 0
                out[i, j, k] = d
    return below and above


@kernel
def mark_cells(
    blocks: Blocks,
    neighbours: Int32,
    min_weight: float,
    min_views: int,
    cells: Int32,
    counts: Int64,
    start: int,
    stop: int,
) -> None:
    """Number the cells of blocks start..stop that contain a vertex.

    These are cells whose corners all have a weight above `min_weight`, whose distances have both
    signs, and of which at least one corner was observed by `min_views` views. Writes `cells`
    (B, VOXELS), the number within the block or -1, and `counts` (B,), the number of such cells.
    """
    distance, weight, view_count = blocks.distance, blocks.weight, blocks.view_count
    d = np.empty((_SIDE, _SIDE, _SIDE), np.float32)
    for b in range(start, stop):
        cells[b] = -1
        counts[b] = 0
        if not _load_distances(b, neighbours, distance, weight, min_weight, d):
            continue
        number = 0
        for v in range(VOXELS):
            i, j, k = voxel_of(v)
            below = 0
            above = 0
            max_views = 0
            for q in range(8):
                x = d[i + (q >> 2), j + ((q >> 1) & 1), k + (q & 1)]
                if x < 0:
                    below += 1
                elif x >= 0:
                    above += 1
                else:
                    break
            if below == 0 or above == 0 or below + above < 8:
                continue
            for q in range(8):
                n, w = _locate(i + (q >> 2), j + ((q >> 1) & 1), k + (q & 1))
                max_views = max(max_views, view_count[neighbours[b, n], w])
            if max_views < min_views:
                continue
            cells[b, v] = number
            number += 1
        counts[b] = number


@kernel
def make_vertices(
    blocks: Blocks,
    voxel_m: float,
    neighbours: Int32,
    cells: Int32,
    starts: Int64,
    vertices: Vertices,
    start: int,
    stop: int,
) -> None:
    """Write the vertices of the marked cells of blocks start..stop, from row starts[b] on."""
    keys, distance, weight = blocks.keys, blocks.distance, blocks.weight
    view_count, color, color_count = blocks.view_count, blocks.color, blocks.color_count
    points, normals, colors, sigmas, views = vertices
    d = np.empty((2, 2, 2))
    channels = color.shape[2]
    color_sum = np.zeros(channels)
    crossing_sum = np.zeros(3)
    g = np.zeros(3)
    c = np.zeros(3, np.int64)
    for b in range(start, stop):
        bi, bj, bk = block_of(keys[b])
        row = starts[b]
        for v in range(VOXELS):
            if cells[b, v] < 0:
                continue
            i, j, k = voxel_of(v)
            color_sum[:] = 0
            color_views = 0.0
            total = 0.0
            max_views = 0
            for q in range(8):
                n, w = _locate(i + (q >> 2), j + ((q >> 1) & 1), k + (q & 1))
                m = neighbours[b, n]
                d[q >> 2, (q >> 1) & 1, q & 1] = distance[m, w]
                total += weight[m, w]
                max_views = max(max_views, view_count[m, w])
                if channels > 0:
                    color_views += color_count[m, w]
                for s in range(channels):
                    color_sum[s] += color_count[m, w] * color[m, w, s]
            crossing_sum[:] = 0
            g[:] = 0
            crossings = 0
            for axis in range(3):
                for p in range(4):
                    c[axis] = 0
                    c[(axis + 1) % 3] = p >> 1
                    c[(axis + 2) % 3] = p & 1
                    d0 = d[c[0], c[1], c[2]]
                    c[axis] = 1
                    d1 = d[c[0], c[1], c[2]]
                    g[axis] += d1 - d0
                    if (d0 < 0) != (d1 < 0):
                        crossings += 1
                        crossing_sum[axis] += d0 / (d0 - d1)
                        crossing_sum[(axis + 1) % 3] += p >> 1
                        crossing_sum[(axis + 2) % 3] += p & 1
            points[row, 0] = (bi * EDGE + i + crossing_sum[0] / crossings) * voxel_m
            points[row, 1] = (bj * EDGE + j + crossing_sum[1] / crossings) * voxel_m
            points[row, 2] = (bk * EDGE + k + crossing_sum[2] / crossings) * voxel_m
            length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
            for axis in range(3):
                # A gradient of 0 has no direction; any unit vector will do.
                normals[row, axis] = g[axis] / length if length > 0 else np.float64(axis == 2)
            for s in range(channels):
                colors[row, s] = color_sum[s] / max(color_views, 1.0)
            sigmas[row] = 1 / np.sqrt(total / 8)
            views[row] = max_views
            row += 1


@kernel
def _vertex(b: int, i: int, j: int, k: int, neighbours: Int32, cells: Int32, starts: Int64) -> int:
    n, v = _locate(i, j, k)
    row = neighbours[b, n]
    if row < 0 or cells[row, v] < 0:
        return -1
    return starts[row] + cells[row, v]


@kernel
def make_faces(
    neighbours: Int32,
    distance: Float32,
    cells: Int32,
    starts: Int64,
    points: Float64,
    firsts: Int64,
    faces: Int32,
    counts: Int64,
    fill: bool,
    start: int,
    stop: int,
) -> None:
    """Make the triangles around the crossed edges that begin in blocks start..stop.

    They are counter-clockwise as seen from positive distances. Without `fill` only `counts` (B,) is
    written, with it also `faces`, from row firsts[b] on. Quads are split along the shorter
    diagonal.
    """
    p = np.zeros(3, np.int64)
    quad = np.zeros(4, np.int64)
    for b in range(start, stop):
        number = 0
        for v in range(VOXELS):
            i, j, k = voxel_of(v)
            if cells[b, v] < 0:
                continue
            d0 = distance[b, v]
            for axis in range(3):
                p[0] = i
                p[1] = j
                p[2] = k
                p[axis] += 1
                n, w = _locate(p[0], p[1], p[2])
                if (d0 < 0) == (distance[neighbours[b, n], w] < 0):
                    continue
                p[axis] -= 1
                complete = True
                for q in range(4):
                    # (0, 0), (-1, 0), (-1, -1), (0, -1) along the two other axes.
                    a = (axis + 1) % 3
                    e = (axis + 2) % 3
                    da = 1 if q == 1 or q == 2 else 0
                    de = 1 if q >= 2 else 0
                    p[a] -= da
                    p[e] -= de
                    quad[q] = _vertex(b, p[0], p[1], p[2], neighbours, cells, starts)
                    p[a] += da
                    p[e] += de
                    complete &= quad[q] >= 0
                if not complete:
                    continue
                if fill:
                    if d0 >= 0:
                        quad[1], quad[3] = quad[3], quad[1]
                    diagonal02 = 0.0
                    diagonal13 = 0.0
                    for s in range(3):
                        diagonal02 += (points[quad[0], s] - points[quad[2], s]) ** 2
                        diagonal13 += (points[quad[1], s] - points[quad[3], s]) ** 2
                    o = 0 if diagonal02 <= diagonal13 else 1
                    row = firsts[b] + number
                    for s in range(3):
                        faces[row, s] = quad[(o + s) % 4]
                        faces[row + 1, s] = quad[(o + (s + 2) % 4) % 4]
                number += 2
        counts[b] = number
