"""Ray casting against triangles in a bounding volume hierarchy.

The tree is built with the surface area heuristic over bins (Wald, "On fast construction of
SAH-based bounding volume hierarchies", 2007). Rays are intersected with triangles by the watertight
test of Woop, Benthin and Wald (JCGT 2013): no ray passes between two triangles that share an edge.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Int32
from tofuse.engine.compute import kernel

MAX_LEAF_SIZE = 4
BINS = 16
# Nodes at this depth and below are split at the median, which bounds the size of the stack.
MAX_SAH_DEPTH = 40
STACK_SIZE = 64


@kernel
def build_tree(triangles: Float64) -> tuple[Float64, Int32, Int32, Int32]:
    """Build the tree over (F, 9) triangles (three corners each), F at least 1.

    Returns
    -------
    box (M, 6)
        Lowest and highest corner of each node, slightly enlarged against rounding errors.
    first (M,), count (M,)
        A leaf holds the triangles ``order[first : first + count]``; an inner node has count 0 and
        the children ``first`` and ``first + 1``.
    order (F,)
        Triangles in the order of the leaves.
    """
    size = triangles.shape[0]
    low = np.empty((size, 3))
    high = np.empty((size, 3))
    centre = np.empty((size, 3))
    for f in range(size):
        for k in range(3):
            a, b, c = triangles[f, k], triangles[f, 3 + k], triangles[f, 6 + k]
            low[f, k] = min(a, min(b, c))
            high[f, k] = max(a, max(b, c))
            centre[f, k] = 0.5 * (low[f, k] + high[f, k])
    order = np.arange(size).astype(np.int32)
    scratch = np.empty(size, np.int32)
    box = np.empty((2 * size, 6))
    first = np.zeros(2 * size, np.int32)
    count = np.zeros(2 * size, np.int32)
    stack = np.empty((2 * size, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 0, 0, size, 0
    stacked = 1
    nodes = 1
    bin_low = np.empty((BINS, 3))
    bin_high = np.empty((BINS, 3))
    bin_count = np.empty(BINS, np.int64)
    right_cost = np.empty(BINS)
    lo = np.empty(3)
    hi = np.empty(3)
    while stacked > 0:
        stacked -= 1
        node, start, stop, depth = (
            stack[stacked, 0],
            stack[stacked, 1],
            stack[stacked, 2],
            stack[stacked, 3],
        )
        for k in range(3):
            box[node, k] = np.inf
            box[node, 3 + k] = -np.inf
            lo[k] = np.inf
            hi[k] = -np.inf
        for i in range(start, stop):
            f = order[i]
            for k in range(3):
                box[node, k] = min(box[node, k], low[f, k])
                box[node, 3 + k] = max(box[node, 3 + k], high[f, k])
                lo[k] = min(lo[k], centre[f, k])
                hi[k] = max(hi[k], centre[f, k])
        length = stop - start
        if length <= MAX_LEAF_SIZE:
            first[node] = start
            count[node] = length
            continue
        best_cost = np.inf
        best_axis = -1
        best_bin = 0
        if depth < MAX_SAH_DEPTH:
            for axis in range(3):
                extent = hi[axis] - lo[axis]
                if extent <= 1e-12:
                    continue
                scale = BINS * (1 - 1e-9) / extent
                bin_low[:] = np.inf
                bin_high[:] = -np.inf
                bin_count[:] = 0
                for i in range(start, stop):
                    f = order[i]
                    b = int((centre[f, axis] - lo[axis]) * scale)
                    bin_count[b] += 1
                    for k in range(3):
                        bin_low[b, k] = min(bin_low[b, k], low[f, k])
                        bin_high[b, k] = max(bin_high[b, k], high[f, k])
                # Sweep from the right, then from the left.
                x0 = y0 = z0 = np.inf
                x1 = y1 = z1 = -np.inf
                members = 0
                for b in range(BINS - 1, 0, -1):
                    x0, x1 = min(x0, bin_low[b, 0]), max(x1, bin_high[b, 0])
                    y0, y1 = min(y0, bin_low[b, 1]), max(y1, bin_high[b, 1])
                    z0, z1 = min(z0, bin_low[b, 2]), max(z1, bin_high[b, 2])
                    members += bin_count[b]
                    right_cost[b] = 0.0
                    if members > 0:
                        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
                        right_cost[b] = members * (dx * dy + dy * dz + dz * dx)
                x0 = y0 = z0 = np.inf
                x1 = y1 = z1 = -np.inf
                members = 0
                for b in range(BINS - 1):
                    x0, x1 = min(x0, bin_low[b, 0]), max(x1, bin_high[b, 0])
                    y0, y1 = min(y0, bin_low[b, 1]), max(y1, bin_high[b, 1])
                    z0, z1 = min(z0, bin_low[b, 2]), max(z1, bin_high[b, 2])
                    members += bin_count[b]
                    if members == 0 or members == length:
                        continue
                    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
                    cost = members * (dx * dy + dy * dz + dz * dx) + right_cost[b + 1]
                    if cost < best_cost:
                        best_cost = cost
                        best_axis = axis
                        best_bin = b
        split = (start + stop) // 2
        if best_axis >= 0:
            scale = BINS * (1 - 1e-9) / (hi[best_axis] - lo[best_axis])
            split = start
            right = 0
            for i in range(start, stop):
                f = order[i]
                if int((centre[f, best_axis] - lo[best_axis]) * scale) <= best_bin:
                    order[split] = f
                    split += 1
                else:
                    scratch[right] = f
                    right += 1
            for i in range(right):
                order[split + i] = scratch[i]
        first[node] = nodes
        stack[stacked, 0], stack[stacked, 1] = nodes, start
        stack[stacked, 2], stack[stacked, 3] = split, depth + 1
        stacked += 1
        stack[stacked, 0], stack[stacked, 1] = nodes + 1, split
        stack[stacked, 2], stack[stacked, 3] = stop, depth + 1
        stacked += 1
        nodes += 2
    box = box[:nodes].copy()
    for node in range(nodes):
        for k in range(3):
            margin = 1e-9 * (1.0 + abs(box[node, k]) + abs(box[node, 3 + k]))
            box[node, k] -= margin
            box[node, 3 + k] += margin
    return box, first[:nodes].copy(), count[:nodes].copy(), order


@kernel
def cast_rays(
    box: Float64,
    first: Int32,
    count: Int32,
    triangles: Float64,
    origins: Float64,
    directions: Float64,
    distance: Float64,
    face: Int32,
    weights: Float64,
) -> None:
    """Find the nearest triangle along each ray that is nearer than the given `distance`.

    Parameters
    ----------
    box, first, count
        Tree of `build_tree`.
    triangles (F, 9)
        Corners, in the order of the leaves.
    origins (1 or N, 3), directions (N, 3)
        Rays; distances are in multiples of the direction's length.
    distance (N,), face (N,), weights (N, 2)
        Updated where a nearer triangle is hit: distance, index of the triangle (in the order of
        the leaves), and barycentric weights of its second and third corner.
    """
    stack = np.empty(STACK_SIZE, np.int32)
    shared = origins.shape[0] == 1
    for i in range(directions.shape[0]):
        j = 0 if shared else i
        ox, oy, oz = origins[j, 0], origins[j, 1], origins[j, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        # Finite inverses, as infinity times a zero offset would be NaN.
        ix = 1.0 / dx if abs(dx) > 1e-200 else 1e200
        iy = 1.0 / dy if abs(dy) > 1e-200 else 1e200
        iz = 1.0 / dz if abs(dz) > 1e-200 else 1e200
        kz = 0
        if abs(dy) > abs(dx):
            kz = 1
        if abs(dz) > max(abs(dx), abs(dy)):
            kz = 2
        kx = (kz + 1) % 3
        ky = (kz + 2) % 3
        d_major = directions[i, kz]
        if d_major == 0.0 or not np.isfinite(dx + dy + dz):
            continue
        sz = 1.0 / d_major
        sx = directions[i, kx] * sz
        sy = directions[i, ky] * sz
        px, py, pz = origins[j, kx], origins[j, ky], origins[j, kz]
        nearest = distance[i]
        hit = -1
        hit_v = 0.0
        hit_w = 0.0
        depth = 0
        node = 0
        while True:
            length = count[node]
            if length > 0:
                begin = first[node]
                for f in range(begin, begin + length):
                    az = triangles[f, kz] - pz
                    bz = triangles[f, 3 + kz] - pz
                    cz = triangles[f, 6 + kz] - pz
                    ax = triangles[f, kx] - px - sx * az
                    ay = triangles[f, ky] - py - sy * az
                    bx = triangles[f, 3 + kx] - px - sx * bz
                    by = triangles[f, 3 + ky] - py - sy * bz
                    cx = triangles[f, 6 + kx] - px - sx * cz
                    cy = triangles[f, 6 + ky] - py - sy * cz
                    u = cx * by - cy * bx
                    v = ax * cy - ay * cx
                    w = bx * ay - by * ax
                    if (u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0):
                        continue
                    total = u + v + w
                    if total == 0.0:
                        continue
                    t = (u * az + v * bz + w * cz) * sz / total
                    if 0.0 < t < nearest:
                        nearest = t
                        hit = f
                        hit_v = v / total
                        hit_w = w / total
            else:
                a = first[node]
                b = a + 1
                t0 = (box[a, 0] - ox) * ix
                t1 = (box[a, 3] - ox) * ix
                near_a = min(t0, t1)
                far_a = max(t0, t1)
                t0 = (box[a, 1] - oy) * iy
                t1 = (box[a, 4] - oy) * iy
                near_a = max(near_a, min(t0, t1))
                far_a = min(far_a, max(t0, t1))
                t0 = (box[a, 2] - oz) * iz
                t1 = (box[a, 5] - oz) * iz
                near_a = max(near_a, min(t0, t1))
                far_a = min(far_a, max(t0, t1))
                t0 = (box[b, 0] - ox) * ix
                t1 = (box[b, 3] - ox) * ix
                near_b = min(t0, t1)
                far_b = max(t0, t1)
                t0 = (box[b, 1] - oy) * iy
                t1 = (box[b, 4] - oy) * iy
                near_b = max(near_b, min(t0, t1))
                far_b = min(far_b, max(t0, t1))
                t0 = (box[b, 2] - oz) * iz
                t1 = (box[b, 5] - oz) * iz
                near_b = max(near_b, min(t0, t1))
                far_b = min(far_b, max(t0, t1))
                in_a = near_a <= far_a and far_a >= 0.0 and near_a < nearest
                in_b = near_b <= far_b and far_b >= 0.0 and near_b < nearest
                if in_a and in_b:
                    if near_b < near_a:
                        a, b = b, a
                    stack[depth] = b
                    depth += 1
                    node = a
                    continue
                if in_a:
                    node = a
                    continue
                if in_b:
                    node = b
                    continue
            if depth == 0:
                break
            depth -= 1
            node = stack[depth]
        if hit >= 0:
            distance[i] = nearest
            face[i] = hit
            weights[i, 0] = hit_v
            weights[i, 1] = hit_w
