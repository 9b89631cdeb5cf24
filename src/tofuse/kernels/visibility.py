"""Whether the views that made a surface could see it past all other surfaces.

Behind a surface a view says nothing, so what a wrong pixel puts there stays, for nobody contradicts
it. But its light would have had to pass through the surface. Blocks are those of
`tofuse.kernels.blocks`, distances those of `tofuse.kernels.tsdf`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.blocks import EDGE, HALF, block_key, block_of, slot_of, voxel_at
from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import landing

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]

# Voxels from a surface to where another one may begin, and sigmas by which it must be there.
_APART = 2.0
_SURE = 9.0


@kernel
def _solid(distance: float, weight: float, voxel_m: float) -> bool:
    """Whether a voxel is behind a surface, by a voxel and by more than its noise."""
    return distance <= -voxel_m and distance * distance * weight >= _SURE


@kernel
def mark_covered(
    keys: Int64,
    neighbours: Int32,
    blocks: Int32,
    voxel_m: float,
    distance: Float32,
    weight: Float32,
    points: Float64,
    normals: Float32,
    covered: NDArray[np.bool_],
    start: int,
    stop: int,
) -> None:
    """Mark vertices start..stop with another surface's back before them, up to a block away.

    Parameters
    ----------
    keys, neighbours
        (B,) blocks, and (B, 27) those around each, of `neighbours_of`.
    blocks
        (N,) row of the block of each vertex.
    points, normals
        (N, 3) vertices, and unit vectors to where it is free.
    covered
        (N,) gets True or False.
    """
    for p in range(start, stop):
        covered[p] = False
        b = blocks[p]
        bi, bj, bk = block_of(keys[b])
        # In voxels from the block's corner, to the nearest one.
        x = points[p, 0] / voxel_m - bi * EDGE + 0.5
        y = points[p, 1] / voxel_m - bj * EDGE + 0.5
        z = points[p, 2] / voxel_m - bk * EDGE + 0.5
        for s in range(int(_APART), EDGE + 1):
            i = int(np.floor(x + s * normals[p, 0]))
            j = int(np.floor(y + s * normals[p, 1]))
            k = int(np.floor(z + s * normals[p, 2]))
            a = (i >> 3) + 1
            c = (j >> 3) + 1
            e = (k >> 3) + 1
            if min(a, c, e) < 0 or max(a, c, e) > 2:
                break
            row = neighbours[b, 9 * a + 3 * c + e]
            if row < 0:
                continue
            v = voxel_at(i & 7, j & 7, k & 7)
            if _solid(distance[row, v], weight[row, v], voxel_m):
                covered[p] = True
                break


@kernel
def _passes(
    point: Float64,
    to: Float64,
    voxel_m: float,
    table: Int64,
    rows: Int32,
    distance: Float32,
    weight: Float32,
) -> bool:
    """Whether the way from a point to another one meets no surface's back."""
    d0 = (to[0] - point[0]) / voxel_m
    d1 = (to[1] - point[1]) / voxel_m
    d2 = (to[2] - point[2]) / voxel_m
    length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    if not length > 0:
        return True
    d0, d1, d2 = d0 / length, d1 / length, d2 / length
    x = point[0] / voxel_m + 0.5
    y = point[1] / voxel_m + 0.5
    z = point[2] / voxel_m + 0.5
    last = -1
    row = -1
    t = _APART
    while t < length:
        i = int(np.floor(x + t * d0))
        j = int(np.floor(y + t * d1))
        k = int(np.floor(z + t * d2))
        if max(abs(i), abs(j), abs(k)) >= EDGE * (HALF - 1):
            return True
        key = block_key(i >> 3, j >> 3, k >> 3)
        if key != last:
            last = key
            slot = slot_of(table, key)
            row = int(rows[slot]) if table[slot] == key else -1
        if row < 0:
            # To the end of the empty block.
            out = length
            if d0 != 0:
                out = min(out, (((i >> 3) + (d0 > 0)) * EDGE - x) / d0)
            if d1 != 0:
                out = min(out, (((j >> 3) + (d1 > 0)) * EDGE - y) / d1)
            if d2 != 0:
                out = min(out, (((k >> 3) + (d2 > 0)) * EDGE - z) / d2)
            t = max(t + 1e-3, out + 1e-3)
            continue
        v = voxel_at(i & 7, j & 7, k & 7)
        if _solid(distance[row, v], weight[row, v], voxel_m):
            return False
        t += 1.0
    return True


@kernel
def count_witnesses(
    points: Float64,
    normals: Float32,
    T_world_camera: Float64,
    T_camera_world: Float64,
    z: NDArray[np.uint16],
    unit: float,
    planes: NDArray[np.int8],
    strength: NDArray[np.uint8],
    weights: Float32,
    rays: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    reach: float,
    voxel_m: float,
    table: Int64,
    rows: Int32,
    distance: Float32,
    weight: Float32,
    votes: Float64,
    start: int,
    stop: int,
) -> None:
    """Add a view's weight to the votes of the vertices start..stop that it measured.

    A view measured a vertex if the plane of the pixel on which it lands is within `reach`, on the
    side that the vertex faces.

    Parameters
    ----------
    points, normals
        (K, 3) vertices in the world, and unit vectors to where it is free.
    z, unit, planes, strength, weights, rays
        Of `open_view`; `planes` are its normals.
    table, rows
        Of `index_of`.
    votes
        (K, 2) weight of the views that could see it, and of those that see it through a surface.
    """
    height, width = z.shape
    camera = T_world_camera[:3, 3].copy()
    T = T_camera_world
    for p in range(start, stop):
        x, y, depth = points[p, 0], points[p, 1], points[p, 2]
        facing = 0.0
        for a in range(3):
            facing += normals[p, a] * (camera[a] - points[p, a])
        if not facing > 0:
            continue
        cz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * depth + T[2, 3]
        if not cz > 1e-3:
            continue
        cx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * depth + T[0, 3]
        cy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * depth + T[1, 3]
        u, v, node, _ = landing(cx / cz, cy / cz, lookup, lookup_frame)
        if node < 0 or not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        r = int(v + 0.5)
        c = int(u + 0.5)
        w = weights[strength[r, c]]
        if z[r, c] == 0 or not w > 0:
            continue
        n0 = planes[r, c, 0] / 127.0
        n1 = planes[r, c, 1] / 127.0
        n2 = planes[r, c, 2] / 127.0
        h = unit * z[r, c] * (n0 * rays[r, c, 0] + n1 * rays[r, c, 1] + n2)
        if abs(h - n0 * cx - n1 * cy - n2 * cz) > reach:
            continue
        if _passes(points[p], camera, voxel_m, table, rows, distance, weight):
            votes[p, 0] += w
        else:
            votes[p, 1] += w
