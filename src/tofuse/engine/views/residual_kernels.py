"""Normal equations of projective point-to-plane alignment with a photometric term.

Source points p are transformed into the target by T, projected, and compared with the plane and the
albedo of the pixel they project to. For the target plane n . X = d the residual is the distance
n . X - d; its Jacobian with respect to the right perturbation of T is (m, p x m), with m = R^T n.
The log albedo of the target is linear in the ray coordinates near a pixel.

Each residual has one Jacobian from the target, with m from its normal or albedo gradient, and one
from the source, with the source's own s in place of m. With J their mean and D half their
difference, the symmetrised product of the two is J J^T - D D^T, in which independent noise cancels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.compute import tukey_kernels as tukey

# Columns of a source point: position in m, unit normal, sigma of z relative to z, log albedo
# (NaN where unknown) and its gradient with respect to the position, 1/m.
POINT = 0
NORMAL = 3
SIGMA = 6
POINT_ALBEDO = 7
POINT_ALBEDO_SLOPE = 8
POINT_SIZE = 11

# Columns of a target pixel: unit normal and distance of the plane (0: no plane), variance of the
# distance, and the log albedo as a linear function of the ray: its value extrapolated to the ray
# (0, 0), and its slopes by x/z and y/z (NaN where unknown).
PLANE = 0
DISTANCE = 3
VARIANCE = 4
ALBEDO = 5
ALBEDO_SLOPE = 6
PIXEL_SIZE = 8

# Layout of the sums that `accumulate` returns.
PRODUCTS = 0  # 36: upper triangle of the 8x8 sum of w (J, r) (J, r)^T; J[6] is that of the exposure
DIFFERENCES = 36  # 21: upper triangle of the 6x6 sum of w D D^T
PROJECTED = 57  # points that project to a pixel of the target
COMPARED = 58  # of those, points at which the target has a plane
INLIERS = 59  # of those, points within the robust cut-off and with a compatible normal
IN_FRONT = 60  # points in free space of the target
WEIGHT_G = 61  # sums of the robust weights and of weighted squared residuals, in sigmas
SQUARES_G = 62
WEIGHT_P = 63
SQUARES_P = 64
COUNT_P = 65
SQUARES_M = 66  # of the inliers' distances from planes, m^2
# Histogram of chi2, the squared distances of all compared points divided by their unscaled
# variances: four equally wide bins per octave, the first from 0 to 2^-8.
HISTOGRAM = 67
BINS = 96
SIZE = HISTOGRAM + BINS

# Points are compared in structure-of-arrays blocks, one point per column, so that loops over a row
# are vectorised. Rows of a block: the point, its projection (x/z, y/z and z in the target), the
# target pixel, whether it has a plane, and whether the point is an inlier; then J (7), r, and D
# (6), each multiplied by the square root of w; the statistics to be summed; chi2; and the square
# root of the distance's w.
LANES = 128
# Points at more than twice the cut-off in front of a surface are in free space.
FREE_SPACE = 4.0
XN, YN, Z, PIXEL = POINT_SIZE, POINT_SIZE + 1, POINT_SIZE + 2, POINT_SIZE + 3
HAS_PLANE = PIXEL + PIXEL_SIZE
IS_INLIER = HAS_PLANE + 1
JACOBIAN = IS_INLIER + 1
WEIGHTED_RESIDUAL, DIFFERENCE = JACOBIAN + 7, JACOBIAN + 8
STAT = DIFFERENCE + 6  # as from INLIERS to SQUARES_M
_STATS = SQUARES_M + 1 - INLIERS
CHI2 = STAT + _STATS
SQRT_WEIGHT = CHI2 + 1
ROWS = SQRT_WEIGHT + 1


class TargetImage(NamedTuple):
    """A view that others are aligned with.

    Attributes
    ----------
    image
        (H, W, PIXEL_SIZE) of `make_target`.
    lookup, lookup_frame
        Projection of the view's camera, as in `project_ray`.
    """

    image: Float32
    lookup: Float32
    lookup_frame: Float64


class ViewImages(NamedTuple):
    """The images of a view from which source points and target images are made.

    Attributes
    ----------
    rays, planes, plane_variance, albedo
        (H, W, 2), (H, W, 4), (H, W) and (H, W, 3) of a `PreparedView`.
    """

    rays: Float32
    planes: Float32
    plane_variance: Float32
    albedo: Float32


class Residuals(NamedTuple):
    """Parameters of residuals and of their weights.

    Attributes
    ----------
    exposure
        Log albedo of the target minus that of the source.
    scale_g, scale_p
        Factor of the sigmas of distances, and sigma of the log albedo (0 leaves it out).
    inflation
        Noise inflation in m, added in quadrature to the sigma of a distance while views are still
        misaligned.
    robust
        Cut-off of Tukey's biweight, in sigmas.
    min_cosine
        Smallest cosine between corresponding normals.
    """

    exposure: float
    scale_g: float
    scale_p: float
    inflation: float
    robust: float
    min_cosine: float


@kernel
def accumulate(points: Float32, target: TargetImage, T: Float64, residuals: Residuals) -> Float64:
    """Sum the normal equations over all points.

    Parameters
    ----------
    points
        (N, POINT_SIZE) source points, see above.
    target
        The view that they are compared with.
    residuals
        Computation and weights of the residuals.
    T
        (4, 4) T_target_source.

    Returns
    -------
    (SIZE,) sums, laid out as above.
    """
    image, lookup, lookup_frame = target
    exposure, scale_g, scale_p, inflation, robust, min_cosine = residuals
    out = np.zeros(SIZE)
    block = np.zeros(ROWS * LANES, np.float32)
    sums = np.zeros((PROJECTED + _STATS, LANES), np.float32)
    for first in range(0, len(points), LANES):
        count = min(LANES, len(points) - first)
        load_block(block, points[first : first + count])
        transform_block(block, T)
        out[PROJECTED] += project_block(block, count, image, lookup, lookup_frame)
        compare_planes(block, T, scale_g, inflation, robust, min_cosine)
        add_products(sums, block, 14)
        if scale_p > 0:
            compare_albedos(block, T, exposure, scale_p, robust)
            add_products(sums, block, 14)
        for c in range(_STATS):
            total, row = sums[PROJECTED + c], block[(STAT + c) * LANES : (STAT + c + 1) * LANES]
            for k in range(LANES):
                total[k] += row[k]
        for k in range(count):
            if block[HAS_PLANE * LANES + k] > 0:
                out[COMPARED] += 1
                out[HISTOGRAM + histogram_bin(block[CHI2 * LANES + k])] += 1
    sum_columns(sums)
    for q in range(PROJECTED):
        out[q] = sums[q, 0]
    for q in range(_STATS):
        out[INLIERS + q] = sums[PROJECTED + q, 0]
    return out


@kernel
def sum_columns(sums: Float32) -> None:
    """Add the columns (n, LANES) of each row to its first one, in pairs."""
    width = LANES
    while width > 1:
        width //= 2
        for q in range(len(sums)):
            low, high = sums[q, :width], sums[q, width:]
            for k in range(width):
                low[k] += high[k]


@kernel
def load_block(block: Float32, points: Float32) -> None:
    """Copy up to `LANES` points (n, POINT_SIZE) into the columns of a block; the others are 0."""
    for k in range(len(points)):
        for c in range(POINT_SIZE):
            block[c * LANES + k] = points[k, c]
    for c in range(POINT_SIZE):
        block[c * LANES + len(points) : (c + 1) * LANES] = 0.0


@kernel
def transform_block(block: Float32, T: Float64) -> None:
    """Transform the points of a block by T (4, 4) into the target."""
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for k in range(LANES):
        px = block[POINT * LANES + k]
        py = block[(POINT + 1) * LANES + k]
        pz = block[(POINT + 2) * LANES + k]
        z = r20 * px + r21 * py + r22 * pz + t2
        inv_z = 1 / z if z > projection_kernels.MIN_DEPTH else 0.0
        block[XN * LANES + k] = (r00 * px + r01 * py + r02 * pz + t0) * inv_z
        block[YN * LANES + k] = (r10 * px + r11 * py + r12 * pz + t1) * inv_z
        block[Z * LANES + k] = z


@kernel
def project_block(
    block: Float32, count: int, target: Float32, lookup: Float32, lookup_frame: Float64
) -> int:
    """Fetch the target pixels that a block's points project to; return their number."""
    rows, columns = target.shape[0], target.shape[1]
    u, v = np.empty(LANES), np.empty(LANES)
    xn, yn = block[XN * LANES : (XN + 1) * LANES], block[YN * LANES : (YN + 1) * LANES]
    projection_kernels.project_rays(xn, yn, lookup, lookup_frame, u, v)
    projected = 0
    for k in range(LANES):
        block[HAS_PLANE * LANES + k] = 0
    for k in range(count):
        if not block[Z * LANES + k] > projection_kernels.MIN_DEPTH:
            continue
        if not (u[k] > -0.5 and v[k] > -0.5 and u[k] < columns - 0.5 and v[k] < rows - 0.5):
            continue
        projected += 1
        pixel = target[np.uint32(v[k] + 0.5), np.uint32(u[k] + 0.5)]
        if pixel[DISTANCE] > 0:
            block[HAS_PLANE * LANES + k] = 1
            for c in range(PIXEL_SIZE):
                block[(PIXEL + c) * LANES + k] = pixel[c]
    return projected


