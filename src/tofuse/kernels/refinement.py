"""Normal equations of one pair of views, in their relative pose, exposure and the camera's errors.

As in `alignment`, source points are compared with the plane and the log albedo of the target where
they land. Here every pair has its own system, and besides the pose it is told how the residuals
move with errors that all views of a camera share. With p a point of the source, q = T p where it
lands, m = R^T n the target's normal in the source's frame, and b(p) what an error of size 1 moves
the point p by, the distance moves by m . b(p) - n . b(q).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import jacobian_row, landing

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Errors of the camera, in the order of their unknowns.
OFFSET = 0  # missing from the range, m
SCALE = 1  # missing from the depth, a share
FOCAL = 2  # by which rays are wider than thought, a share
ERRORS = 3

POSE = 6
EXPOSURE = 6  # index of the exposure among the unknowns
UNKNOWNS = 7 + ERRORS

# Layout of the row of a pair.
H = 0  # upper triangle over the unknowns
G = UNKNOWNS * (UNKNOWNS + 1) // 2
LANDED = G + UNKNOWNS
COMPARED = LANDED + 1
INLIERS = COMPARED + 1
IN_FRONT = INLIERS + 1
SQUARES_M = IN_FRONT + 1  # of the inliers' distances, m^2
WEIGHT_P = SQUARES_M + 1
SQUARES_P = WEIGHT_P + 1
COST = SQUARES_P + 1  # robust cost of both terms, in squared sigmas
HISTOGRAM = COST + 1  # of distances in unscaled sigmas, quarter octaves from 1/16
BINS = 48
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
    normals: Float32,
    depth_sigma: Float32,
    source_photo: Float32,
    planes: Float32,
    plane_variance: Float32,
    target_photo: Float32,
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
    points, normals, depth_sigma, source_photo
        (N, 3) m; (N, 3) unit; (N,) sigma of z, m; (N, 3) log albedo and its slopes by ray
        coordinate, NaN where unknown.
    planes, plane_variance, target_photo
        Of the target: (H, W, 4), (H, W) variance of 1/z, (H, W, 3).
    lookup, lookup_frame
        As `projection.landing` takes them.
    T
        (4, 4) T_target_source.
    exposure
        Target log albedo minus the source's.
    scale_g, scale_p
        Sigmas of distances are multiplied by the first; the second is that of the log albedo, 0
        to leave the albedo out.
    slack
        Added in quadrature to the sigma of a distance, m.
    robust
        Residuals beyond so many sigmas count nothing (Tukey's biweight).
    min_cosine
        Smallest cosine between the normals.
    errors
        (ERRORS,) of the camera as estimated so far: points and planes are moved by them.
    known
        (ERRORS,) not 0 for errors of the camera that are not asked for.
    """
    out[:] = 0.0
    rows, columns = planes.shape[0], planes.shape[1]
    unknowns = UNKNOWNS
    while unknowns > 7 and known[unknowns - 8]:
        unknowns -= 1
    asked = unknowns - 7
    J = np.zeros(UNKNOWNS)
    K = np.zeros(6)
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
        px = np.float64(points[k, 0])
        py = np.float64(points[k, 1])
        pz = np.float64(points[k, 2])
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
        u, v, iu, iv = landing(x / (z * wider), y / (z * wider), lookup, lookup_frame)
        if iu < 0:
            continue
        if not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
            continue
        i = int(v + 0.5)
        j = int(u + 0.5)
        out[LANDED] += 1
        inverse_z = np.float64(planes[i, j, 3])
        if inverse_z <= 0:
            continue
        out[COMPARED] += 1
        a = np.float64(planes[i, j, 0])
        b = np.float64(planes[i, j, 1])
        c = np.float64(planes[i, j, 2])
        length = np.sqrt(a * a + b * b + c * c)
        r = (a * x + b * y + c * z - 1.0) / length
        if asked:
            displacement(Bq, x, y, z, known)
            for p in range(asked):
                r -= errors[p] * (a * Bq[p, 0] + b * Bq[p, 1] + c * Bq[p, 2]) / length
        m0 = (r00 * a + r10 * b + r20 * c) / length
        m1 = (r01 * a + r11 * b + r21 * c) / length
        m2 = (r02 * a + r12 * b + r22 * c) / length
        along = (m0 * px + m1 * py + m2 * pz) / pz * np.float64(depth_sigma[k])
        own = along * along + plane_variance[i, j] / (length * length)
        variance = own * scale_g * scale_g + slack * slack
        e2 = r * r / variance
        # The bin of |r| / sqrt(own), without the root.
        place = 16 + int(np.floor(2 * np.log2(max(r * r / own, 1e-18))))
        out[HISTOGRAM + min(max(place, 0), BINS - 1)] += 1
        if e2 >= limit2:
            out[COST] += limit2 / 3
            # Nearer than what the target saw there: it looked through this point.
            if z * inverse_z < 1 and e2 > 4 * limit2:
                out[IN_FRONT] += 1
            continue
        s0 = np.float64(normals[k, 0])
        s1 = np.float64(normals[k, 1])
        s2 = np.float64(normals[k, 2])
        if s0 * m0 + s1 * m1 + s2 * m2 < min_cosine:
            out[COST] += limit2 / 3
            continue
        f = 1 - e2 / limit2
        out[INLIERS] += 1
        out[SQUARES_M] += r * r
        out[COST] += limit2 / 3 * (1 - f * f * f)
        weight = f * f / variance
        # The mean of both views' normals: noise in one of them then counts half.
        jacobian_row(J, m0, m1, m2, px, py, pz)
        jacobian_row(K, s0, s1, s2, px, py, pz)
        for p in range(6):
            J[p] = 0.5 * (J[p] + K[p])
        J[EXPOSURE] = 0.0
        if asked:
            for p in range(asked):
                J[7 + p] = (m0 * Bp[p, 0] + m1 * Bp[p, 1] + m2 * Bp[p, 2]) - (
                    a * Bq[p, 0] + b * Bq[p, 1] + c * Bq[p, 2]
                ) / length
        for p in range(unknowns):
            gj = weight * J[p]
            g[p] += gj * r
            for o in range(p, unknowns):
                A[p, o] += gj * J[o]

        tx = np.float64(target_photo[i, j, 1])
        ty = np.float64(target_photo[i, j, 2])
        level = np.float64(source_photo[k, 0])
        if scale_p <= 0 or np.isnan(tx) or np.isnan(level):
            continue
        # To first order the albedo where the point lands exactly, not at the pixel's centre.
        xu = 1.0 / (lookup_frame[2] * (lookup[iv, iu + 1, 0] - lookup[iv, iu, 0]))
        yv = 1.0 / (lookup_frame[3] * (lookup[iv + 1, iu, 1] - lookup[iv, iu, 1]))
        here = target_photo[i, j, 0] + tx * (u - j) * xu + ty * (v - i) * yv
        rp = here - level - exposure
        e2 = rp * rp / (scale_p * scale_p)
        if e2 >= limit2:
            out[COST] += limit2 / 3
            continue
        f = 1 - e2 / limit2
        out[WEIGHT_P] += f * f
        out[SQUARES_P] += f * f * rp * rp
        out[COST] += limit2 / 3 * (1 - f * f * f)
        weight = f * f / (scale_p * scale_p)
        d0 = tx / (z * wider)
        d1 = ty / (z * wider)
        d2 = -(tx * x + ty * y) / (z * z * wider)
        m0 = r00 * d0 + r10 * d1 + r20 * d2
        m1 = r01 * d0 + r11 * d1 + r21 * d2
        m2 = r02 * d0 + r12 * d1 + r22 * d2
        jacobian_row(J, m0, m1, m2, px, py, pz)
        gx = np.float64(source_photo[k, 1])
        gy = np.float64(source_photo[k, 2])
        if not np.isnan(gx):
            jacobian_row(K, gx / pz, gy / pz, -(gx * px + gy * py) / (pz * pz), px, py, pz)
            for p in range(6):
                J[p] = 0.5 * (J[p] + K[p])
        J[EXPOSURE] = -1.0
        if asked:
            # Where the target's own pixels look is moved by its focal length alone.
            for p in range(asked):
                J[7 + p] = m0 * Bp[p, 0] + m1 * Bp[p, 1] + m2 * Bp[p, 2]
            if asked > FOCAL:
                J[7 + FOCAL] -= (tx * x + ty * y) / z
        for p in range(unknowns):
            gj = weight * J[p]
            g[p] += gj * rp
            for o in range(p, unknowns):
                A[p, o] += gj * J[o]
    q = H
    for p in range(UNKNOWNS):
        out[G + p] = g[p]
        for o in range(p, UNKNOWNS):
            out[q] = A[p, o]
            q += 1


