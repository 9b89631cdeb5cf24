"""Normal equations of a pair of views: relative pose, exposure, and systematic camera errors.

As in `alignment`, source points are compared with plane and log albedo of the target pixel that
they project to. Every pair has its own system, whose unknowns also include errors that all views of
a camera share. With p a source point, q = T p, m = R^T n the target's normal in the source's frame,
and b(p) the displacement of p by an error of size 1, the distance changes by m . b(p) - n . b(q).

Correlated errors within image patches, marginalised from the normal equations of a pair.

With D the sums of the weights of the distances in each patch, R the sums of weight times (r, J)
divided by the root of D, and K the covariance of the patches' errors, the normal equations with one
error per patch marginalised contain R^T (1 + D^1/2 K D^1/2)^-1 R, where those of independent pixels
contain R^T R.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int64
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.views import residual_kernels as residual

# Camera errors, in the order of the unknowns.
OFFSET = 0  # to be added to the range, m
SCALE = 1  # relative, to be added to the depth
FOCAL = 2  # relative, to be added to the ray coordinates; measured depth is kept, z or radial
CENTER_X = 3  # to be added to the ray coordinate x / z: principal point over focal length
CENTER_Y = 4  # to be added to y / z
DISTORTION = 5  # relative, times x^2 + y^2 of the ray coordinates, to be added to these
ERRORS = 6

EXPOSURE = 6  # index of the exposure among the unknowns
UNKNOWNS = 7 + ERRORS

# Layout of the row of a pair.
PRODUCTS = 0  # upper triangle over the unknowns
GRADIENT = UNKNOWNS * (UNKNOWNS + 1) // 2
COMPARED = GRADIENT + UNKNOWNS  # points that project to a target pixel with a plane
IN_FRONT = COMPARED + 1  # points in free space of the target
WEIGHT_P = IN_FRONT + 1  # sums of robust weights and weighted squares of log albedo residuals
SQUARES_P = WEIGHT_P + 1
TERMS = SQUARES_P + 1  # number of residuals of both terms
SUPPORT = TERMS + 1  # sum of (1 - robust cost) of the residuals (Tukey's biweight)
HISTOGRAM = SUPPORT + 1  # as in `alignment`
SIZE = HISTOGRAM + residual.BINS

_EPSILON = 1e-6  # m or m^2, instead of 0 in a denominator

# Layout of the sums of a patch: of w, w r and w J.
PATCH_WEIGHT = 0
PATCH_RESIDUAL = 1
PATCH_RESPONSE = 2
PATCH_SIZE = 8


class CameraErrors(NamedTuple):
    """Systematic errors of the cameras of a pair.

    Attributes
    ----------
    errors
        (ERRORS,) assumed errors, by which points and planes are displaced.
    known
        (ERRORS,) non-zero for errors that are not estimated.
    radial_source, radial_target
        Whether the cameras measure radial range, not z.
    """

    errors: Float64
    known: Int64
    radial_source: bool
    radial_target: bool


class SourcePoints(NamedTuple):
    """Points of N views, which are compared with other views.

    Attributes
    ----------
    points
        (M, POINT_SIZE), see `alignment`.
    patches
        (M,) patch of the image that each point belongs to, see `shared_error`; (0,) if no sums over
        patches are computed.
    begin, end
        (N,) first row of the points of each view, and the row after the last.
    measures_range
        (N,) whether the camera of each view measures radial range, not z.
    """

    points: Float32
    patches: Int64
    begin: Int64
    end: Int64
    measures_range: Bool


class PairResiduals(NamedTuple):
    """`Residuals` of K pairs, each with its own exposure and scales.

    Attributes
    ----------
    exposure, scale_g, scale_p
        (K,) each.
    inflation, robust, min_cosine
        Of all pairs.
    """

    exposure: Float64
    scale_g: Float64
    scale_p: Float64
    inflation: float
    robust: float
    min_cosine: float


@kernel
def displacement(B: Float64, x: float, y: float, z: float, radial: bool) -> None:
    """Write to B (ERRORS, 3) the displacements of the point (x, y, z) by camera errors of size 1.

    `radial`: whether the camera measures the distance along the ray, not z.
    """
    lateral2 = x * x + y * y
    r2 = lateral2 + z * z
    r = np.sqrt(r2)
    B[OFFSET, 0] = x / r
    B[OFFSET, 1] = y / r
    B[OFFSET, 2] = z / r
    B[SCALE, 0] = x
    B[SCALE, 1] = y
    B[SCALE, 2] = z
    shortening = lateral2 / r2 if radial else 0.0
    B[FOCAL, 0] = x - shortening * x
    B[FOCAL, 1] = y - shortening * y
    B[FOCAL, 2] = -shortening * z
    for p, lateral in ((CENTER_X, x), (CENTER_Y, y)):
        shortening = lateral * z / r2 if radial else 0.0
        B[p, 0] = -shortening * x
        B[p, 1] = -shortening * y
        B[p, 2] = -shortening * z
    B[CENTER_X, 0] += z
    B[CENTER_Y, 1] += z
    rho2 = lateral2 / max(z * z, _EPSILON)
    for axis in range(3):
        B[DISTORTION, axis] = rho2 * B[FOCAL, axis]


@kernel
def _calibration_equations(
    points: Float32,
    target: residual.TargetImage,
    T: Float64,
    residuals: residual.Residuals,
    camera: CameraErrors,
    out: Float64,
) -> None:
    """Add the normal equations of one pair, with camera errors among the unknowns."""
    errors, known, radial_source, radial_target = camera
    unknowns = UNKNOWNS
    while unknowns > 7 and known[unknowns - 8]:
        unknowns -= 1
    estimated = unknowns - 7
    exposure, scale_g, scale_p, inflation, robust, min_cosine = residuals
    image, lookup, lookup_frame = target
    rows, columns = image.shape[0], image.shape[1]
    J = np.zeros(UNKNOWNS)
    Bp = np.zeros((ERRORS, 3))
    Bq = np.zeros((ERRORS, 3))
    A = np.zeros((UNKNOWNS, UNKNOWNS))
    g = np.zeros(UNKNOWNS)
    limit2 = robust * robust
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for k in range(points.shape[0]):
        point = points[k]
        px = np.float64(point[residual.POINT])
        py = np.float64(point[residual.POINT + 1])
        pz = np.float64(point[residual.POINT + 2])
        displacement(Bp, px, py, pz, radial_source)
        for p in range(ERRORS):
            px += errors[p] * Bp[p, 0]
            py += errors[p] * Bp[p, 1]
            pz += errors[p] * Bp[p, 2]
        z = r20 * px + r21 * py + r22 * pz + t2
        if z <= projection_kernels.MIN_DEPTH:
            continue
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        # Project with the corrected intrinsics of the target.
        xn, yn = x / z - errors[CENTER_X], y / z - errors[CENTER_Y]
        rho2 = xn * xn + yn * yn
        ray_scale = 1.0 + errors[FOCAL] + errors[DISTORTION] * rho2
        xn, yn = xn / ray_scale, yn / ray_scale
        i, j = projection_kernels.nearest_pixel(xn, yn, lookup, lookup_frame, rows, columns)
        if i < 0:
            continue
        pixel = image[i, j]
        distance = np.float64(pixel[residual.DISTANCE])
        if distance == 0:
            continue
        out[COMPARED] += 1
        out[TERMS] += 1
        n0 = np.float64(pixel[residual.PLANE])
        n1 = np.float64(pixel[residual.PLANE + 1])
        n2 = np.float64(pixel[residual.PLANE + 2])
        height = n0 * x + n1 * y + n2 * z
        r = height - distance
        displacement(Bq, x, y, z, radial_target)
        for p in range(ERRORS):
            r -= errors[p] * (n0 * Bq[p, 0] + n1 * Bq[p, 1] + n2 * Bq[p, 2])
        source_sigma = (height - (n0 * t0 + n1 * t1 + n2 * t2)) * np.float64(point[residual.SIGMA])
        raw_variance = source_sigma * source_sigma + np.float64(pixel[residual.VARIANCE])
        variance = raw_variance * scale_g * scale_g + inflation * inflation
        r2 = r * r
        out[HISTOGRAM + residual.histogram_bin(r2 / raw_variance)] += 1
        e2 = r2 / variance / limit2
        if e2 >= 1:
            if r < 0 and e2 > residual.FREE_SPACE:
                out[IN_FRONT] += 1
            continue
        m0 = r00 * n0 + r10 * n1 + r20 * n2
        m1 = r01 * n0 + r11 * n1 + r21 * n2
        m2 = r02 * n0 + r12 * n1 + r22 * n2
        s0 = np.float64(point[residual.NORMAL])
        s1 = np.float64(point[residual.NORMAL + 1])
        s2 = np.float64(point[residual.NORMAL + 2])
        if s0 * m0 + s1 * m1 + s2 * m2 < min_cosine:
            continue
        weight = tukey.weight(e2)
        out[SUPPORT] += tukey.support(weight)
        # Mean of both views' normals, which halves the effect of either's noise.
        m0, m1, m2 = 0.5 * (m0 + s0), 0.5 * (m1 + s1), 0.5 * (m2 + s2)
        projection_kernels.jacobian_row(J, m0, m1, m2, px, py, pz)
        J[EXPOSURE] = 0.0
        # The same mean for the camera errors: otherwise the difference between the normals, which
        # the pose cannot explain, would be attributed to them.
        n0 = r00 * m0 + r01 * m1 + r02 * m2
        n1 = r10 * m0 + r11 * m1 + r12 * m2
        n2 = r20 * m0 + r21 * m1 + r22 * m2
        for p in range(estimated):
            J[7 + p] = (m0 * Bp[p, 0] + m1 * Bp[p, 1] + m2 * Bp[p, 2]) - (
                n0 * Bq[p, 0] + n1 * Bq[p, 1] + n2 * Bq[p, 2]
            )
            if known[p]:
                J[7 + p] = 0.0
        _add_residual(A, g, J, r, weight / variance, unknowns)

        tx = np.float64(pixel[residual.ALBEDO_SLOPE])
        source_albedo = np.float64(point[residual.POINT_ALBEDO])
        if scale_p <= 0 or np.isnan(tx) or np.isnan(source_albedo):
            continue
        ty = np.float64(pixel[residual.ALBEDO_SLOPE + 1])
        r = np.float64(pixel[residual.ALBEDO]) + tx * xn + ty * yn - source_albedo - exposure
        out[TERMS] += 1
        r2 = r * r
        e2 = r2 / (scale_p * scale_p) / limit2
        if e2 >= 1:
            continue
        weight = tukey.weight(e2)
        out[WEIGHT_P] += weight
        out[SQUARES_P] += weight * r2
        out[SUPPORT] += tukey.support(weight)
        # Gradient with respect to the transformed point, rotated back into the source frame.
        d0 = tx / (z * ray_scale)
        d1 = ty / (z * ray_scale)
        d2 = -(tx * xn + ty * yn) / z
        m0 = r00 * d0 + r10 * d1 + r20 * d2
        m1 = r01 * d0 + r11 * d1 + r21 * d2
        m2 = r02 * d0 + r12 * d1 + r22 * d2
        s0 = np.float64(point[residual.POINT_ALBEDO_SLOPE])
        s1 = np.float64(point[residual.POINT_ALBEDO_SLOPE + 1])
        s2 = np.float64(point[residual.POINT_ALBEDO_SLOPE + 2])
        m0, m1, m2 = 0.5 * (m0 + s0), 0.5 * (m1 + s1), 0.5 * (m2 + s2)
        projection_kernels.jacobian_row(J, m0, m1, m2, px, py, pz)
        J[EXPOSURE] = -1.0
        for p in range(estimated):
            J[7 + p] = 0.0 if known[p] else m0 * Bp[p, 0] + m1 * Bp[p, 1] + m2 * Bp[p, 2]
        # Only errors of the intrinsics affect the rays of the target's pixels.
        d0 = r00 * m0 + r01 * m1 + r02 * m2
        d1 = r10 * m0 + r11 * m1 + r12 * m2
        if estimated > FOCAL and not known[FOCAL]:
            J[7 + FOCAL] -= d0 * (x - errors[CENTER_X] * z) + d1 * (y - errors[CENTER_Y] * z)
        if estimated > CENTER_X and not known[CENTER_X]:
            J[7 + CENTER_X] -= d0 * z
        if estimated > CENTER_Y and not known[CENTER_Y]:
            J[7 + CENTER_Y] -= d1 * z
        if estimated > DISTORTION and not known[DISTORTION]:
            J[7 + DISTORTION] -= rho2 * z * (d0 * xn + d1 * yn)
        _add_residual(A, g, J, r, weight / (scale_p * scale_p), unknowns)
    q = PRODUCTS
    for p in range(UNKNOWNS):
        out[GRADIENT + p] = g[p]
        for o in range(p, UNKNOWNS):
            out[q] = A[p, o]
            q += 1


@kernel
def target_equations(
    sources: SourcePoints,
    views: Int64,
    target: residual.TargetImage,
    T: Float64,
    residuals: PairResiduals,
    errors: Float64,
    known: Int64,
    radial_target: bool,
    out: Float64,
    sums: Float64,
) -> None:
    """Sum the normal equations of the K pairs of one target.

    Parameters
    ----------
    sources, views
        Points of all views, and the (K,) indices of those that are compared with the target.
    target
        The target.
    T
        (K, 4, 4) T_target_source.
    residuals
        Of these pairs.
    errors, known, radial_target
        As in `CameraErrors`.
    out
        (K, SIZE), is overwritten.
    sums
        (K, patches, PATCH_SIZE), is overwritten by the sums of the distances' equations over each
        patch. With 0 patches, or if camera errors are estimated, they are not computed.
    """
    exposure, scale_g, scale_p, inflation, robust, min_cosine = residuals
    out[:] = 0.0
    sums[:] = 0.0
    for k in range(len(views)):
        view = views[k]
        begin, end = sources.begin[view], sources.end[view]
        points = sources.points[begin:end]
        pair = residual.Residuals(
            exposure[k], scale_g[k], scale_p[k], inflation, robust, min_cosine
        )
        camera = CameraErrors(errors, known, sources.measures_range[view], radial_target)
        if known.all():
            patches = sources.patches[begin:end]
            _pose_equations(points, patches, target, T[k], pair, camera, out[k], sums[k])
        else:
            _calibration_equations(points, target, T[k], pair, camera, out[k])


@kernel
def _pose_equations(
    points: Float32,
    patches: Int64,
    target: residual.TargetImage,
    T: Float64,
    residuals: residual.Residuals,
    camera: CameraErrors,
    out: Float64,
    sums: Float64,
) -> None:
    """Add those with known camera errors, vectorised in blocks as in `alignment`."""
    errors, _, radial_source, radial_target = camera
    has_errors = (errors != 0).any()
    exposure, scale_g, scale_p, inflation, robust, min_cosine = residuals
    image, lookup, lookup_frame = target
    block = np.zeros(residual.ROWS * residual.LANES, np.float32)
    # Products of the rows of J and r, followed by counts and sums over columns.
    products, support = 36, 36 + residual.SQUARES_G - residual.INLIERS
    total = np.zeros((36 + residual.COUNT_P + 1 - residual.INLIERS, residual.LANES))
    for first in range(0, len(points), residual.LANES):
        count = min(residual.LANES, len(points) - first)
        residual.load_block(block, points[first : first + count])
        if has_errors:
            _correct_points(block, errors, radial_source)
        residual.transform_block(block, T)
        if has_errors:
            _distort_projection(block, errors, radial_target)
        residual.project_block(block, count, image, lookup, lookup_frame)
        residual.compare_planes(block, T, scale_g, inflation, robust, min_cosine)
        for k in range(count):
            if block[residual.HAS_PLANE * residual.LANES + k] > 0:
                out[COMPARED] += 1
                out[
                    HISTOGRAM + residual.histogram_bin(block[residual.CHI2 * residual.LANES + k])
                ] += 1
        if len(sums) > 0:
            _add_patches(sums, block, patches[first : first + count])
        residual.add_products(total, block, 8)
        _add_support(total[support], block, residual.WEIGHT_G)
        if scale_p > 0:
            residual.compare_albedos(block, T, exposure, scale_p, robust)
            residual.add_products(total, block, 8)
            _add_support(total[support], block, residual.WEIGHT_P)
        for statistic in (
            residual.IN_FRONT,
            residual.WEIGHT_P,
            residual.SQUARES_P,
            residual.COUNT_P,
        ):
            index = statistic - residual.INLIERS
            column = total[products + index]
            row = block[
                (residual.STAT + index) * residual.LANES : (residual.STAT + index + 1)
                * residual.LANES
            ]
            for k in range(residual.LANES):
                column[k] += row[k]
    width = residual.LANES
    while width > 1:
        width //= 2
        for q in range(len(total)):
            low, high = total[q, :width], total[q, width:]
            for k in range(width):
                low[k] += high[k]
    q, index = 0, PRODUCTS
    for p in range(8):
        for o in range(p, 8):
            if p < 7 and o < 7:
                out[index] = total[q, 0]
                index += 1
            elif p < 7:
                out[GRADIENT + p] = total[q, 0]
            q += 1
        index += ERRORS  # products with the camera errors remain 0
    out[IN_FRONT] = total[products + residual.IN_FRONT - residual.INLIERS, 0]
    out[WEIGHT_P] = total[products + residual.WEIGHT_P - residual.INLIERS, 0]
    out[SQUARES_P] = total[products + residual.SQUARES_P - residual.INLIERS, 0]
    out[TERMS] = out[COMPARED] + total[products + residual.COUNT_P - residual.INLIERS, 0]
    out[SUPPORT] = total[support, 0]


@kernel
def _correct_points(block: Float32, errors: Float64, radial: bool) -> None:
    """Displace the points of a block by camera errors, see `displacement`."""
    x = block[residual.POINT * residual.LANES : (residual.POINT + 1) * residual.LANES]
    y = block[(residual.POINT + 1) * residual.LANES : (residual.POINT + 2) * residual.LANES]
    z = block[(residual.POINT + 2) * residual.LANES : (residual.POINT + 3) * residual.LANES]
    for k in range(residual.LANES):
        lateral2 = x[k] * x[k] + y[k] * y[k]
        r2 = max(lateral2 + z[k] * z[k], _EPSILON)  # columns without a point may be 0
        ray_scale_error = errors[FOCAL] + errors[DISTORTION] * lateral2 / max(z[k] * z[k], _EPSILON)
        shortening = 0.0
        if radial:
            center_term = errors[CENTER_X] * x[k] + errors[CENTER_Y] * y[k]
            shortening = (ray_scale_error * lateral2 + center_term * z[k]) / r2
        depth_scale = 1 + errors[OFFSET] / np.sqrt(r2) + errors[SCALE] - shortening
        x[k] = x[k] * (depth_scale + ray_scale_error) + errors[CENTER_X] * z[k]
        y[k] = y[k] * (depth_scale + ray_scale_error) + errors[CENTER_Y] * z[k]
        z[k] *= depth_scale


@kernel
def _distort_projection(block: Float32, errors: Float64, radial: bool) -> None:
    """Move the transformed points of a block to where the erroneous target would measure them.

    To first order in the errors this is the inverse of `_correct_points`.
    """
    xn = block[residual.XN * residual.LANES : (residual.XN + 1) * residual.LANES]
    yn = block[residual.YN * residual.LANES : (residual.YN + 1) * residual.LANES]
    z = block[residual.Z * residual.LANES : (residual.Z + 1) * residual.LANES]
    for k in range(residual.LANES):
        if not z[k] > projection_kernels.MIN_DEPTH:  # it is not projected
            continue
        lateral2 = xn[k] * xn[k] + yn[k] * yn[k]
        r2 = lateral2 + 1
        ray_scale_error = errors[FOCAL] + errors[DISTORTION] * lateral2
        shortening = 0.0
        if radial:
            center_term = errors[CENTER_X] * xn[k] + errors[CENTER_Y] * yn[k]
            shortening = (ray_scale_error * lateral2 + center_term) / r2
        depth_scale = 1 - errors[OFFSET] / (np.sqrt(r2) * z[k]) - errors[SCALE] + shortening
        xn[k] = (xn[k] - errors[CENTER_X]) / (1 + ray_scale_error)
        yn[k] = (yn[k] - errors[CENTER_Y]) / (1 + ray_scale_error)
        z[k] *= depth_scale


@kernel
def _add_patches(sums: Float64, block: Float32, patches: Int64) -> None:
    """Add the weighted residuals and Jacobians of the distances of a block to their patches."""
    for k in range(len(patches)):
        if block[residual.IS_INLIER * residual.LANES + k] > 0:
            sqrt_weight = np.float64(block[residual.SQRT_WEIGHT * residual.LANES + k])
            patch = sums[patches[k]]
            patch[PATCH_WEIGHT] += sqrt_weight * sqrt_weight
            patch[PATCH_RESIDUAL] += (
                sqrt_weight * block[residual.WEIGHTED_RESIDUAL * residual.LANES + k]
            )
            for p in range(6):
                patch[PATCH_RESPONSE + p] += (
                    sqrt_weight * block[(residual.JACOBIAN + p) * residual.LANES + k]
                )


@kernel
def _add_support(total: Float64, block: Float32, statistic: int) -> None:
    """Add the support of the residuals whose robust weights are in a statistic."""
    index = residual.STAT + statistic - residual.INLIERS
    row = block[index * residual.LANES : (index + 1) * residual.LANES]
    for k in range(residual.LANES):
        total[k] += tukey.support(row[k])


@kernel
def _add_residual(
    A: Float64, g: Float64, J: Float64, r: float, weight: float, unknowns: int
) -> None:
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
    target: residual.TargetImage,
    T_target_world: Float64,
    T_world_source: Float64,
    tolerance: float,
    min_cosine: float,
    min_overlap: float,
    out: Float64,
) -> None:
    """Write to `out` (S,) the fraction of each source view's points that the target sees as well.

    Parameters
    ----------
    points, starts
        (M, POINT_SIZE) points of all views; those of view k are from starts[k] to starts[k + 1].
    sources
        (S,) indices of the source views.
    target
        The view that they are compared with.
    T_target_world, T_world_source
        (4, 4) of the target, and (N, 4, 4) of all views.
    tolerance, min_cosine
        Both see a point if its distance from the target's plane is below this fraction of the
        plane's distance, and the normals' cosine is above `min_cosine`.
    min_overlap
        Smaller fractions are reported as 0.
    """
    image, lookup, lookup_frame = target
    rows, columns = image.shape[0], image.shape[1]
    T = np.empty((3, 4))
    for s in range(len(sources)):
        pose = T_world_source[sources[s]]
        for a in range(3):
            for b in range(4):
                T[a, b] = T_target_world[a, 3] if b == 3 else 0.0
                for c in range(3):
                    T[a, b] += T_target_world[a, c] * pose[c, b]
        start, stop = starts[sources[s]], starts[sources[s] + 1]
        # With more unseen points than this, the overlap is certainly too small.
        max_unseen = (stop - start) - min_overlap * (stop - start) + 1e-9
        shared = 0
        for k in range(start, stop):
            if k - start - shared > max_unseen:
                break
            px, py, pz = (
                points[k, residual.POINT],
                points[k, residual.POINT + 1],
                points[k, residual.POINT + 2],
            )
            z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            if z <= projection_kernels.MIN_DEPTH:
                continue
            x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
            y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
            i, j = projection_kernels.nearest_pixel(
                x / z, y / z, lookup, lookup_frame, rows, columns
            )
            if i < 0:
                continue
            pixel = image[i, j]
            n0, n1, n2, distance = (
                pixel[residual.PLANE],
                pixel[residual.PLANE + 1],
                pixel[residual.PLANE + 2],
                pixel[residual.DISTANCE],
            )
            if distance == 0 or abs(n0 * x + n1 * y + n2 * z - distance) > tolerance * z:
                continue
            nx, ny, nz = (
                points[k, residual.NORMAL],
                points[k, residual.NORMAL + 1],
                points[k, residual.NORMAL + 2],
            )
            cosine = (
                n0 * (T[0, 0] * nx + T[0, 1] * ny + T[0, 2] * nz)
                + n1 * (T[1, 0] * nx + T[1, 1] * ny + T[1, 2] * nz)
                + n2 * (T[2, 0] * nx + T[2, 1] * ny + T[2, 2] * nz)
            )
            if cosine >= min_cosine:
                shared += 1
        fraction = shared / max(stop - start, 1)
        out[s] = fraction if fraction >= min_overlap else 0.0


@kernel
def marginalise_shared_errors(
    sums: Float64, correlation: Float64, variance: Float64, pairs: Int64, rows: Float64
) -> None:
    """Marginalise the patches' shared errors out of the normal equations of pairs, in place.

    Parameters
    ----------
    sums
        (N, patches, PATCH_SIZE), see `pair_equations.target_equations`.
    correlation
        (patches, patches) correlation of the errors of patches.
    variance
        (K,) variances of these errors, m^2.
    pairs
        (K,) indices of the pairs.
    rows
        (N, SIZE) equations of the pairs, see `pair_equations`; updated.
    """
    for k in range(len(pairs)):
        _marginalise(sums[pairs[k]], correlation, variance[k], rows[pairs[k]])


@kernel
def _marginalise(sums: Float64, correlation: Float64, variance: float, row: Float64) -> None:
    """Do the same for one pair."""
    count = len(sums)
    R = np.zeros((count, 7))
    sqrt_weight = np.sqrt(sums[:, PATCH_WEIGHT])
    for k in range(count):
        if sqrt_weight[k] > 0:
            for p in range(7):
                R[k, p] = sums[k, PATCH_RESIDUAL + p] / sqrt_weight[k]
    # Cholesky factor L of 1 + D^1/2 K D^1/2, row by row, and Z with L Z = R.
    L = np.zeros((count, count))
    Z = np.zeros((count, 7))
    for i in range(count):
        for j in range(i + 1):
            total = variance * sqrt_weight[i] * sqrt_weight[j] * correlation[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = np.sqrt(total + 1.0)
            else:
                L[i, j] = total / L[j, j]
        for p in range(7):
            total = R[i, p]
            for k in range(i):
                total -= L[i, k] * Z[k, p]
            Z[i, p] = total / L[i, i]
    for p in range(6):
        for k in range(count):
            row[GRADIENT + p] -= R[k, 0] * R[k, 1 + p] - Z[k, 0] * Z[k, 1 + p]
        index = PRODUCTS + p * UNKNOWNS - p * (p - 1) // 2
        for o in range(p, 6):
            for k in range(count):
                row[index + o - p] -= R[k, 1 + p] * R[k, 1 + o] - Z[k, 1 + p] * Z[k, 1 + o]