@kernel
def compare_planes(
    block: Float32, T: Float64, scale_g: float, inflation: float, robust: float, min_cosine: float
) -> None:
    """Compare the points of a block with the target planes; parameters as in `Residuals`."""
    r00, r01, r02 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2])
    r10, r11, r12 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2])
    r20, r21, r22 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2])
    scale_g2, inflation2 = np.float32(scale_g * scale_g), np.float32(inflation * inflation)
    inv_limit2, min_cosine32 = np.float32(1 / (robust * robust)), np.float32(min_cosine)
    one, zero = np.float32(1), np.float32(0)
    for k in range(LANES):
        px = block[POINT * LANES + k]
        py = block[(POINT + 1) * LANES + k]
        pz = block[(POINT + 2) * LANES + k]
        s0 = block[NORMAL * LANES + k]
        s1 = block[(NORMAL + 1) * LANES + k]
        s2 = block[(NORMAL + 2) * LANES + k]
        n0 = block[(PIXEL + PLANE) * LANES + k]
        n1 = block[(PIXEL + PLANE + 1) * LANES + k]
        n2 = block[(PIXEL + PLANE + 2) * LANES + k]
        z = block[Z * LANES + k]
        r = z * (n0 * block[XN * LANES + k] + n1 * block[YN * LANES + k] + n2)
        r -= block[(PIXEL + DISTANCE) * LANES + k]
        # m = R^T n, the target's normal in the source frame (away from the camera).
        m0 = r00 * n0 + r10 * n1 + r20 * n2
        m1 = r01 * n0 + r11 * n1 + r21 * n2
        m2 = r02 * n0 + r12 * n1 + r22 * n2
        # Sigma of the distance due to the source's error, which is along the ray and relative to z.
        source_sigma = (m0 * px + m1 * py + m2 * pz) * block[SIGMA * LANES + k]
        variance = source_sigma * source_sigma + block[(PIXEL + VARIANCE) * LANES + k]
        r2 = r * r
        block[CHI2 * LANES + k] = r2 / variance
        information = one / (scale_g2 * variance + inflation2)
        e2 = r2 * information * inv_limit2
        has_plane = block[HAS_PLANE * LANES + k] > zero
        inlier = has_plane & (e2 < one) & (s0 * m0 + s1 * m1 + s2 * m2 >= min_cosine32)
        in_front = has_plane & (r < zero) & (e2 > np.float32(FREE_SPACE))
        weight = tukey.weight(e2) if inlier else zero
        sqrt_weight = tukey.root_weight(e2) * np.sqrt(information) if inlier else zero
        block[SQRT_WEIGHT * LANES + k] = sqrt_weight
        block[IS_INLIER * LANES + k] = one if inlier else zero
        block[STAT * LANES + k] = one if inlier else zero
        block[(STAT + IN_FRONT - INLIERS) * LANES + k] = one if in_front else zero
        block[(STAT + WEIGHT_G - INLIERS) * LANES + k] = weight
        block[(STAT + SQUARES_G - INLIERS) * LANES + k] = r2 * sqrt_weight * sqrt_weight
        block[(STAT + SQUARES_M - INLIERS) * LANES + k] = r2 if inlier else zero
        block[(JACOBIAN + 6) * LANES + k] = zero
        block[WEIGHTED_RESIDUAL * LANES + k] = sqrt_weight * r if inlier else zero
        _write_jacobians(block, k, sqrt_weight, px, py, pz, m0, m1, m2, s0, s1, s2)