@kernel
def overlap(
    points: Float32,
    normals: Float32,
    planes: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    tolerance: float,
    min_cosine: float,
) -> float:
    """Share of a view's points that another view sees too, if T (4, 4) T_target_source is right.

    Such points land where the target has a surface, at about its depth (within the share
    `tolerance`), which faces the same way.

    Parameters
    ----------
    points, normals
        (N, 3), (N, 3) of the source.
    planes, lookup, lookup_frame
        Of the target, as in `pair_equations`.
    """
    seen = 0
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z <= 0.02:
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        u, v, iu, _ = landing(x / z, y / z, lookup, lookup_frame)
        if iu < 0:
            continue
        if not (u > -0.5 and v > -0.5 and u < planes.shape[1] - 0.5 and v < planes.shape[0] - 0.5):
            continue
        i = int(v + 0.5)
        j = int(u + 0.5)
        if planes[i, j, 3] <= 0 or abs(z * planes[i, j, 3] - 1) > tolerance:
            continue
        a = planes[i, j, 0]
        b = planes[i, j, 1]
        c = planes[i, j, 2]
        cosine = (
            a * (T[0, 0] * normals[k, 0] + T[0, 1] * normals[k, 1] + T[0, 2] * normals[k, 2])
            + b * (T[1, 0] * normals[k, 0] + T[1, 1] * normals[k, 1] + T[1, 2] * normals[k, 2])
            + c * (T[2, 0] * normals[k, 0] + T[2, 1] * normals[k, 1] + T[2, 2] * normals[k, 2])
        )
        if cosine >= min_cosine * np.sqrt(a * a + b * b + c * c):
            seen += 1
    return seen / max(points.shape[0], 1)
