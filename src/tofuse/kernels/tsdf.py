"""Signed distances in sparse blocks of voxels (Curless and Levoy 1996; Nießner et al. 2013).

Space is cut into blocks of 8 x 8 x 8 voxels, of which only those near surfaces are kept. A block is
known by a 63-bit key; tables of keys are open-addressed with linear probing. Distances are positive
in front of a surface and cut at `reach`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import landing

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
UInt16 = NDArray[np.uint16]

EDGE = 8  # voxels along the edge of a block
VOXELS = EDGE**3
EMPTY = -1  # of a table of keys
_HALF = 1 << 20
_MASK = (1 << 21) - 1
# How many cells of the grid of rays are looked through before a block is taken voxel by voxel.
_MOST_CELLS = 600


@kernel
def block_key(i: int, j: int, k: int) -> int:
    """Key of the block (i, j, k), each from -2^20 to 2^20 - 1."""
    return ((i + _HALF) << 42) | ((j + _HALF) << 21) | (k + _HALF)


@kernel
def block_of(key: int) -> tuple[int, int, int]:
    """Block (i, j, k) of a key."""
    return (key >> 42) - _HALF, ((key >> 21) & _MASK) - _HALF, (key & _MASK) - _HALF


@kernel
def slot_of(table: Int64, key: int) -> int:
    """Where `key` is in the table (a power of two long), or the empty place where it belongs."""
    # Fibonacci hashing: the upper bits of the product depend on all bits of the key.
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    mask = len(table) - 1
    slot = np.int64(mixed >> np.uint64(32)) & mask
    while table[slot] != EMPTY and table[slot] != key:
        slot = (slot + 1) & mask
    return int(slot)


@kernel
def _grown(table: Int64) -> Int64:
    larger = np.full(2 * len(table), EMPTY, np.int64)
    for key in table:
        if key != EMPTY:
            larger[slot_of(larger, key)] = key
    return larger


@kernel
def touch_blocks(
    pixels: Float32,
    rays: Float32,
    T_world_camera: Float64,
    block_m: float,
    reach: float,
    table: Int64,
    count: int,
) -> tuple[Int64, int]:
    """Enter the blocks within `reach` of the surface that a view shows.

    `pixels` are those of `unpack_view`. Returns the table, a larger one if it had to grow, and how
    many keys it holds now.
    """
    rows, columns = pixels.shape[:2]
    steps = max(2, int(np.ceil(2 * reach / (0.34 * block_m))))
    last = np.full(steps + 1, EMPTY, np.int64)
    R = T_world_camera
    for r in range(rows):
        for c in range(columns):
            if not pixels[r, c, 4] > 0:
                continue
            n0 = np.float64(pixels[r, c, 0])
            n1 = np.float64(pixels[r, c, 1])
            n2 = np.float64(pixels[r, c, 2])
            x = np.float64(rays[r, c, 0])
            y = np.float64(rays[r, c, 1])
            z = pixels[r, c, 3] / (n0 * x + n1 * y + n2)
            for s in range(steps + 1):
                t = reach * (2.0 * s / steps - 1.0)
                p0 = z * x + t * n0
                p1 = z * y + t * n1
                p2 = z + t * n2
                i = int(np.floor((R[0, 0] * p0 + R[0, 1] * p1 + R[0, 2] * p2 + R[0, 3]) / block_m))
                j = int(np.floor((R[1, 0] * p0 + R[1, 1] * p1 + R[1, 2] * p2 + R[1, 3]) / block_m))
                k = int(np.floor((R[2, 0] * p0 + R[2, 1] * p1 + R[2, 2] * p2 + R[2, 3]) / block_m))
                if max(abs(i), abs(j), abs(k)) >= _HALF - 1:
                    continue
                key = block_key(i, j, k)
                if key == last[s]:
                    continue
                last[s] = key
                slot = slot_of(table, key)
                if table[slot] == EMPTY:
                    table[slot] = key
                    count += 1
                    if 2 * count > len(table):
                        table = _grown(table)
    return table, count


@kernel
def neighbours_of(keys: Int64, out: Int32) -> None:
    """Rows of the 27 blocks around each block, itself in the middle; -1 where there is none.

    `keys` (B,) are distinct. Column 9 a + 3 b + c of `out` (B, 27) is the block at the offset
    (a - 1, b - 1, c - 1).
    """
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, EMPTY, np.int64)
    rows = np.empty(size, np.int32)
    for b in range(len(keys)):
        slot = slot_of(table, keys[b])
        table[slot] = keys[b]
        rows[slot] = b
    for b in range(len(keys)):
        i, j, k = block_of(keys[b])
        for n in range(27):
            key = block_key(i + n // 9 - 1, j + n // 3 % 3 - 1, k + n % 3 - 1)
            slot = slot_of(table, key)
            out[b, n] = rows[slot] if table[slot] == key else -1


@kernel
def pack_view(
    planes: Float32,
    rays: Float32,
    lengths2: Float32,
    variance: Float32,
    good: NDArray[np.bool_],
    least_cosine: float,
    unfitted: float,
    normals: NDArray[np.int8],
    weights: Float32,
) -> None:
    """Fill what `unpack_view` needs of a view: `normals` (H, W, 3), and `weights` (H, W) in 1/m^2.

    Parameters
    ----------
    planes
        (H, W, 4) a, b, c of a X + b Y + c Z = 1, and 1/z on it: 0 where none is fitted.
    rays, lengths2
        (H, W, 2) x/z and y/z, and (H, W) the squared ratio of the range to z; NaN where unknown.
    variance, good
        (H, W) of the depth in m^2, and whether it is to be believed.
    least_cosine
        Of the incidence of light that is believed.
    unfitted
        Weights without a plane, which then faces the camera, count so many times.
    """
    rows, columns = good.shape
    for r in range(rows):
        for c in range(columns):
            length = np.sqrt(lengths2[r, c])
            fitted = planes[r, c, 3] > 0
            if fitted:
                x, y, z = planes[r, c, 0], planes[r, c, 1], planes[r, c, 2]
            else:
                x, y, z = rays[r, c, 0], rays[r, c, 1], np.float32(1)
            norm = np.sqrt(x * x + y * y + z * z)
            weights[r, c] = 0
            if not (norm > 0 and length > 0):
                normals[r, c, 0] = normals[r, c, 1] = normals[r, c, 2] = 0
                continue
            x, y, z = x / norm, y / norm, z / norm
            normals[r, c, 0] = np.int8(np.rint(np.float32(127) * x))
            normals[r, c, 1] = np.int8(np.rint(np.float32(127) * y))
            normals[r, c, 2] = np.int8(np.rint(np.float32(127) * z))
            cosine = (x * rays[r, c, 0] + y * rays[r, c, 1] + z) / length
            if good[r, c] and cosine > least_cosine:
                of_distance = cosine * cosine * variance[r, c]
                weights[r, c] = (1.0 if fitted else unfitted) / of_distance


@kernel
def unpack_view(
    z: UInt16,
    unit: float,
    normals: NDArray[np.int8],
    strength: NDArray[np.uint8],
    weights: Float32,
    rays: Float32,
    pixels: Float32,
) -> None:
    """Fill `pixels` (H, W, 5): the plane n . p = h of each pixel as n, h, and its weight.

    `z` counts in `unit` m; `normals` are 127 times unit vectors away from the camera, and
    `weights` (256,) decodes `strength`, of which 0 is weight 0.
    """
    rows, columns = z.shape
    for r in range(rows):
        for c in range(columns):
            w = weights[strength[r, c]]
            pixels[r, c, 4] = 0
            if z[r, c] == 0 or not w > 0:
                continue
            n0 = normals[r, c, 0] / 127.0
            n1 = normals[r, c, 1] / 127.0
            n2 = normals[r, c, 2] / 127.0
            along = n0 * rays[r, c, 0] + n1 * rays[r, c, 1] + n2
            if not along > 0:
                continue
            pixels[r, c, 0] = n0
            pixels[r, c, 1] = n1
            pixels[r, c, 2] = n2
            pixels[r, c, 3] = z[r, c] * unit * along
            pixels[r, c, 4] = w


@kernel
def ray_cells(
    pixels: Float32, rays: Float32, lookup_frame: Float64, reach: float, cells: Float32
) -> None:
    """Bounds of what a view shows, for cells of a grid over ray coordinates.

    `cells` (A, B, 3) gets the z before which all in the cell is free, the z behind which all is
    hidden, and the least weight: 0 where a pixel shows nothing, or the cell has no pixel.
    """
    cells[..., 0] = np.inf
    cells[..., 1] = -np.inf
    cells[..., 2] = np.inf
    for r in range(pixels.shape[0]):
        for c in range(pixels.shape[1]):
            x = rays[r, c, 0]
            y = rays[r, c, 1]
            fu = (x - lookup_frame[0]) * lookup_frame[2]
            fv = (y - lookup_frame[1]) * lookup_frame[3]
            if not (fu >= 0 and fv >= 0 and fu < cells.shape[1] and fv < cells.shape[0]):
                continue
            i = int(fu)
            j = int(fv)
            w = pixels[r, c, 4]
            cells[j, i, 2] = min(cells[j, i, 2], w)
            if w > 0:
                along = pixels[r, c, 0] * x + pixels[r, c, 1] * y + pixels[r, c, 2]
                z = pixels[r, c, 3] / along
                cells[j, i, 0] = min(cells[j, i, 0], z - reach / along)
                cells[j, i, 1] = max(cells[j, i, 1], z + reach / along)
    for j in range(cells.shape[0]):
        for i in range(cells.shape[1]):
            if cells[j, i, 2] == np.inf:
                cells[j, i, 2] = 0


@kernel
def _bounds(
    x: float,
    y: float,
    z: float,
    radius: float,
    cells: Float32,
    lookup_frame: Float64,
    margin: float,
) -> tuple[float, float, float]:
    """Free before, hidden behind, least weight for a ball around (x, y, z) in the camera's frame.

    Hidden behind minus infinity: the view shows nothing of it. `margin` is the half width of a
    pixel, in cells.
    """
    if z - radius < 0.2 * z:
        return -np.inf, np.inf, 0.0
    # Ray coordinates of the ball's box, at its near and far end.
    near = 1 / (z - radius)
    far = 1 / (z + radius)
    a = min((x - radius) * near, (x - radius) * far)
    b = max((x + radius) * near, (x + radius) * far)
    fu = (a - lookup_frame[0]) * lookup_frame[2] - margin
    gu = (b - lookup_frame[0]) * lookup_frame[2] + margin
    a = min((y - radius) * near, (y - radius) * far)
    b = max((y + radius) * near, (y + radius) * far)
    fv = (a - lookup_frame[1]) * lookup_frame[3] - margin
    gv = (b - lookup_frame[1]) * lookup_frame[3] + margin
    if gu < 0 or gv < 0 or fu >= cells.shape[1] or fv >= cells.shape[0]:
        return 0.0, -np.inf, 0.0
    least = np.inf
    if fu < 0 or fv < 0 or gu >= cells.shape[1] or gv >= cells.shape[0]:
        least = 0.0
    i0 = int(max(fu, 0))
    i1 = int(min(gu, cells.shape[1] - 1))
    j0 = int(max(fv, 0))
    j1 = int(min(gv, cells.shape[0] - 1))
    if (i1 - i0 + 1) * (j1 - j0 + 1) > _MOST_CELLS:
        return -np.inf, np.inf, 0.0
    low = np.inf
    high = -np.inf
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            low = min(low, cells[j, i, 0])
            high = max(high, cells[j, i, 1])
            least = min(least, cells[j, i, 2])
    return low, high, least


@kernel
def _linear(
    x: float, y: float, z: float, radius: float, lookup: Float32, lookup_frame: Float64
) -> tuple[float, float, float, float, float, float, bool]:
    """Where points of a small ball around (x, y, z) land, as a linear function of x/z and y/z.

    u = u0 + ux x/z + uy y/z, v likewise: (u0, v0, ux, uy, vx, vy), and whether that will do: not
    for balls that a bent lens shows bent, nor at the border.
    """
    if z - radius < 0.5 * z or radius / z * max(lookup_frame[2], lookup_frame[3]) > 2:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    u, v, i, j = landing(x / z, y / z, lookup, lookup_frame)
    if i < 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    ux = np.float64(lookup[j, i + 1, 0] - lookup[j, i, 0]) * lookup_frame[2]
    vx = np.float64(lookup[j, i + 1, 1] - lookup[j, i, 1]) * lookup_frame[2]
    uy = np.float64(lookup[j + 1, i, 0] - lookup[j, i, 0]) * lookup_frame[3]
    vy = np.float64(lookup[j + 1, i, 1] - lookup[j, i, 1]) * lookup_frame[3]
    if max(abs(ux), abs(vx), abs(uy), abs(vy)) > 1e5:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False  # a node that the camera does not see
    return u - (ux * x + uy * y) / z, v - (vx * x + vy * y) / z, ux, uy, vx, vy, True


@kernel
def integrate(
    keys: Int64,
    voxel_m: float,
    T_camera_world: Float64,
    pixels: Float32,
    light: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    cells: Float32,
    reach: float,
    distance: Float32,
    weight: Float32,
    seen: UInt16,
    color: Float32,
    free: Float32,
    start: int,
    stop: int,
) -> None:
    """Add a view to blocks start..stop.

    Voxel (i, j, k) of a block lies at its corner plus (i, j, k) `voxel_m`. Its distance is that to
    the plane of the pixel that it lands on, cut at `reach`; behind `reach` nothing is known.

    Parameters
    ----------
    pixels, cells, light
        Of `unpack_view` and `ray_cells`; light (H, W, C), C may be 0.
    distance, weight
        (B, VOXELS) mean distance in m, and the sum of the weights.
    seen
        (B, VOXELS) how many views saw a surface within `reach`.
    color
        (B, VOXELS, C) mean light of those views.
    free
        (B, 8) weight of the views that saw through all of an eighth, not yet in `distance`.
    """
    T = T_camera_world
    rows, columns = pixels.shape[:2]
    channels = light.shape[2]
    middle = 0.5 * (EDGE - 1) * voxel_m
    radius = np.sqrt(3.0) * middle
    # Half a pixel, and as much for lenses whose pixels differ in size.
    margin = max(cells.shape[1] / columns, cells.shape[0] / rows)
    # A block is cut in eight where it can't be told as a whole.
    small = np.sqrt(3.0) * 1.5 * voxel_m
    corner = np.empty(3, np.float32)
    step = np.empty((3, 3), np.float32)
    place = np.empty(64, np.int32)
    points = np.empty((3, 64), np.float32)
    limit = np.float32(reach)
    one = np.float32(1)
    for b in range(start, stop):
        bi, bj, bk = block_of(keys[b])
        ox = bi * EDGE * voxel_m
        oy = bj * EDGE * voxel_m
        oz = bk * EDGE * voxel_m
        z = T[2, 0] * (ox + middle) + T[2, 1] * (oy + middle) + T[2, 2] * (oz + middle) + T[2, 3]
        if z + radius <= 1e-3:
            continue
        x = T[0, 0] * (ox + middle) + T[0, 1] * (oy + middle) + T[0, 2] * (oz + middle) + T[0, 3]
        y = T[1, 0] * (ox + middle) + T[1, 1] * (oy + middle) + T[1, 2] * (oz + middle) + T[1, 3]
        low, high, least = _bounds(x, y, z, radius, cells, lookup_frame, margin)
        if z - radius > high:
            continue
        if least > 0 and z + radius < low:
            for part in range(8):
                free[b, part] += least
            continue
        for part in range(8):
            i0 = 4 * (part >> 2)
            j0 = 4 * ((part >> 1) & 1)
            k0 = 4 * (part & 1)
            px = ox + (i0 + 1.5) * voxel_m
            py = oy + (j0 + 1.5) * voxel_m
            pz = oz + (k0 + 1.5) * voxel_m
            z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            if z + small <= 1e-3:
                continue
            x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
            y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
            low, high, least = _bounds(x, y, z, small, cells, lookup_frame, margin)
            if z - small > high:
                continue
            if least > 0 and z + small < low:
                free[b, part] += least
                continue
            for a in range(3):
                corner[a] = np.float32(T[a, 0] * px + T[a, 1] * py + T[a, 2] * pz + T[a, 3])
                for q in range(3):
                    corner[a] -= np.float32(1.5 * voxel_m * T[a, q])
                    step[q, a] = np.float32(voxel_m * T[a, q])
            linear = _linear(x, y, z, small, lookup, lookup_frame)
            if linear[6]:
                _land_linear(corner, step, linear, high, rows, columns, place, points)
            else:
                _land_bent(corner, step, lookup, lookup_frame, high, rows, columns, place, points)
            for q in range(64):
                if place[q] < 0:
                    continue
                r = place[q] >> 16
                c = place[q] & 0xFFFF
                new = pixels[r, c, 4]
                if not new > 0:
                    continue
                d = pixels[r, c, 3] - (
                    pixels[r, c, 0] * points[0, q]
                    + pixels[r, c, 1] * points[1, q]
                    + pixels[r, c, 2] * points[2, q]
                )
                if d < -limit:
                    continue
                v = ((i0 + (q >> 4)) << 6) | ((j0 + ((q >> 2) & 3)) << 3) | (k0 + (q & 3))
                if d < limit:
                    if seen[b, v] < 65535:
                        seen[b, v] += 1
                    # Black is no colour: it is neither kept from before nor mixed in.
                    lit = False
                    tinted = False
                    for n in range(channels):
                        lit = lit or light[r, c, n] > 0
                        tinted = tinted or color[b, v, n] > 0
                    if lit:
                        share = one / np.float32(seen[b, v]) if tinted else one
                        for n in range(channels):
                            color[b, v, n] += (light[r, c, n] - color[b, v, n]) * share
                else:
                    d = limit
                total = weight[b, v] + new
                distance[b, v] += (d - distance[b, v]) * (new / total)
                weight[b, v] = total


@kernel
def _land_linear(
    corner: Float32,
    step: Float32,
    linear: tuple[float, float, float, float, float, float, bool],
    high: float,
    rows: int,
    columns: int,
    place: Int32,
    points: Float32,
) -> None:
    """Voxels of an eighth of a block in the camera's frame, and the pixels that they land on.

    One formula without a branch, for several voxels at a time in the processor.

    Parameters
    ----------
    corner, step
        (3,) the first voxel, and (3, 3) from one to the next along i, j and k.
    linear
        Of `_linear`.
    high
        Largest z.
    place
        (64,) gets row * 65536 + column, or -1.
    points
        (3, 64) gets the voxels.
    """
    u0, v0 = np.float32(linear[0] + 1.5), np.float32(linear[1] + 1.5)
    ux, uy = np.float32(linear[2]), np.float32(linear[3])
    vx, vy = np.float32(linear[4]), np.float32(linear[5])
    nearest, farthest, one = np.float32(1e-3), np.float32(high), np.float32(1)
    for i in range(4):
        for j in range(4):
            x0 = corner[0] + np.float32(i) * step[0, 0] + np.float32(j) * step[1, 0]
            y0 = corner[1] + np.float32(i) * step[0, 1] + np.float32(j) * step[1, 1]
            z0 = corner[2] + np.float32(i) * step[0, 2] + np.float32(j) * step[1, 2]
            for k in range(4):
                q = 16 * i + 4 * j + k
                points[0, q] = x0 + np.float32(k) * step[2, 0]
                points[1, q] = y0 + np.float32(k) * step[2, 1]
                points[2, q] = z0 + np.float32(k) * step[2, 2]
    for q in range(64):
        x, y, z = points[0, q], points[1, q], points[2, q]
        per_z = one / z
        # Whole numbers are cut towards zero: so one is added before and taken off after.
        c = np.int32(u0 + (ux * x + uy * y) * per_z) - np.int32(1)
        r = np.int32(v0 + (vx * x + vy * y) * per_z) - np.int32(1)
        inside = (z >= nearest) & (z <= farthest) & (c >= 0) & (r >= 0) & (c < columns) & (r < rows)
        place[q] = (r << 16) | c if inside else np.int32(-1)


@kernel
def _land_bent(
    corner: Float32,
    step: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    high: float,
    rows: int,
    columns: int,
    place: Int32,
    points: Float32,
) -> None:
    """As `_land_linear`, each voxel by the lens."""
    for q in range(64):
        for a in range(3):
            points[a, q] = (
                corner[a]
                + np.float32(q >> 4) * step[0, a]
                + np.float32((q >> 2) & 3) * step[1, a]
                + np.float32(q & 3) * step[2, a]
            )
        place[q] = -1
        z = points[2, q]
        if z < 1e-3 or z > high:
            continue
        u, v, node, _ = landing(points[0, q] / z, points[1, q] / z, lookup, lookup_frame)
        if node < 0 or not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
            continue
        place[q] = (int(v + 0.5) << 16) | int(u + 0.5)


@kernel
def settle_free(
    distance: Float32, weight: Float32, free: Float32, reach: float, start: int, stop: int
) -> None:
    """Put the weight of views that saw through whole eighths of blocks into their voxels."""
    for b in range(start, stop):
        for v in range(VOXELS):
            # Voxel (i, j, k) is in the part of the upper bits of its three numbers.
            new = free[b, (v >> 6) & 4 | (v >> 4) & 2 | (v >> 2) & 1]
            if new > 0:
                total = weight[b, v] + new
                distance[b, v] += (reach - distance[b, v]) * new / total
                weight[b, v] = total
        free[b] = 0
