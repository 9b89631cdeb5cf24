"""Truncated signed distances of many views in sparse blocks of voxels (Curless and Levoy 1996).

Distances are positive in front of a surface and truncated at `reach`. Blocks are those of
`tofuse.engine.fusion.block_kernels`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int8, Int32, Int64, UInt8, UInt16
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.fusion.block_kernels import (
    EDGE,
    EMPTY,
    HALF,
    VOXELS,
    Blocks,
    block_key,
    block_of,
)

MAX_VIEWS = 65535  # at which a voxel's counter of views saturates
# Maximum number of lookup cells that are inspected to classify a block as a whole.
_MAX_CELLS = 600
_NORMAL_UNIT = np.float32(1 / 127)  # of normals stored in bytes
_MIN_WEIGHT = np.float32(1e-30)  # avoids a division by 0
# Minimum cosine of the incidence: beyond, the footprint of a pixel is too large.
_MIN_COSINE = 0.1
# Expected relief of surfaces within a window of a few pixels, as a fraction of the depth.
_RELIEF = np.float32(0.002)
# A pixel within this many sigmas is on the plane of its neighbours. Next to valid pixels it is
# restored if a filter removed it from a noisy surface.
_ON_PLANE_SIGMAS = np.float32(3.0)
# A depth jump between neighbours exceeds this multiple of sigma.
_JUMP_SIGMAS = np.float32(4.0)


class StoredView(NamedTuple):
    """A view as it is stored.

    Attributes
    ----------
    z, unit
        (H, W) z in multiples of `unit` m, 0 where there is none.
    normals, strength
        (H, W, 3) 127 times the unit normals away from the camera, and (H, W) codes of the weights;
        0 for pixels that are not fused.
    rays
        (H, W, 2) x/z and y/z.
    """

    z: UInt16
    unit: float
    normals: Int8
    strength: UInt8
    rays: Float32


class Decoding(NamedTuple):
    """Weights and truncation distances.

    Attributes
    ----------
    weights, rear_limits
        (256,) in 1/m^2, and truncation distances behind a surface in m, by weight code.
    reach
        Truncation distance in front of a surface, m.
    """

    weights: Float32
    rear_limits: Float32
    reach: float


class Batch(NamedTuple):
    """V views of one camera that are integrated together.

    Attributes
    ----------
    numbers, T_camera_world
        (V,) global numbers of the views, and (V, 4, 4).
    heights, codes
        (V, H W + 1) h of the pixel's plane n . p = h, and n and the weight code packed into four
        bytes. The last element is for all points outside the image.
    intensity
        (V, H W, C) colour or amplitude; C may be 0.
    cells, coarse
        (V, A, B, 3) for the cells of the lookup: the z in front of which all space is free, the z
        behind which all is occluded, and the smallest weight, 0 where a pixel has no surface or the
        cell has no pixel. `coarse` is the same for each 4 x 4 cells.
    """

    numbers: Int64
    T_camera_world: Float64
    heights: Float32
    codes: Int32
    intensity: Float32
    cells: Float32
    coarse: Float32


class Camera(NamedTuple):
    """Projection of the views of a batch.

    Attributes
    ----------
    shape
        (H, W) of the views.
    lookup, lookup_frame
        As in `project_ray`.
    nodes
        Number of nodes over which the lookup is linear (infinity: everywhere).
    """

    shape: tuple[int, int]
    lookup: Float32
    lookup_frame: Float64
    nodes: float


@kernel
def near_cubes(
    view: StoredView,
    T_world_camera: Float64,
    cube_m: float,
    reach: float,
    spacing: float,
    first: tuple[int, int],
    stride: int,
) -> Int64:
    """Return the keys of the cubes within `reach` of a view's surface, with duplicates.

    Parameters
    ----------
    T_world_camera
        (4, 4).
    cube_m
        Edge of a cube, m.
    reach
        Truncation distance, m.
    spacing
        Largest distance between samples along a pixel's normal, in cubes.
    first, stride
        Row and column of the first pixel, and step to the next one in both directions.
    """
    z, unit, normals, strength, rays = view
    T = T_world_camera / cube_m
    steps = max(2, int(np.ceil(2 * reach / (spacing * cube_m))))
    size = (z.shape[0] // stride + 1) * (z.shape[1] // stride + 1) * (steps + 1)
    found = np.empty(size, np.int64)
    count = 0
    last = np.full(steps + 1, EMPTY, np.int64)
    for r in range(first[0], z.shape[0], stride):
        for c in range(first[1], z.shape[1], stride):
            if z[r, c] == 0 or strength[r, c] == 0:
                continue
            depth = unit * z[r, c]
            x = depth * rays[r, c, 0]
            y = depth * rays[r, c, 1]
            n0 = normals[r, c, 0] / 127.0
            n1 = normals[r, c, 1] / 127.0
            n2 = normals[r, c, 2] / 127.0
            for s in range(steps + 1):
                t = reach * (2.0 * s / steps - 1.0)
                p0 = x + t * n0
                p1 = y + t * n1
                p2 = depth + t * n2
                i = int(np.floor(T[0, 0] * p0 + T[0, 1] * p1 + T[0, 2] * p2 + T[0, 3]))
                j = int(np.floor(T[1, 0] * p0 + T[1, 1] * p1 + T[1, 2] * p2 + T[1, 3]))
                k = int(np.floor(T[2, 0] * p0 + T[2, 1] * p1 + T[2, 2] * p2 + T[2, 3]))
                if max(abs(i), abs(j), abs(k)) >= HALF - 1:
                    continue
                key = block_key(i, j, k)
                if key != last[s]:
                    last[s] = key
                    found[count] = key
                    count += 1
    return found[:count]


@kernel
def shrink_to_planes(
    z: Float32,
    sigma: Float32,
    planes: Float32,
    plane_variance: Float32,
    smooth: Float32,
    variance: Float32,
    measured: Bool,
) -> None:
    """Shrink depths towards their local planes by the Wiener gain, relief / (relief + noise).

    Parameters
    ----------
    z, sigma
        (H, W) depth in m, 0 where there is none, and its standard deviation.
    planes, plane_variance
        (H, W, 4) of `fit_planes`, and (H, W) the variance of 1/z on them.
    smooth, variance, measured
        (H, W) written: depth in m, its variance in m^2, and whether the pixel measures its plane.
    """
    rows, columns = z.shape
    one = np.float32(1)
    for r in range(rows):
        for c in range(columns):
            depth = z[r, c]
            noise = sigma[r, c] * sigma[r, c]
            on_plane = planes[r, c, 3]
            measured[r, c] = False
            smooth[r, c] = depth
            variance[r, c] = noise
            if not on_plane > 0:
                continue
            plane = one / on_plane
            relief = (_RELIEF * depth) * (_RELIEF * depth)
            gain = relief / max(relief + noise, np.float32(1e-12))
            complement2 = (one - gain) * (one - gain)
            # dz = z^2 d(1/z); the removed part of the relief adds to the uncertainty.
            fit_variance = plane_variance[r, c] * (plane * plane) * (plane * plane)
            smooth[r, c] = plane + gain * (depth - plane)
            variance[r, c] = gain * gain * noise + complement2 * (fit_variance + min(relief, noise))
            deviation = abs(depth * on_plane - one) * depth
            measured[r, c] = depth > 0 and deviation <= _ON_PLANE_SIGMAS * sigma[r, c]


@kernel
def mark_jumps(z: Float32, sigma: Float32, fraction: float, jump: UInt8) -> None:
    """Mark the pixels on both sides of a depth edge.

    Parameters
    ----------
    z, sigma
        (H, W) depth in m, 0 where there is none, and its standard deviation.
    fraction
        An edge is a difference by more than this fraction of the depth, and by more than noise.
    jump
        (H, W) of zeros; set to 1 at edges.
    """
    rows, columns = z.shape
    min_fraction, limit = np.float32(fraction), _JUMP_SIGMAS * _JUMP_SIGMAS
    for r in range(rows):
        for c in range(columns):
            a = z[r, c]
            if not a > 0:
                continue
            noise = sigma[r, c] * sigma[r, c]
            for k in range(2):
                i, j = r + k, c + 1 - k
                if i >= rows or j >= columns:
                    continue
                b = z[i, j]
                step = abs(a - b)
                if not (b > 0 and step > min_fraction * min(a, b)):
                    continue
                if step * step > limit * (noise + sigma[i, j] * sigma[i, j]):
                    jump[r, c] = 1
                    jump[i, j] = 1


@kernel
def pack_view(
    planes: Float32,
    rays: Float32,
    lengths2: Float32,
    variance: Float32,
    valid: Bool,
    normals: Int8,
    weights: Float32,
) -> None:
    """Compute the stored normals and weights of a view, see `StoredView`.

    Parameters
    ----------
    planes
        (H, W, 4) a, b, c of a X + b Y + c Z = 1, and 1/z at the pixel; 0 without a fit, where the
        surface is assumed to face the camera.
    rays, lengths2
        (H, W, 2) x/z and y/z, and (H, W) the squared ratio of the range to z; NaN where unknown.
    variance, valid
        (H, W) of the depth in m^2, and whether the pixel is to be fused.
    normals, weights
        (H, W, 3) in units of 1/127, and (H, W) in 1/m^2, written.
    """
    rows, columns = valid.shape
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
            if valid[r, c] and cosine > _MIN_COSINE:
                distance_variance = cosine * cosine * variance[r, c]
                weights[r, c] = 1 / distance_variance


@kernel
def unpack_view(
    view: StoredView, lookup_frame: Float64, decoding: Decoding, batch: Batch, s: int
) -> None:
    """Unpack a view, except its intensity, into row `s` of a batch."""
    z, unit, normals, strength, rays = view
    weights, rear_limits, reach = decoding
    heights, codes = batch.heights[s], batch.codes[s]
    cells, coarse = batch.cells[s], batch.coarse[s]
    rows, columns = z.shape
    cells[..., 0] = np.inf
    cells[..., 1] = -np.inf
    cells[..., 2] = np.inf
    heights[rows * columns] = 0
    codes[rows * columns] = 0
    for r in range(rows):
        for c in range(columns):
            x = np.float64(rays[r, c, 0])
            y = np.float64(rays[r, c, 1])
            n0 = np.int32(normals[r, c, 0])
            n1 = np.int32(normals[r, c, 1])
            n2 = np.int32(normals[r, c, 2])
            along = (n0 * x + n1 * y + n2) / 127
            depth = z[r, c] * unit
            code = np.int32(strength[r, c]) if depth > 0 and along > 0 else np.int32(0)
            w = weights[code]
            heights[r * columns + c] = depth * along if code > 0 else 0.0
            codes[r * columns + c] = code << 24 | (n2 & 0xFF) << 16 | (n1 & 0xFF) << 8 | (n0 & 0xFF)
            fu = (x - lookup_frame[0]) * lookup_frame[2]
            fv = (y - lookup_frame[1]) * lookup_frame[3]
            if not (fu >= 0 and fv >= 0 and fu < cells.shape[1] and fv < cells.shape[0]):
                continue
            i = int(fu)
            j = int(fv)
            cells[j, i, 2] = min(cells[j, i, 2], w)
            if w > 0:
                cells[j, i, 0] = min(cells[j, i, 0], depth - reach / along)
                cells[j, i, 1] = max(cells[j, i, 1], depth + rear_limits[code] / along)
    coarse[..., 0] = np.inf
    coarse[..., 1] = -np.inf
    coarse[..., 2] = np.inf
    for j in range(cells.shape[0]):
        for i in range(cells.shape[1]):
            if cells[j, i, 2] == np.inf:
                cells[j, i, 2] = 0
            p = j // 4
            q = i // 4
            coarse[p, q, 0] = min(coarse[p, q, 0], cells[j, i, 0])
            coarse[p, q, 1] = max(coarse[p, q, 1], cells[j, i, 1])
            coarse[p, q, 2] = min(coarse[p, q, 2], cells[j, i, 2])


@kernel
def max_informative_depth(view: StoredView, rear_limits: Float32) -> float:
    """Return an upper bound of the z (m) at which a view still observes anything; 0 if nothing.

    `rear_limits` are those of `Decoding`. Voxels that project to a pixel are up to half its width
    from its ray, where its plane has another depth; a whole width is allowed for.
    """
    z, unit, normals, strength, rays = view
    rows, columns = z.shape
    far = 0.0
    for r in range(rows):
        for c in range(columns):
            code = strength[r, c]
            if z[r, c] == 0 or code == 0:
                continue
            x = np.float64(rays[r, c, 0])
            y = np.float64(rays[r, c, 1])
            n0 = normals[r, c, 0] / 127.0
            n1 = normals[r, c, 1] / 127.0
            n2 = normals[r, c, 2] / 127.0
            along = n0 * x + n1 * y + n2
            if not along > 0:
                continue
            change = 0.0
            for axis in range(2):
                max_change = -1.0
                for step in range(-1, 2, 2):
                    i = r + step * axis
                    j = c + step * (1 - axis)
                    if i < 0 or j < 0 or i >= rows or j >= columns:
                        continue
                    step_change = abs(n0 * (rays[i, j, 0] - x)) + abs(n1 * (rays[i, j, 1] - y))
                    if step_change > max_change:
                        max_change = step_change
                if max_change < 0:
                    return np.inf
                change += max_change
            if along <= change:
                return np.inf
            far = max(far, (z[r, c] * unit * along + rear_limits[code]) / (along - change))
    return far


@kernel
def _classify_ball(
    x: float,
    y: float,
    z: float,
    radius: float,
    cells: Float32,
    lookup_frame: Float64,
    margin: float,
) -> float:
    """Classify a ball around (x, y, z) in the camera's frame.

    Returns -1 if it is occluded or outside the image, a positive weight if it is entirely in free
    space, and 0 if it is neither. `margin` is half the width of a pixel, in cells.
    """
    if z + radius <= 1e-3:
        return -1.0
    if z - radius < 0.2 * z:
        return 0.0
    # Ray coordinates of the ball's bounding box, at its near and far ends.
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
        return -1.0
    inside = fu >= 0 and fv >= 0 and gu < cells.shape[1] and gv < cells.shape[0]
    min_weight = np.inf if inside else 0.0
    i0 = int(max(fu, 0))
    i1 = int(min(gu, cells.shape[1] - 1))
    j0 = int(max(fv, 0))
    j1 = int(min(gv, cells.shape[0] - 1))
    if (i1 - i0 + 1) * (j1 - j0 + 1) > _MAX_CELLS:
        return 0.0
    occluded = True
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            occluded = occluded and z - radius > cells[j, i, 1]
            min_weight = min(min_weight, cells[j, i, 2])
            if z + radius >= cells[j, i, 0]:
                min_weight = 0.0
        if not occluded and min_weight == 0:
            return 0.0
    return -1.0 if occluded else min_weight


@kernel
def _global_projection(
    lookup: Float32, lookup_frame: Float64
) -> tuple[float, float, float, float, float, float, bool]:
    """Return the projection of a camera without distortion, in the form of `_local_projection`."""
    last = lookup.shape[1] - 1
    ux = np.float64(lookup[0, last, 0] - lookup[0, 0, 0]) * lookup_frame[2] / last
    vx = np.float64(lookup[0, last, 1] - lookup[0, 0, 1]) * lookup_frame[2] / last
    last = lookup.shape[0] - 1
    uy = np.float64(lookup[last, 0, 0] - lookup[0, 0, 0]) * lookup_frame[3] / last
    vy = np.float64(lookup[last, 0, 1] - lookup[0, 0, 1]) * lookup_frame[3] / last
    x = lookup_frame[0]
    y = lookup_frame[1]
    u = np.float64(lookup[0, 0, 0]) - ux * x - uy * y
    v = np.float64(lookup[0, 0, 1]) - vx * x - vy * y
    return u, v, ux, uy, vx, vy, True


@kernel
def _local_projection(
    x: float,
    y: float,
    z: float,
    radius: float,
    lookup: Float32,
    lookup_frame: Float64,
    nodes: float,
) -> tuple[float, float, float, float, float, float, bool]:
    """Linearise the projection of a small ball around (x, y, z) in x/z and y/z.

    u = u0 + ux x/z + uy y/z, v likewise. Returns (u0, v0, ux, uy, vx, vy) and whether they are
    accurate enough: not at the border, nor for a ball across which distortion varies.
    """
    if z - radius < 0.5 * z or radius / z * max(lookup_frame[2], lookup_frame[3]) > nodes:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    u, v, i, j = projection_kernels.project_ray(x / z, y / z, lookup, lookup_frame)
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
    blocks: Blocks,
    voxel_m: float,
    batch: Batch,
    camera: Camera,
    decoding: Decoding,
    near_surface: UInt8,
    period: int,
    start: int,
    stop: int,
) -> None:
    """Integrate views of one camera, in order, into the blocks start..stop.

    Voxel (i, j, k) of a block lies at its corner plus (i, j, k) `voxel_m`. Its distance is that to
    the plane of the pixel it projects to, truncated at `reach`. A view does not observe voxels that
    are occluded: behind its surface by `reach`, or by more where the pixel is noisy. The loop over
    blocks is the outer one, so that a block is fetched once for all views.

    Far from its surface a view observes only free space. There, views are integrated round-robin:
    every `period`-th one, with `period` times its weight.

    Parameters
    ----------
    blocks
        Updated. Their numbers and those of the views determine the round-robin order.
    voxel_m
        Edge of a voxel, m.
    batch, camera, decoding
        The views.
    near_surface
        (V, B) bit mask of the octants of a block that are near a view's surface.
    period
        Period of the round-robin integration of free space.
    """
    keys, numbers, distance, weight, view_count, color, color_count, free_weight = blocks
    views, T_camera_world, heights, codes, intensity, cells, coarse = batch
    (rows, columns), lookup, lookup_frame, nodes = camera
    weights, rear_limits, reach = decoding
    half_extent = 0.5 * (EDGE - 1) * voxel_m
    radius = np.sqrt(3.0) * half_extent
    # A block that can't be classified as a whole is divided into octants.
    octant_radius = np.sqrt(3.0) * 1.5 * voxel_m
    # Half a pixel, doubled as pixels of a lens with distortion differ in size.
    margin = max(cells.shape[2] / columns, cells.shape[1] / rows)
    coarse_frame = lookup_frame.copy()
    coarse_frame[2] /= 4
    coarse_frame[3] /= 4
    # Frustum of the lookup.
    x0 = lookup_frame[0]
    y0 = lookup_frame[1]
    x1 = x0 + cells.shape[2] / lookup_frame[2]
    y1 = y0 + cells.shape[1] / lookup_frame[3]
    left = radius * np.sqrt(1 + x0 * x0)
    right = radius * np.sqrt(1 + x1 * x1)
    above = radius * np.sqrt(1 + y0 * y0)
    below = radius * np.sqrt(1 + y1 * y1)
    undistorted = nodes == np.inf
    linear = _global_projection(lookup, lookup_frame)
    code = np.empty(64, np.int32)
    d = np.empty(64, np.float32)
    w = np.empty(64, np.float32)
    rear = np.empty(64, np.float32)
    centre = np.empty(3, np.float32)
    # Offsets of an octant's voxels from its centre, in the frame of each camera.
    offsets = np.empty((len(T_camera_world), 3, 64), np.float32)
    for s in range(len(T_camera_world)):
        for q in range(64):
            for a in range(3):
                offsets[s, a, q] = voxel_m * (
                    ((q >> 4) - 1.5) * T_camera_world[s, a, 0]
                    + (((q >> 2) & 3) - 1.5) * T_camera_world[s, a, 1]
                    + ((q & 3) - 1.5) * T_camera_world[s, a, 2]
                )
    pixels = np.empty(64, np.int32)
    points = np.empty((3, 64), np.float32)
    for b in range(start, stop):
        bi, bj, bk = block_of(keys[b])
        ox = bi * EDGE * voxel_m
        oy = bj * EDGE * voxel_m
        oz = bk * EDGE * voxel_m
        mx = ox + half_extent
        my = oy + half_extent
        mz = oz + half_extent
        for s in range(len(T_camera_world)):
            # Adjacent blocks are updated by different views.
            is_turn = (views[s] + numbers[b]) % period == 0
            if near_surface[s, b] == 0 and not is_turn:
                continue
            T = T_camera_world[s]
            z = T[2, 0] * mx + T[2, 1] * my + T[2, 2] * mz + T[2, 3]
            if z + radius <= 1e-3:
                continue
            x = T[0, 0] * mx + T[0, 1] * my + T[0, 2] * mz + T[0, 3]
            if x - x0 * z < -left or x - x1 * z > right:
                continue
            y = T[1, 0] * mx + T[1, 1] * my + T[1, 2] * mz + T[1, 3]
            if y - y0 * z < -above or y - y1 * z > below:
                continue
            if near_surface[s, b] == 0:
                state = _classify_ball(x, y, z, radius, coarse[s], coarse_frame, 0.25 * margin)
                if state != 0:
                    for octant in range(8):
                        free_weight[b, octant] += period * max(0.0, state)
                    continue
            for octant in range(8):
                is_near = (near_surface[s, b] >> octant) & 1 == 1
                if not (is_near or is_turn):
                    continue
                px = ox + (4 * (octant >> 2) + 1.5) * voxel_m
                py = oy + (4 * ((octant >> 1) & 1) + 1.5) * voxel_m
                pz = oz + (4 * (octant & 1) + 1.5) * voxel_m
                x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
                y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
                z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
                if not is_near:
                    state = _classify_ball(x, y, z, octant_radius, cells[s], lookup_frame, margin)
                    if state != 0:
                        free_weight[b, octant] += period * max(0.0, state)
                        continue
                factor = 1.0 if is_near else float(period)
                centre[0] = x
                centre[1] = y
                centre[2] = z
                is_linear = undistorted
                if not undistorted:
                    linear = _local_projection(x, y, z, octant_radius, lookup, lookup_frame, nodes)
                    is_linear = linear[6]
                if is_linear:
                    _project_linear(centre, offsets[s], linear, rows, columns, pixels, points)
                else:
                    _project_by_lookup(
                        centre, offsets[s], lookup, lookup_frame, rows, columns, pixels, points
                    )
                voxels = slice(64 * octant, 64 * octant + 64)
                _fetch(pixels, heights[s], codes[s], weights, rear_limits, factor, code, d, w, rear)
                _point_to_plane(code, points, d)
                _update_distances(d, w, rear, reach, distance[b, voxels], weight[b, voxels])
                _count_views(d, reach, view_count[b, voxels])
                if intensity.shape[2]:
                    _update_colors(
                        pixels, d, reach, intensity[s], color_count[b, voxels], color[b, voxels]
                    )


@kernel
def _fetch(
    pixels: Int32,
    heights: Float32,
    codes: Int32,
    weights: Float32,
    rear_limits: Float32,
    factor: float,
    code: Int32,
    distance: Float32,
    weight: Float32,
    rear: Float32,
) -> None:
    """Fetch plane codes, heights, weights and rear truncation distances of `pixels` (64,).

    Heights are written to `distance`; weights are multiplied by `factor`.
    """
    factor32 = np.float32(factor)
    for q in range(64):
        pixel = np.uintp(pixels[q])
        code[q] = codes[pixel]
        distance[q] = heights[pixel]
        weight_code = np.uintp((codes[pixel] >> 24) & 0xFF)
        weight[q] = factor32 * weights[weight_code]
        rear[q] = rear_limits[weight_code]


@kernel
def _point_to_plane(code: Int32, points: Float32, distance: Float32) -> None:
    """Convert the planes' heights in `distance` (64,) to distances of `points` (3, 64) to them."""
    for q in range(64):
        n0 = np.float32(np.int8(code[q]))
        n1 = np.float32(np.int8(code[q] >> 8))
        n2 = np.float32(np.int8(code[q] >> 16))
        distance[q] -= _NORMAL_UNIT * (n0 * points[0, q] + n1 * points[1, q] + n2 * points[2, q])