@kernel
def compare_albedos(
    block: Float32, T: Float64, exposure: float, scale_p: float, robust: float
) -> None:
    """Compare the albedo of a block's inliers with the target; parameters as in `Residuals`."""
    r00, r01, r02 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2])
    r10, r11, r12 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2])
    r20, r21, r22 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2])
    inv_scale_p, exposure32 = np.float32(1 / scale_p), np.float32(exposure)
    inv_limit2 = np.float32(1 / (scale_p * scale_p * robust * robust))
    one, zero = np.float32(1), np.float32(0)
    for k in range(LANES):
        px = block[POINT * LANES + k]
        py = block[(POINT + 1) * LANES + k]
        pz = block[(POINT + 2) * LANES + k]
        xn, yn = block[XN * LANES + k], block[YN * LANES + k]
        tx = block[(PIXEL + ALBEDO_SLOPE) * LANES + k]
        ty = block[(PIXEL + ALBEDO_SLOPE + 1) * LANES + k]
        r = block[(PIXEL + ALBEDO) * LANES + k] + tx * xn + ty * yn
        r -= block[POINT_ALBEDO * LANES + k] + exposure32
        # If either is unknown, r is NaN, and the comparison is false.
        known = (block[IS_INLIER * LANES + k] > zero) & (r * r < np.float32(np.inf))
        e2 = r * r * inv_limit2
        inlier = known & (e2 < one)
        weight = tukey.weight(e2) if inlier else zero
        sqrt_weight = tukey.root_weight(e2) * inv_scale_p if inlier else zero
        r = r if inlier else zero
        tx, ty = tx if inlier else zero, ty if inlier else zero
        s0 = block[POINT_ALBEDO_SLOPE * LANES + k] if inlier else zero
        s1 = block[(POINT_ALBEDO_SLOPE + 1) * LANES + k] if inlier else zero
        s2 = block[(POINT_ALBEDO_SLOPE + 2) * LANES + k] if inlier else zero
        block[(STAT + COUNT_P - INLIERS) * LANES + k] = one if known else zero
        block[(STAT + WEIGHT_P - INLIERS) * LANES + k] = weight
        block[(STAT + SQUARES_P - INLIERS) * LANES + k] = weight * r * r
        # Gradient with respect to the transformed point, rotated back into the source frame.
        inv_z = one / block[Z * LANES + k] if inlier else zero
        d0, d1, d2 = tx * inv_z, ty * inv_z, -(tx * xn + ty * yn) * inv_z
        m0 = r00 * d0 + r10 * d1 + r20 * d2
        m1 = r01 * d0 + r11 * d1 + r21 * d2
        m2 = r02 * d0 + r12 * d1 + r22 * d2
        block[(JACOBIAN + 6) * LANES + k] = -sqrt_weight
        block[WEIGHTED_RESIDUAL * LANES + k] = sqrt_weight * r
        _write_jacobians(block, k, sqrt_weight, px, py, pz, m0, m1, m2, s0, s1, s2)


