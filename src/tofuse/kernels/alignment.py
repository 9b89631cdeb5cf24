"""Normal equations of projective point-to-plane alignment with a photometric term.

Source points p are moved into the target by T, projected, and compared with the plane and the
albedo at the pixel they land on. With the plane a X + b Y + c Z = 1 of the target the residual is
its distance (a X + b Y + c Z - 1) / |(a, b, c)|, and its Jacobian by the right perturbation of T
is (m, p x m), with m = R^T n.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import jacobian_row, landing

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Layout of what `accumulate` returns.
GEOMETRY_H = 0  # 21: upper triangle of the 6x6
GEOMETRY_G = 21  # 6
PHOTO_H = 27  # 28: upper triangle of the 7x7; the seventh unknown is the exposure
PHOTO_G = 55  # 7
CROSS_G = 62  # 21: symmetrised product of the Jacobians of target and source, geometry
CROSS_P = 83  # 28: the same of the photometric term
LANDED = 111  # points that land on a pixel of the target
COMPARED = 112  # of those, points at which the target has a plane
INLIERS = 113  # of those, points within the reach and with a compatible normal
IN_FRONT = 114  # points in free space of the target
WEIGHT_G = 115  # sums of the robust weights and of weighted squared residuals, in sigmas
SQUARES_G = 116
WEIGHT_P = 117
SQUARES_P = 118
COUNT_P = 119
SQUARES_M = 120  # of the inliers' distances, m^2
HISTOGRAM = 121  # of all compared points' distances in unscaled sigmas, quarter octaves from 1/16
BINS = 48
SIZE = HISTOGRAM + BINS


@kernel
def accumulate(
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
    start: int,
    stop: int,
) -> Float64:
    """Sum the normal equations over the points start..stop.

    Parameters
    ----------
    points, normals, depth_sigma, source_photo
        (N, 3) m; (N, 3) unit, 0 where unknown; (N,) sigma of z, m; (N, 3) log albedo and its
        slopes by ray coordinate, NaN where unknown.
    planes, plane_variance, target_photo
        Of the target: (H, W, 4), (H, W) variance of 1/z, (H, W, 3).
    lookup, lookup_frame
        (A, B, 2) pixel of each node of a grid over ray coordinates, and (x0, y0, 1/dx, 1/dy).
    T
        (4, 4) T_target_source.
    exposure
        Target log albedo minus the source's.
    scale_g, scale_p
        Sigmas are multiplied by the first; the second is the sigma of the log albedo.
    slack
        Added in quadrature to the sigma of a distance, m: forgives what is still misaligned.
    robust
        Residuals beyond so many sigmas count nothing (Tukey's biweight).
    min_cosine
        Smallest cosine between the normals.
    """
    out = np.zeros(SIZE)
    rows, columns = planes.shape[0], planes.shape[1]
    J = np.empty(7)
    K = np.empty(7)
    limit2 = robust * robust
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for k in range(start, stop):
        px = np.float64(points[k, 0])
        py = np.float64(points[k, 1])
        pz = np.float64(points[k, 2])
        z = r20 * px + r21 * py + r22 * pz + t2
        if z <= 0.02:
            continue
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        xn = x / z
        yn = y / z
        u, v, iu, iv = landing(xn, yn, lookup, lookup_frame)
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
        a = np.float64(planes[i, j, 0])
        b = np.float64(planes[i, j, 1])
        c = np.float64(planes[i, j, 2])
        out[COMPARED] += 1
        length = np.sqrt(a * a + b * b + c * c)
        na = a / length
        nb = b / length
        nc = c / length
        r = (a * x + b * y + c * z - 1.0) / length
        # m = R^T n, the target's normal in the source frame (away from the camera).
        m0 = r00 * na + r10 * nb + r20 * nc
        m1 = r01 * na + r11 * nb + r21 * nc
        m2 = r02 * na + r12 * nb + r22 * nc
        along = (m0 * px + m1 * py + m2 * pz) / pz
        sz = np.float64(depth_sigma[k]) * scale_g
        source_variance = along * along * sz * sz
        target_variance = plane_variance[i, j] * scale_g * scale_g / (length * length)
        variance = source_variance + target_variance + slack * slack
        e2 = r * r / variance
        s0 = np.float64(normals[k, 0])
        s1 = np.float64(normals[k, 1])
        s2 = np.float64(normals[k, 2])
        known = s0 != 0 or s1 != 0 or s2 != 0
        own = np.sqrt((source_variance + target_variance) / (scale_g * scale_g))
        place = 16 + int(np.floor(4 * np.log2(max(abs(r) / own, 1e-9))))
        out[HISTOGRAM + min(max(place, 0), BINS - 1)] += 1
        if e2 >= limit2:
            # Nearer than what the target saw there: it looked through this point.
            if z * inverse_z < 1 and r * r > 4 * limit2 * variance:
                out[IN_FRONT] += 1
            continue
        if known and s0 * m0 + s1 * m1 + s2 * m2 < min_cosine:
            continue
        f = 1 - e2 / limit2
        weight = f * f
        out[INLIERS] += 1
        out[SQUARES_M] += r * r
        out[WEIGHT_G] += weight
        out[SQUARES_G] += weight * e2
        g = weight / variance
        jacobian_row(J, m0, m1, m2, px, py, pz)
        if known:
            jacobian_row(K, s0, s1, s2, px, py, pz)
            q = 0
            for p in range(6):
                for o in range(p, 6):
                    out[CROSS_G + q] += 0.5 * g * (J[p] * K[o] + K[p] * J[o])
                    q += 1
            for p in range(6):
                J[p] = 0.5 * (J[p] + K[p])
        q = 0
        for p in range(6):
            gj = g * J[p]
            out[GEOMETRY_G + p] += gj * r
            for o in range(p, 6):
                out[GEOMETRY_H + q] += gj * J[o]
                q += 1

        tx = np.float64(target_photo[i, j, 1])
        ty = np.float64(target_photo[i, j, 2])
        level = np.float64(source_photo[k, 0])
        if scale_p <= 0 or np.isnan(tx) or np.isnan(level):
            continue
        # To first order the albedo where the point lands exactly, not at the pixel's centre. The
        # pixel's own ray follows from the lookup's local slope.
        xu = 1.0 / (lookup_frame[2] * (lookup[iv, iu + 1, 0] - lookup[iv, iu, 0]))
        yv = 1.0 / (lookup_frame[3] * (lookup[iv + 1, iu, 1] - lookup[iv, iu, 1]))
        here = target_photo[i, j, 0] + tx * (u - j) * xu + ty * (v - i) * yv
        rp = here - level - exposure
        e2 = rp * rp / (scale_p * scale_p)
        out[COUNT_P] += 1
        if e2 >= limit2:
            continue
        f = 1 - e2 / limit2
        weight = f * f
        out[WEIGHT_P] += weight
        out[SQUARES_P] += weight * rp * rp
        g = weight / (scale_p * scale_p)
        # d(x/z, y/z) by the moved point, then back into the source frame.
        d0 = tx / z
        d1 = ty / z
        d2 = -(tx * xn + ty * yn) / z
        m0 = r00 * d0 + r10 * d1 + r20 * d2
        m1 = r01 * d0 + r11 * d1 + r21 * d2
        m2 = r02 * d0 + r12 * d1 + r22 * d2
        jacobian_row(J, m0, m1, m2, px, py, pz)
        J[6] = -1.0
        gx = np.float64(source_photo[k, 1])
        gy = np.float64(source_photo[k, 2])
        if not np.isnan(gx):
            s0 = gx / pz
            s1 = gy / pz
            s2 = -(gx * px + gy * py) / (pz * pz)
            jacobian_row(K, s0, s1, s2, px, py, pz)
            K[6] = -1.0
            q = 0
            for p in range(7):
                for o in range(p, 7):
                    out[CROSS_P + q] += 0.5 * g * (J[p] * K[o] + K[p] * J[o])
                    q += 1
            for p in range(6):
                J[p] = 0.5 * (J[p] + K[p])
        q = 0
        for p in range(7):
            gj = g * J[p]
            out[PHOTO_G + p] += gj * rp
            for o in range(p, 7):
                out[PHOTO_H + q] += gj * J[o]
                q += 1
    return out


@kernel
def moved(T: Float64, xi: Float64) -> Float64:
    """T * exp(xi), (4, 4), with the rotation brought back to orthogonality to first order."""
    t = xi[:3]
    w = xi[3:]
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-4:
        s1 = 1 - angle2 / 6
        s2 = 0.5 - angle2 / 24
        s3 = 1.0 / 6 - angle2 / 120
    else:
        s1 = np.sin(angle) / angle
        s2 = (1 - np.cos(angle)) / angle2
        s3 = (angle - np.sin(angle)) / (angle2 * angle)
    W = np.zeros((3, 3))
    W[0, 1], W[0, 2] = -w[2], w[1]
    W[1, 0], W[1, 2] = w[2], -w[0]
    W[2, 0], W[2, 1] = -w[1], w[0]
    R = np.eye(3)
    V = np.eye(3)
    for i in range(3):
        for j in range(3):
            square = 0.0
            for k in range(3):
                square += W[i, k] * W[k, j]
            R[i, j] += s1 * W[i, j] + s2 * square
            V[i, j] += s2 * W[i, j] + s3 * square
    out = np.zeros((4, 4))
    for i in range(3):
        out[i, 3] = T[i, 3]
        for j in range(3):
            step = 0.0
            for k in range(3):
                out[i, j] += T[i, k] * R[k, j]
                step += V[j, k] * t[k]
            out[i, 3] += T[i, j] * step
    # One Newton step towards orthogonality: R (3 - R^T R) / 2.
    G = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                G[i, j] += out[k, i] * out[k, j]
    fixed = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                h = (3.0 if k == j else 0.0) - G[k, j]
                fixed[i, j] += 0.5 * out[i, k] * h
    out[:3, :3] = fixed
    out[3, 3] = 1
    return out


@kernel
def normal_equations(total: Float64, photometric: bool) -> tuple[Float64, Float64, Float64]:
    """Unpack what `accumulate` summed: H (7, 7), g (7,) and the cross-information (7, 7).

    The seventh unknown is the exposure; without the photometric term its row is that of the unit
    matrix in H and 0 in the cross-information.
    """
    H = np.zeros((7, 7))
    C = np.zeros((7, 7))
    g = np.zeros(7)
    q = 0
    for p in range(6):
        g[p] = total[GEOMETRY_G + p]
        for o in range(p, 6):
            H[p, o] = total[GEOMETRY_H + q]
            C[p, o] = total[CROSS_G + q]
            q += 1
    if photometric:
        q = 0
        for p in range(7):
            g[p] += total[PHOTO_G + p]
            for o in range(p, 7):
                H[p, o] += total[PHOTO_H + q]
                C[p, o] += total[CROSS_P + q]
                q += 1
    for p in range(7):
        for o in range(p):
            H[p, o] = H[o, p]
            C[p, o] = C[o, p]
    if H[6, 6] <= 0:
        H[6, 6] = 1.0
    return H, g, C


@kernel
def twist_between(A: Float64, B: Float64) -> Float64:
    """Logarithm (6,) of A^-1 B, for rotations well below half a turn."""
    R = np.zeros((3, 3))
    t = np.zeros(3)
    for i in range(3):
        for k in range(3):
            t[i] += A[k, i] * (B[k, 3] - A[k, 3])
            for j in range(3):
                R[i, j] += A[k, i] * B[k, j]
    w = np.empty(3)
    w[0] = R[2, 1] - R[1, 2]
    w[1] = R[0, 2] - R[2, 0]
    w[2] = R[1, 0] - R[0, 1]
    sine = 0.5 * np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    w *= 0.5 * (angle / sine if sine > 1e-9 else 1.0)
    if angle < 0.02:
        c = 1.0 / 12 + angle * angle / 720
    else:
        c = 1.0 / (angle * angle) - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    out = np.empty(6)
    out[3:] = w
    # The inverse left Jacobian: 1 - W / 2 + c W^2.
    wt = np.array([w[1] * t[2] - w[2] * t[1], w[2] * t[0] - w[0] * t[2], w[0] * t[1] - w[1] * t[0]])
    wwt = np.array(
        [w[1] * wt[2] - w[2] * wt[1], w[2] * wt[0] - w[0] * wt[2], w[0] * wt[1] - w[1] * wt[0]]
    )
    out[:3] = t - 0.5 * wt + c * wwt
    return out


@kernel
def gather(
    rays: Float32,
    planes: Float32,
    plane_variance: Float32,
    photo: Float32,
    stride: int,
    points: Float32,
    normals: Float32,
    sigma: Float32,
    light: Float32,
) -> int:
    """Take every `stride`-th pixel of every `stride`-th row that has a plane; returns how many.

    Writes points on the fitted surface (N, 3), unit normals (N, 3), sigma of z (N,) and the
    photometric values (N, 3), row by row.
    """
    n = 0
    for i in range(stride // 2, planes.shape[0], stride):
        for j in range(stride // 2, planes.shape[1], stride):
            v = planes[i, j, 3]
            if v <= 0:
                continue
            z = 1 / v
            points[n, 0] = rays[i, j, 0] * z
            points[n, 1] = rays[i, j, 1] * z
            points[n, 2] = z
            a = planes[i, j, 0]
            b = planes[i, j, 1]
            c = planes[i, j, 2]
            length = np.sqrt(a * a + b * b + c * c)
            normals[n, 0] = a / length
            normals[n, 1] = b / length
            normals[n, 2] = c / length
            sigma[n] = np.sqrt(plane_variance[i, j]) * z * z
            for k in range(3):
                light[n, k] = photo[i, j, k]
            n += 1
    return n
