"""Normal equations of one pair of views, in their relative pose, exposure and the camera's errors.

As in `alignment`, source points are compared with the plane and the log albedo of the target where
they land. Here every pair has its own system, and besides the pose it is told how the residuals
move with errors that all views of a camera share. With p a point of the source, q = T p where it
lands, m = R^T n the target's normal in the source's frame, and b(p) what an error of size 1 moves
the point p by, the distance moves by m . b(p) - n . b(q).
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64, Int64
from tofuse.kernels.alignment import (
    ALBEDO,
    ALBEDO_SLOPE,
    BINS,
    COUNT_P,
    DISTANCE,
    INLIERS,
    JACOBIAN,
    LANES,
    LIGHT,
    LIGHT_SLOPE,
    NORMAL,
    PLANE,
    POINT,
    RATIO,
    ROWS,
    SEEN,
    SIGMA,
    SQUARES_G,
    STAT,
    VARIANCE,
    WEIGHT_G,
    albedos,
    distances,
    histogram_bin,
    land,
    load,
    move,
)
from tofuse.kernels.alignment import IN_FRONT as FRONT
from tofuse.kernels.alignment import SQUARES_P as ALBEDO_SQUARES
from tofuse.kernels.alignment import WEIGHT_P as ALBEDO_WEIGHT
from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import jacobian_row, landing

# Errors of the camera, in the order of their unknowns.
OFFSET = 0  # missing from the range, m
SCALE = 1  # missing from the depth, a share
FOCAL = 2  # by which rays are wider than thought, a share
ERRORS = 3

EXPOSURE = 6  # index of the exposure among the unknowns
UNKNOWNS = 7 + ERRORS

# Layout of the row of a pair.
H = 0  # upper triangle over the unknowns
G = UNKNOWNS * (UNKNOWNS + 1) // 2
COMPARED = G + UNKNOWNS  # points that land where the target has a plane
IN_FRONT = COMPARED + 1  # points in free space of the target
WEIGHT_P = IN_FRONT + 1  # sums of the robust weights and squares of the log albedo's residuals
SQUARES_P = WEIGHT_P + 1
TERMS = SQUARES_P + 1  # residuals of both terms
SUPPORT = TERMS + 1  # their robust costs (Tukey's biweight), from 1 for none to 0 for the largest
HISTOGRAM = SUPPORT + 1  # as in `alignment`
SIZE = HISTOGRAM + BINS


@kernel
def displacement(B: Float64, x: float, y: float, z: float, known: Int64) -> None:
    """What errors of size 1 move the point (x, y, z) of a camera's frame by, into B (ERRORS, 3).

    `known` (ERRORS,) says which errors are taken to be 0.
    """
    for k in range(ERRORS):
        B[k, 0] = B[k, 1] = B[k, 2] = 0.0
    if not known[OFFSET]:
        r = np.sqrt(x * x + y * y + z * z)
        B[OFFSET, 0] = x / r
        B[OFFSET, 1] = y / r
        B[OFFSET, 2] = z / r
    if not known[SCALE]:
        B[SCALE, 0] = x
        B[SCALE, 1] = y
        B[SCALE, 2] = z
    if not known[FOCAL]:
        B[FOCAL, 0] = x
        B[FOCAL, 1] = y


@kernel
def pair_equations(
    points: Float32,
    target: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    exposure: float,
    scale_g: float,
    scale_p: float,
    slack: float,
    robust: float,
    min_cosine: float,
    errors: Float64,
    known: Int64,
    out: Float64,
) -> None:
    """Sum the normal equations of one pair into `out` (SIZE,), which is overwritten.

    Parameters
    ----------
    points, target, lookup, lookup_frame, T, exposure, scale_g, scale_p, slack, robust, min_cosine
        As in `alignment.accumulate`.
    errors
        (ERRORS,) of the camera as estimated so far: points and planes are moved by them.
    known
        (ERRORS,) not 0 for errors of the camera that are not asked for.
    """
    out[:] = 0.0
    rows, columns = target.shape[0], target.shape[1]
    unknowns = UNKNOWNS
    while unknowns > 7 and known[unknowns - 8]:
        unknowns -= 1
    asked = unknowns - 7
    if asked == 0:
        _pose_equations(
            points, target, lookup, lookup_frame, T, exposure, scale_g, scale_p, slack, robust,
            min_cosine, out,
        )  # fmt: skip
        return
    J = np.zeros(UNKNOWNS)
    Bp = np.zeros((ERRORS, 3))
    Bq = np.zeros((ERRORS, 3))
    A = np.zeros((UNKNOWNS, UNKNOWNS))
    g = np.zeros(UNKNOWNS)
    limit2 = robust * robust
    wider = 1.0 + errors[FOCAL]
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for k in range(points.shape[0]):
        point = points[k]
        px = np.float64(point[POINT])
        py = np.float64(point[POINT + 1])
        pz = np.float64(point[POINT + 2])
        if asked:
            displacement(Bp, px, py, pz, known)
            for p in range(asked):
                px += errors[p] * Bp[p, 0]
                py += errors[p] * Bp[p, 1]
                pz += errors[p] * Bp[p, 2]
        z = r20 * px + r21 * py + r22 * pz + t2
        if z <= 0.02:
            continue
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        # Where the target looks for it: its rays are wider than it thinks.
        xn = x / (z * wider)
        yn = y / (z * wider)
        u, v, iu, _ = landing(xn, yn, lookup, lookup_frame)
        if iu < 0:
            continue
        if not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
            continue
        pixel = target[int(v + 0.5), int(u + 0.5)]
        distance = np.float64(pixel[DISTANCE])
        if distance == 0:
            continue
        out[COMPARED] += 1
        out[TERMS] += 1
        n0 = np.float64(pixel[PLANE])
        n1 = np.float64(pixel[PLANE + 1])
        n2 = np.float64(pixel[PLANE + 2])
        across = n0 * x + n1 * y + n2 * z
        r = across - distance
        if asked:
            displacement(Bq, x, y, z, known)
            for p in range(asked):
                r -= errors[p] * (n0 * Bq[p, 0] + n1 * Bq[p, 1] + n2 * Bq[p, 2])
        along = (across - (n0 * t0 + n1 * t1 + n2 * t2)) * np.float64(point[SIGMA])
        own = along * along + np.float64(pixel[VARIANCE])
        variance = own * scale_g * scale_g + slack * slack
        r2 = r * r
        out[HISTOGRAM + histogram_bin(r2 / own)] += 1
        e2 = r2 / variance / limit2
        if e2 >= 1:
            # Nearer than what the target saw there: it looked through this point.
            if r < 0 and e2 > 4:
                out[IN_FRONT] += 1
            continue
        m0 = r00 * n0 + r10 * n1 + r20 * n2
        m1 = r01 * n0 + r11 * n1 + r21 * n2
        m2 = r02 * n0 + r12 * n1 + r22 * n2
        s0 = np.float64(point[NORMAL])
        s1 = np.float64(point[NORMAL + 1])
        s2 = np.float64(point[NORMAL + 2])
        if s0 * m0 + s1 * m1 + s2 * m2 < min_cosine:
            continue
        f = 1 - e2
        out[SUPPORT] += f * f * f
        # The mean of both views' normals: noise in one of them then counts half.
        m0, m1, m2 = 0.5 * (m0 + s0), 0.5 * (m1 + s1), 0.5 * (m2 + s2)
        jacobian_row(J, m0, m1, m2, px, py, pz)
        J[EXPOSURE] = 0.0
        # In the errors the same mean: else the difference of both views' normals, which no motion
        # explains, would seem to tell of them.
        n0 = r00 * m0 + r01 * m1 + r02 * m2
        n1 = r10 * m0 + r11 * m1 + r12 * m2
        n2 = r20 * m0 + r21 * m1 + r22 * m2
        for p in range(asked):
            J[7 + p] = (m0 * Bp[p, 0] + m1 * Bp[p, 1] + m2 * Bp[p, 2]) - (
                n0 * Bq[p, 0] + n1 * Bq[p, 1] + n2 * Bq[p, 2]
            )
        _add(A, g, J, r, f * f / variance, unknowns)

        tx = np.float64(pixel[ALBEDO_SLOPE])
        level = np.float64(point[LIGHT])
        if scale_p <= 0 or np.isnan(tx) or np.isnan(level):
            continue
        ty = np.float64(pixel[ALBEDO_SLOPE + 1])
        r = np.float64(pixel[ALBEDO]) + tx * xn + ty * yn - level - exposure
        out[TERMS] += 1
        r2 = r * r
        e2 = r2 / (scale_p * scale_p) / limit2
        if e2 >= 1:
            continue
        f = 1 - e2
        out[WEIGHT_P] += f * f
        out[SQUARES_P] += f * f * r2
        out[SUPPORT] += f * f * f
        # d(x/z, y/z) by the moved point, then back into the source frame.
        d0 = tx / (z * wider)
        d1 = ty / (z * wider)
        d2 = -(tx * xn + ty * yn) / z
        m0 = r00 * d0 + r10 * d1 + r20 * d2
        m1 = r01 * d0 + r11 * d1 + r21 * d2
        m2 = r02 * d0 + r12 * d1 + r22 * d2
        s0 = np.float64(point[LIGHT_SLOPE])
        s1 = np.float64(point[LIGHT_SLOPE + 1])
        s2 = np.float64(point[LIGHT_SLOPE + 2])
        m0, m1, m2 = 0.5 * (m0 + s0), 0.5 * (m1 + s1), 0.5 * (m2 + s2)
        jacobian_row(J, m0, m1, m2, px, py, pz)
        J[EXPOSURE] = -1.0
        for p in range(asked):
            J[7 + p] = m0 * Bp[p, 0] + m1 * Bp[p, 1] + m2 * Bp[p, 2]
        if asked > FOCAL:
            # Where the target's own pixels look is moved by its focal length alone.
            J[7 + FOCAL] -= (r00 * m0 + r01 * m1 + r02 * m2) * x
            J[7 + FOCAL] -= (r10 * m0 + r11 * m1 + r12 * m2) * y
        _add(A, g, J, r, f * f / (scale_p * scale_p), unknowns)
    q = H
    for p in range(UNKNOWNS):
        out[G + p] = g[p]
        for o in range(p, UNKNOWNS):
            out[q] = A[p, o]
            q += 1


@kernel
def _pose_equations(
    points: Float32,
    target: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    exposure: float,
    scale_g: float,
    scale_p: float,
    slack: float,
    robust: float,
    min_cosine: float,
    out: Float64,
) -> None:
    """Do the same where no error of the camera is asked for: in blocks, as `alignment` does."""
    block = np.zeros(ROWS * LANES, np.float32)
    # Products of the rows of J and r, then what is counted or summed of each column.
    products, support = 36, 36 + SQUARES_G - INLIERS
    sums = np.zeros((36 + COUNT_P + 1 - INLIERS, LANES))
    for first in range(0, len(points), LANES):
        count = min(LANES, len(points) - first)
        load(block, points[first : first + count])
        move(block, T)
        land(block, count, target, lookup, lookup_frame)
        distances(block, T, scale_g, slack, robust, min_cosine)
        for k in range(count):
            if block[SEEN * LANES + k] > 0:
                out[COMPARED] += 1
                out[HISTOGRAM + histogram_bin(block[RATIO * LANES + k])] += 1
        _add_block(sums, block)
        _add_cubes(sums[support], block, WEIGHT_G)
        if scale_p > 0:
            albedos(block, T, exposure, scale_p, robust)
            _add_block(sums, block)
            _add_cubes(sums[support], block, ALBEDO_WEIGHT)
        for which in (FRONT, ALBEDO_WEIGHT, ALBEDO_SQUARES, COUNT_P):
            place = which - INLIERS
            total = sums[products + place]
            row = block[(STAT + place) * LANES : (STAT + place + 1) * LANES]
            for k in range(LANES):
                total[k] += row[k]
    width = LANES
    while width > 1:
        width //= 2
        for q in range(len(sums)):
            low, high = sums[q, :width], sums[q, width:]
            for k in range(width):
                low[k] += high[k]
    q, place = 0, H
    for p in range(8):
        for o in range(p, 8):
            if p < 7 and o < 7:
                out[place] = sums[q, 0]
                place += 1
            elif p < 7:
                out[G + p] = sums[q, 0]
            q += 1
        place += ERRORS  # with which nothing was asked
    out[IN_FRONT] = sums[products + FRONT - INLIERS, 0]
    out[WEIGHT_P] = sums[products + ALBEDO_WEIGHT - INLIERS, 0]
    out[SQUARES_P] = sums[products + ALBEDO_SQUARES - INLIERS, 0]
    out[TERMS] = out[COMPARED] + sums[products + COUNT_P - INLIERS, 0]
    out[SUPPORT] = sums[support, 0]


@kernel
def _add_block(sums: Float64, block: Float32) -> None:
    """Add the products of the rows of J and r, column by column."""
    q = 0
    for p in range(8):
        a = block[(JACOBIAN + p) * LANES : (JACOBIAN + p + 1) * LANES]
        for o in range(p, 8):
            b = block[(JACOBIAN + o) * LANES : (JACOBIAN + o + 1) * LANES]
            total = sums[q]
            for k in range(LANES):
                total[k] += a[k] * b[k]
            q += 1


@kernel
def _add_cubes(total: Float64, block: Float32, which: int) -> None:
    """Add the cubes of the roots of robust weights: 1 where the residual is 0."""
    place = STAT + which - INLIERS
    row = block[place * LANES : (place + 1) * LANES]
    for k in range(LANES):
        total[k] += row[k] * np.sqrt(row[k])


@kernel
def _add(A: Float64, g: Float64, J: Float64, r: float, weight: float, unknowns: int) -> None:
    """Add w J J^T to the upper triangle of A, and w r J to g."""
    for p in range(unknowns):
        weighted = weight * J[p]
        g[p] += weighted * r
        for o in range(p, unknowns):
            A[p, o] += weighted * J[o]


@kernel
def overlaps(
    points: Float32,
    starts: Int64,
    sources: Int64,
    target: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    T_target_world: Float64,
    T_world_source: Float64,
    tolerance: float,
    min_cosine: float,
    least: float,
    out: Float64,
) -> None:
    """Share of other views' points that a target sees too, into `out` (S,); 0 if below `least`.

    Such points land where the target has a surface, lie within a share `tolerance` of its
    distance from it, and face the same way.

    Parameters
    ----------
    points, starts
        (M, POINT_SIZE) points of all views, those of view k from starts[k] to starts[k + 1].
    sources
        (S,) the views to look at.
    target, lookup, lookup_frame
        As in `pair_equations`.
    T_target_world, T_world_source
        (4, 4) of the target, and (N, 4, 4) of all views.
    """
    rows, columns = target.shape[0], target.shape[1]
    T = np.empty((3, 4))
    for s in range(len(sources)):
        pose = T_world_source[sources[s]]
        for a in range(3):
            for b in range(4):
                T[a, b] = T_target_world[a, 3] if b == 3 else 0.0
                for c in range(3):
                    T[a, b] += T_target_world[a, c] * pose[c, b]
        start, stop = starts[sources[s]], starts[sources[s] + 1]
        # So many that are not seen, and it is too few, whatever follows.
        spare = (stop - start) - least * (stop - start) + 1e-9
        seen = 0
        for k in range(start, stop):
            if k - start - seen > spare:
                break
            px, py, pz = points[k, POINT], points[k, POINT + 1], points[k, POINT + 2]
            z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            if z <= 0.02:
                continue
            x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
            y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
            u, v, iu, _ = landing(x / z, y / z, lookup, lookup_frame)
            if iu < 0:
                continue
            if not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
                continue
            pixel = target[int(v + 0.5), int(u + 0.5)]
            n0, n1, n2, distance = pixel[PLANE], pixel[PLANE + 1], pixel[PLANE + 2], pixel[DISTANCE]
            if distance == 0 or abs(n0 * x + n1 * y + n2 * z - distance) > tolerance * z:
                continue
            nx, ny, nz = points[k, NORMAL], points[k, NORMAL + 1], points[k, NORMAL + 2]
            cosine = (
                n0 * (T[0, 0] * nx + T[0, 1] * ny + T[0, 2] * nz)
                + n1 * (T[1, 0] * nx + T[1, 1] * ny + T[1, 2] * nz)
                + n2 * (T[2, 0] * nx + T[2, 1] * ny + T[2, 2] * nz)
            )
            if cosine >= min_cosine:
                seen += 1
        share = seen / max(stop - start, 1)
        out[s] = share if share >= least else 0.0