@kernel
def _write_jacobians(
    block: Float32,
    k: int,
    sqrt_weight: np.float32,
    px: np.float32,
    py: np.float32,
    pz: np.float32,
    m0: np.float32,
    m1: np.float32,
    m2: np.float32,
    s0: np.float32,
    s1: np.float32,
    s2: np.float32,
) -> None:
    """Write J and D times `sqrt_weight` into column k; m and s are those of target and source."""
    half = np.float32(0.5) * sqrt_weight
    a0, a1, a2 = half * (m0 + s0), half * (m1 + s1), half * (m2 + s2)
    block[JACOBIAN * LANES + k] = a0
    block[(JACOBIAN + 1) * LANES + k] = a1
    block[(JACOBIAN + 2) * LANES + k] = a2
    block[(JACOBIAN + 3) * LANES + k] = py * a2 - pz * a1
    block[(JACOBIAN + 4) * LANES + k] = pz * a0 - px * a2
    block[(JACOBIAN + 5) * LANES + k] = px * a1 - py * a0
    a0, a1, a2 = half * (m0 - s0), half * (m1 - s1), half * (m2 - s2)
    block[DIFFERENCE * LANES + k] = a0
    block[(DIFFERENCE + 1) * LANES + k] = a1
    block[(DIFFERENCE + 2) * LANES + k] = a2
    block[(DIFFERENCE + 3) * LANES + k] = py * a2 - pz * a1
    block[(DIFFERENCE + 4) * LANES + k] = pz * a0 - px * a2
    block[(DIFFERENCE + 5) * LANES + k] = px * a1 - py * a0