@kernel
def _update_distances(
    new_distance: Float32,
    new_weight: Float32,
    rear: Float32,
    limit: float,
    distance: Float32,
    weight: Float32,
) -> None:
    """Update the weighted mean distances, branch-free so that the loop is vectorised.

    New distances are truncated to +-`limit`, and set to `limit` where nothing was observed.
    """
    truncation = np.float32(limit)
    for q in range(64):
        d = new_distance[q]
        new = new_weight[q] if d >= -rear[q] else np.float32(0)
        d = d if d < truncation and new > 0 else truncation
        d = d if d > -truncation else -truncation
        total = weight[q] + new
        distance[q] += (d - distance[q]) * (new / max(total, _MIN_WEIGHT))
        weight[q] = total
        new_distance[q] = d


@kernel
def _count_views(distance: Float32, limit: float, view_count: UInt16) -> None:
    """Increment the saturating view counters of voxels whose surface is within `limit`."""
    truncation = np.float32(limit)
    max_views = np.uint16(MAX_VIEWS)
    for q in range(64):
        view_count[q] += np.uint16((distance[q] < truncation) & (view_count[q] < max_views))


@kernel
def _update_colors(
    pixels: Int32,
    distance: Float32,
    limit: float,
    intensity: Float32,
    color_count: UInt16,
    color: Float32,
) -> None:
    """Update the mean colour of the voxels whose surface is within `limit`.

    Black means that there is no colour, and is not averaged.
    """
    truncation, max_views = np.float32(limit), np.uint16(MAX_VIEWS)
    for q in range(64):
        if not distance[q] < truncation:
            continue
        has_color = False
        for n in range(intensity.shape[1]):
            has_color = has_color or intensity[pixels[q], n] > 0
        if has_color:
            color_count[q] += np.uint16(color_count[q] < max_views)
            inv_count = np.float32(1) / np.float32(color_count[q])
            for n in range(intensity.shape[1]):
                color[q, n] += (intensity[pixels[q], n] - color[q, n]) * inv_count


