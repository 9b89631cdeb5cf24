"""Normal equations of projective point-to-plane alignment with a photometric term.

Source points p are moved into the target by T, projected, and compared with the plane and the
albedo at the pixel they land on. With the plane n . X = d of the target the residual is its
distance n . X - d, and its Jacobian by the right perturbation of T is (m, p x m), with m = R^T n.
The log albedo of the target is linear in the rays near a pixel.

Either residual has such a Jacobian by the target, with m from its normal or the slope of its
albedo, and one by the source, with the source's own s in place of m. With J their mean and D half
their difference the symmetrised product of the two is J J^T - D D^T: independent noise cancels in
it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import landing

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Columns of a source point: position in m, unit normal, sigma of z as a share of z, log albedo
# (NaN where unknown) and its slope by the position, 1/m.
POINT = 0
NORMAL = 3
SIGMA = 6
LIGHT = 7
LIGHT_SLOPE = 8
POINT_SIZE = 11

# Columns of a target's pixel: unit normal and distance of the plane (0: there is none), variance
# of the distance, and log albedo of the ray (0, 0) with its slopes by x/z and y/z (NaN where
# unknown), were it linear in the rays everywhere.
PLANE = 0
DISTANCE = 3
VARIANCE = 4
ALBEDO = 5
ALBEDO_SLOPE = 6
PIXEL_SIZE = 8

# Layout of what `accumulate` returns.
H = 0  # 36: upper triangle of the 8x8 sum of w (J, r) (J, r)^T; J[6] is that of the exposure
D = 36  # 21: upper triangle of the 6x6 sum of w D D^T
LANDED = 57  # points that land on a pixel of the target
COMPARED = 58  # of those, points at which the target has a plane
INLIERS = 59  # of those, points within the reach and with a compatible normal
IN_FRONT = 60  # points in free space of the target
WEIGHT_G = 61  # sums of the robust weights and of weighted squared residuals, in sigmas
SQUARES_G = 62
WEIGHT_P = 63
SQUARES_P = 64
COUNT_P = 65
SQUARES_M = 66  # of the inliers' distances, m^2
# Of all compared points' squared distances in unscaled variances: bins of a quarter of an octave
# (between two powers of 2 all are equally wide), the first from 0 to 2^-8.
HISTOGRAM = 67
BINS = 96
SIZE = HISTOGRAM + BINS

# Residuals wait in blocks, each weighted by the root of its w: a column of J (7), r, and D (6).
_BLOCK = 32
_J, _R, _D, _COLUMN = 0, 7, 8, 14


@kernel
def accumulate(
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
    start: int,
    stop: int,
) -> Float64:
    """Sum the normal equations over the points start..stop.

    Parameters
    ----------
    points, target
        (N, POINT_SIZE) and (H, W, PIXEL_SIZE), see above.
    lookup, lookup_frame
        As in `landing`.
    T
        (4, 4) T_target_source.
    exposure
        Target log albedo minus the source's.
    scale_g, scale_p
        Sigmas are multiplied by the first; the second is the sigma of the log albedo, 0 if it takes
        no part.
    slack
        Added in quadrature to the sigma of a distance, m: forgives what is still misaligned.
    robust
        Residuals beyond so many sigmas count nothing (Tukey's biweight).
    min_cosine
        Smallest cosine between the normals.
    """
    out = np.zeros(SIZE)
    rows, columns = target.shape[0], target.shape[1]
    inverse_limit2 = 1 / (robust * robust)
    per_p = 1 / scale_p if scale_p > 0 else 0.0
    scale_g2 = scale_g * scale_g
    slack2 = slack * slack
    block = np.empty((_COLUMN, _BLOCK))
    sums = np.zeros((LANDED, _BLOCK))
    waiting = 0
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for k in range(start, stop):
        if waiting > _BLOCK - 2:
            _add_block(sums, block, waiting)
            waiting = 0
        px = np.float64(points[k, POINT])
        py = np.float64(points[k, POINT + 1])
        pz = np.float64(points[k, POINT + 2])
        z = r20 * px + r21 * py + r22 * pz + t2
        if z <= 0.02:
            continue
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        per_z = 1 / z
        xn = x * per_z
        yn = y * per_z
        u, v, iu, _ = landing(xn, yn, lookup, lookup_frame)
        if iu < 0:
            continue
        if not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
            continue
        pixel = target[int(v + 0.5), int(u + 0.5)]
        out[LANDED] += 1
        distance = np.float64(pixel[DISTANCE])
        if distance == 0:
            continue
        out[COMPARED] += 1
        n0 = np.float64(pixel[PLANE])
        n1 = np.float64(pixel[PLANE + 1])
        n2 = np.float64(pixel[PLANE + 2])
        across = n0 * x + n1 * y + n2 * z
        r = across - distance
        # How an error along the source's ray, relative to z, moves the point across the plane.
        along = (across - (n0 * t0 + n1 * t1 + n2 * t2)) * np.float64(points[k, SIGMA])
        own = along * along + np.float64(pixel[VARIANCE])
        r2 = r * r
        out[HISTOGRAM + histogram_bin(r2 / own)] += 1
        per_variance = 1 / (scale_g2 * own + slack2)
        e2 = r2 * per_variance * inverse_limit2
        if e2 >= 1:
            # Nearer than what the target saw there: it looked through this point.
            if r < 0 and e2 > 4:
                out[IN_FRONT] += 1
            continue
        # m = R^T n, the target's normal in the source frame (away from the camera).
        m0 = r00 * n0 + r10 * n1 + r20 * n2
        m1 = r01 * n0 + r11 * n1 + r21 * n2
        m2 = r02 * n0 + r12 * n1 + r22 * n2
        s0 = np.float64(points[k, NORMAL])
        s1 = np.float64(points[k, NORMAL + 1])
        s2 = np.float64(points[k, NORMAL + 2])
        if s0 * m0 + s1 * m1 + s2 * m2 < min_cosine:
            continue
        weight = (1 - e2) * (1 - e2)
        out[INLIERS] += 1
        out[SQUARES_M] += r2
        out[WEIGHT_G] += weight
        out[SQUARES_G] += weight * r2 * per_variance
        root = (1 - e2) * np.sqrt(per_variance)
        _put(block, waiting, root, r, 0.0, px, py, pz, m0, m1, m2, s0, s1, s2)
        waiting += 1

        tx = np.float64(pixel[ALBEDO_SLOPE])
        level = np.float64(points[k, LIGHT])
        if per_p == 0 or np.isnan(tx) or np.isnan(level):
            continue
        ty = np.float64(pixel[ALBEDO_SLOPE + 1])
        r = np.float64(pixel[ALBEDO]) + tx * xn + ty * yn - level - exposure
        out[COUNT_P] += 1
        r2 = r * r
        e2 = r2 * per_p * per_p * inverse_limit2
        if e2 >= 1:
            continue
        weight = (1 - e2) * (1 - e2)
        out[WEIGHT_P] += weight
        out[SQUARES_P] += weight * r2
        # d(x/z, y/z) by the moved point, then back into the source frame.
        d0 = tx * per_z
        d1 = ty * per_z
        d2 = -(tx * xn + ty * yn) * per_z
        m0 = r00 * d0 + r10 * d1 + r20 * d2
        m1 = r01 * d0 + r11 * d1 + r21 * d2
        m2 = r02 * d0 + r12 * d1 + r22 * d2
        s0 = np.float64(points[k, LIGHT_SLOPE])
        s1 = np.float64(points[k, LIGHT_SLOPE + 1])
        s2 = np.float64(points[k, LIGHT_SLOPE + 2])
        root = (1 - e2) * per_p
        _put(block, waiting, root, r, -1.0, px, py, pz, m0, m1, m2, s0, s1, s2)
        waiting += 1
    _add_block(sums, block, waiting)
    for q in range(LANDED):
        for lane in range(_BLOCK):
            out[q] += sums[q, lane]
    return out


@kernel
def histogram_bin(ratio: float) -> int:
    """Bin of a squared distance: the exponent of the number and two bits of its mantissa."""
    bits = np.float32(ratio).view(np.int32)
    place = int(bits >> 21) - ((127 - 8) << 2)
    return min(max(place, 0), BINS - 1)


@kernel
def bin_edge(place: int) -> float:
    """Squared distance, in unscaled variances, at which a bin of the histogram begins."""
    return 2.0 ** ((place >> 2) - 8) * (1 + (place & 3) / 4) if place > 0 else 0.0


@kernel
def _put(
    block: Float64,
    k: int,
    root: float,
    r: float,
    j6: float,
    px: float,
    py: float,
    pz: float,
    m0: float,
    m1: float,
    m2: float,
    s0: float,
    s1: float,
    s2: float,
) -> None:
    """Write a residual into column k of a block, weighted; m and s are the sides' directions."""
    half = 0.5 * root
    a0, a1, a2 = half * (m0 + s0), half * (m1 + s1), half * (m2 + s2)
    block[_J, k], block[_J + 1, k], block[_J + 2, k] = a0, a1, a2
    block[_J + 3, k] = py * a2 - pz * a1
    block[_J + 4, k] = pz * a0 - px * a2
    block[_J + 5, k] = px * a1 - py * a0
    block[_J + 6, k] = root * j6
    block[_R, k] = root * r
    a0, a1, a2 = half * (m0 - s0), half * (m1 - s1), half * (m2 - s2)
    block[_D, k], block[_D + 1, k], block[_D + 2, k] = a0, a1, a2
    block[_D + 3, k] = py * a2 - pz * a1
    block[_D + 4, k] = pz * a0 - px * a2
    block[_D + 5, k] = px * a1 - py * a0


@kernel
def _add_block(sums: Float64, block: Float64, count: int) -> None:
    """Add the products of a block's rows, lane by lane: several at a time in the processor."""
    q = 0
    for p in range(_COLUMN):
        for o in range(p, _D if p < _D else _COLUMN):
            for lane in range(count):
                sums[q, lane] += block[p, lane] * block[o, lane]
            q += 1


@kernel
def normal_equations(total: Float64) -> tuple[Float64, Float64, Float64]:
    """Unpack what `accumulate` summed: H (7, 7), g (7,) and the cross-information (7, 7).

    The seventh unknown is the exposure; without the photometric term its row is that of the unit
    matrix in H and 0 in the cross-information.
    """
    A = np.zeros((7, 7))
    C = np.zeros((7, 7))
    g = np.zeros(7)
    q = H
    for p in range(7):
        for o in range(p, 7):
            A[p, o] = total[q]
            C[p, o] = total[q]
            q += 1
        g[p] = total[q]
        q += 1
    q = D
    for p in range(6):
        for o in range(p, 6):
            C[p, o] -= total[q]
            q += 1
    for p in range(7):
        for o in range(p):
            A[p, o] = A[o, p]
            C[p, o] = C[o, p]
    if A[6, 6] <= 0:
        A[6, 6] = 1.0
    return A, g, C


@kernel
def gather(
    rays: Float32,
    planes: Float32,
    plane_variance: Float32,
    photo: Float32,
    stride: int,
) -> Float32:
    """Take every `stride`-th pixel of every `stride`-th row that has a plane, row by row.

    Returns (N, POINT_SIZE) points on the fitted surface.
    """
    rows, columns = planes.shape[0], planes.shape[1]
    most = ((rows + stride - 1) // stride) * ((columns + stride - 1) // stride)
    out = np.empty((most, POINT_SIZE), np.float32)
    n = 0
    for i in range(stride // 2, rows, stride):
        for j in range(stride // 2, columns, stride):
            v = planes[i, j, 3]
            if v <= 0:
                continue
            x, y = rays[i, j, 0], rays[i, j, 1]
            a, b, c = planes[i, j, 0], planes[i, j, 1], planes[i, j, 2]
            length = np.sqrt(a * a + b * b + c * c)
            gx, gy = photo[i, j, 1], photo[i, j, 2]
            point = out[n]
            point[POINT], point[POINT + 1], point[POINT + 2] = x / v, y / v, 1 / v
            point[NORMAL], point[NORMAL + 1], point[NORMAL + 2] = a / length, b / length, c / length
            point[SIGMA] = np.sqrt(plane_variance[i, j]) / v
            point[LIGHT] = photo[i, j, 0]
            point[LIGHT_SLOPE], point[LIGHT_SLOPE + 1] = gx * v, gy * v
            point[LIGHT_SLOPE + 2] = -(gx * x + gy * y) * v
            n += 1
    return out[:n]


@kernel
def make_target(rays: Float32, planes: Float32, plane_variance: Float32, photo: Float32) -> Float32:
    """Return a view as (H, W, PIXEL_SIZE), as a target is compared with."""
    rows, columns = planes.shape[0], planes.shape[1]
    out = np.zeros((rows, columns, PIXEL_SIZE), np.float32)
    for i in range(rows):
        for j in range(columns):
            if planes[i, j, 3] <= 0:
                continue
            a, b, c = planes[i, j, 0], planes[i, j, 1], planes[i, j, 2]
            length2 = a * a + b * b + c * c
            length = np.sqrt(length2)
            gx, gy = photo[i, j, 1], photo[i, j, 2]
            pixel = out[i, j]
            pixel[PLANE], pixel[PLANE + 1], pixel[PLANE + 2] = a / length, b / length, c / length
            pixel[DISTANCE] = 1 / length
            pixel[VARIANCE] = plane_variance[i, j] / length2
            pixel[ALBEDO] = photo[i, j, 0] - gx * rays[i, j, 0] - gy * rays[i, j, 1]
            pixel[ALBEDO_SLOPE], pixel[ALBEDO_SLOPE + 1] = gx, gy
    return out


@kernel
def exposure_differences(
    points: Float32, every: int, target: Float32, lookup: Float32, lookup_frame: Float64, T: Float64
) -> Float64:
    """Log albedo of the target minus the source's, where every so manieth point lands."""
    out = np.empty(points.shape[0] // every + 1)
    n = 0
    for k in range(0, points.shape[0], every):
        px, py, pz = points[k, POINT], points[k, POINT + 1], points[k, POINT + 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z <= 0.02:
            continue
        x = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) / z
        y = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) / z
        u, v, iu, _ = landing(x, y, lookup, lookup_frame)
        if iu < 0 or not (
            u > -0.5 and v > -0.5 and u < target.shape[1] - 0.5 and v < target.shape[0] - 0.5
        ):
            continue
        pixel = target[int(v + 0.5), int(u + 0.5)]
        if pixel[DISTANCE] == 0:
            continue
        light = pixel[ALBEDO] + x * pixel[ALBEDO_SLOPE] + y * pixel[ALBEDO_SLOPE + 1]
        difference = light - points[k, LIGHT]
        if not np.isnan(difference):
            out[n] = difference
            n += 1
    return out[:n]