@kernel
def add_products(sums: Float32, block: Float32, rows: int) -> None:
    """Add the products of the rows of J and r, and with 14 `rows` also those of D, per column."""
    q = 0
    for p in range(rows):
        a = block[(JACOBIAN + p) * LANES : (JACOBIAN + p + 1) * LANES]
        for o in range(p, 8 if p < 8 else rows):
            b = block[(JACOBIAN + o) * LANES : (JACOBIAN + o + 1) * LANES]
            total = sums[q]
            for k in range(LANES):
                total[k] += a[k] * b[k]
            q += 1


@kernel
def histogram_bin(chi2: float) -> int:
    """Return the histogram bin of chi2: its exponent and two bits of its mantissa."""
    bits = np.float32(chi2).view(np.int32)
    index = int(bits >> 21) - ((127 - 8) << 2)
    return min(max(index, 0), BINS - 1)


@kernel
def bin_edge(index: int) -> float:
    """Return the chi2 at the lower edge of a histogram bin."""
    return 2.0 ** ((index >> 2) - 8) * (1 + (index & 3) / 4) if index > 0 else 0.0


@kernel
def normal_equations(total: Float64) -> tuple[Float64, Float64, Float64]:
    """Unpack the sums of `accumulate`: H (7, 7), g (7,) and the cross-information (7, 7).

    The seventh unknown is the exposure. Without the photometric term its row is that of the
    identity in H, and 0 in the cross-information.
    """
    A = np.zeros((7, 7))
    C = np.zeros((7, 7))
    g = np.zeros(7)
    q = PRODUCTS
    for p in range(7):
        for o in range(p, 7):
            A[p, o] = total[q]
            C[p, o] = total[q]
            q += 1
        g[p] = total[q]
        q += 1
    q = DIFFERENCES
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
def sample_points(view: ViewImages, stride: int) -> Float32:
    """Return source points (N, POINT_SIZE) on the fitted planes of every `stride`-th pixel.

    Parameters
    ----------
    view
        The source.
    stride
        Pixels between samples, in both directions.
    """
    rays, planes, plane_variance, albedo = view
    rows, columns = planes.shape[0], planes.shape[1]
    max_count = ((rows + stride - 1) // stride) * ((columns + stride - 1) // stride)
    out = np.empty((max_count, POINT_SIZE), np.float32)
    n = 0
    for i in range(stride // 2, rows, stride):
        for j in range(stride // 2, columns, stride):
            if planes[i, j, 3] <= 0:
                continue
            write_point(out[n], rays[i, j], planes[i, j], plane_variance[i, j], albedo[i, j])
            n += 1
    return out[:n]


@kernel
def write_point(
    point: Float32, ray: Float32, plane: Float32, variance: np.float32, albedo: Float32
) -> None:
    """Write the source point (POINT_SIZE,) of a pixel that has a plane."""
    v = plane[3]
    x, y = ray[0], ray[1]
    a, b, c = plane[0], plane[1], plane[2]
    length = np.sqrt(a * a + b * b + c * c)
    gx, gy = albedo[1], albedo[2]
    point[POINT], point[POINT + 1], point[POINT + 2] = x / v, y / v, 1 / v
    point[NORMAL], point[NORMAL + 1], point[NORMAL + 2] = a / length, b / length, c / length
    point[SIGMA] = np.sqrt(variance) / v
    point[POINT_ALBEDO] = albedo[0]
    point[POINT_ALBEDO_SLOPE], point[POINT_ALBEDO_SLOPE + 1] = gx * v, gy * v
    point[POINT_ALBEDO_SLOPE + 2] = -(gx * x + gy * y) * v


@kernel
def make_target(view: ViewImages) -> Float32:
    """Return the target image (H, W, PIXEL_SIZE) of a view."""
    rays, planes, plane_variance, albedo = view
    rows, columns = planes.shape[0], planes.shape[1]
    out = np.zeros((rows, columns, PIXEL_SIZE), np.float32)
    for i in range(rows):
        for j in range(columns):
            if planes[i, j, 3] <= 0:
                continue
            a, b, c = planes[i, j, 0], planes[i, j, 1], planes[i, j, 2]
            length2 = a * a + b * b + c * c
            length = np.sqrt(length2)
            gx, gy = albedo[i, j, 1], albedo[i, j, 2]
            pixel = out[i, j]
            pixel[PLANE], pixel[PLANE + 1], pixel[PLANE + 2] = a / length, b / length, c / length
            pixel[DISTANCE] = 1 / length
            pixel[VARIANCE] = plane_variance[i, j] / length2
            pixel[ALBEDO] = albedo[i, j, 0] - gx * rays[i, j, 0] - gy * rays[i, j, 1]
            pixel[ALBEDO_SLOPE], pixel[ALBEDO_SLOPE + 1] = gx, gy
    return out


@kernel
def exposure_differences(points: Float32, stride: int, target: TargetImage, T: Float64) -> Float64:
    """Return log albedo differences (n,), target minus source, of every `stride`-th point.

    Points without a known difference are left out. The other parameters are those of `accumulate`.
    """
    image, lookup, lookup_frame = target
    out = np.empty(points.shape[0] // stride + 1)
    n = 0
    for k in range(0, points.shape[0], stride):
        px, py, pz = points[k, POINT], points[k, POINT + 1], points[k, POINT + 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z <= projection_kernels.MIN_DEPTH:
            continue
        x = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) / z
        y = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) / z
        i, j = projection_kernels.nearest_pixel(
            x, y, lookup, lookup_frame, image.shape[0], image.shape[1]
        )
        if i < 0:
            continue
        pixel = image[i, j]
        if pixel[DISTANCE] == 0:
            continue
        expected = pixel[ALBEDO] + x * pixel[ALBEDO_SLOPE] + y * pixel[ALBEDO_SLOPE + 1]
        difference = expected - points[k, POINT_ALBEDO]
        if not np.isnan(difference):
            out[n] = difference
            n += 1
    return out[:n]