@kernel
def _project_linear(
    centre: Float32,
    offsets: Float32,
    linear: tuple[float, float, float, float, float, float, bool],
    rows: int,
    columns: int,
    pixels: Int32,
    points: Float32,
) -> None:
    """Project the voxels of an octant of a block, branch-free so that the loop is vectorised.

    Parameters
    ----------
    centre, offsets
        (3,) of the octant in the camera's frame, and (3, 64) voxels relative to it.
    linear
        From `_local_projection`.
    rows, columns
        Size of the image.
    pixels
        (64,) written: row * columns + column, or rows * columns outside the image.
    points
        (3, 64) written: the voxels in the camera's frame.
    """
    u0, v0 = np.float32(linear[0] + 1.5), np.float32(linear[1] + 1.5)
    ux, uy = np.float32(linear[2]), np.float32(linear[3])
    vx, vy = np.float32(linear[4]), np.float32(linear[5])
    min_depth, one = np.float32(1e-3), np.float32(1)
    for a in range(3):
        for q in range(64):
            points[a, q] = centre[a] + offsets[a, q]
    for q in range(64):
        x, y, z = points[0, q], points[1, q], points[2, q]
        inv_z = one / z
        # The conversion truncates towards zero; adding 1 first makes it round down.
        c = np.int32(u0 + (ux * x + uy * y) * inv_z) - np.int32(1)
        r = np.int32(v0 + (vx * x + vy * y) * inv_z) - np.int32(1)
        inside = (z >= min_depth) & (c >= 0) & (r >= 0) & (c < columns) & (r < rows)
        pixels[q] = r * columns + c if inside else rows * columns


@kernel
def _project_by_lookup(
    centre: Float32,
    offsets: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    rows: int,
    columns: int,
    pixels: Int32,
    points: Float32,
) -> None:
    """Do the same as `_project_linear`, by interpolation in the lookup for each voxel."""
    for q in range(64):
        for a in range(3):
            points[a, q] = centre[a] + offsets[a, q]
        pixels[q] = rows * columns
        z = points[2, q]
        if z < 1e-3:
            continue
        u, v, node, _ = projection_kernels.project_ray(
            points[0, q] / z, points[1, q] / z, lookup, lookup_frame
        )
        if node < 0 or not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
            continue
        pixels[q] = int(v + 0.5) * columns + int(u + 0.5)


@kernel
def apply_free_space(blocks: Blocks, reach: float, start: int, stop: int) -> None:
    """Integrate the free-space weights of whole octants into the voxels of blocks start..stop."""
    distance, weight, free_weight = blocks.distance, blocks.weight, blocks.free_weight
    for b in range(start, stop):
        for v in range(VOXELS):
            new = free_weight[b, v >> 6]
            if new > 0:
                total = weight[b, v] + new
                distance[b, v] += (reach - distance[b, v]) * new / total
                weight[b, v] = total
        free_weight[b] = 0
