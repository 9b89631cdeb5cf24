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
FOCAL = 2  # relative, to be added to distorted rays; measured depth is kept, z or radial
CENTER_X = 3  # to be added to the x / z of distorted rays: principal point over focal length
CENTER_Y = 4  # to be added to their y / z
DISTORTION = 5  # relative, times x^2 + y^2 of the ray coordinates, to be added to these
SOURCE_SCALE = 6  # as SCALE, but of the source view alone: to be estimated, not assumed
SOURCE_OFFSET = 7  # as OFFSET, likewise
ERRORS = 8

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
# Rows of a block after those of `alignment`: Jacobians with respect to the camera errors, and the
# points as measured.
_RESPONSE = residual.ROWS
_MEASURED = _RESPONSE + ERRORS
_ROWS = _MEASURED + 3
# Rows of the sums over columns: products of the rows of J and r; counts and sums, as from INLIERS
# to COUNT_P of `alignment`, with the support in place of one that is not needed.
_COUNTS = 36
_SUPPORT = _COUNTS + residual.SQUARES_G - residual.INLIERS
_TOTALS = _COUNTS + residual.COUNT_P + 1 - residual.INLIERS

# Layout of the sums of a patch: of w, w r and w J.
PATCH_WEIGHT = 0
PATCH_RESIDUAL = 1
PATCH_RESPONSE = 2
PATCH_SIZE = 8

# Largest number of targets of one call.
TARGETS = 8


class CameraErrors(NamedTuple):
    """Systematic errors of the cameras of a pair.

    Attributes
    ----------
    errors
        (ERRORS,) assumed errors, by which points and planes are displaced.
    estimated
        (E,) numbers of the errors that are estimated.
    radial_source, radial_target
        Whether the cameras measure radial range, not z.
    target_scale
        By which the depth in the target image is multiplied.
    lens
        (5,) as of `SourcePoints`.
    """

    errors: Float64
    estimated: Int64
    radial_source: bool
    radial_target: bool
    target_scale: float
    lens: Float32


class Scratch(NamedTuple):
    """Memory that all pairs use.

    Attributes
    ----------
    block
        (_ROWS * LANES,) of `residual_kernels`, and the responses to errors of the camera.
    total
        (_TOTALS, LANES) sums of each column.
    error_total
        (E, 8 + ERRORS, LANES) sums of products with each estimated error: of J and r, and of the
        errors from this one on.
    """

    block: Float32
    total: Float32
    error_total: Float32


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
    lens
        (5,) distortion of the lens of all views, see `cameras.lens.fitted`.
    """

    points: Float32
    patches: Int64
    begin: Int64
    end: Int64
    measures_range: Bool
    lens: Float32


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


class TargetViews(NamedTuple):
    """Up to `TARGETS` views that others are compared with, without their images.

    Attributes
    ----------
    measures_range
        (N,) as of `SourcePoints`.
    scale
        (N,) factors of the depth in the images.
    ends
        (N + 1,) the pairs of target k are from ends[k] to ends[k + 1].
    """

    measures_range: Bool
    scale: Float64
    ends: Int64


@kernel
def target_equations(
    sources: SourcePoints,
    views: Int64,
    images: tuple[residual.TargetImage, ...],
    targets: TargetViews,
    T: Float64,
    residuals: PairResiduals,
    errors: Float64,
    known: Int64,
    out: Float64,
    sums: Float64,
) -> None:
    """Sum the normal equations of the K pairs of some targets.

    Parameters
    ----------
    sources, views
        Points of all views, and the (K,) indices of those that are compared with the targets.
    images, targets
        The N targets: several, as a call costs as much as a pair. `TARGETS` images, of which those
        beyond N are not used.
    T
        (K, 4, 4) T_target_source.
    residuals
        Of these pairs.
    errors, known
        (ERRORS,) assumed errors of the camera, and non-zero for those that are not estimated.
    out
        (K, SIZE), is overwritten.
    sums
        (K, patches, PATCH_SIZE), is overwritten by the sums of the distances' equations over each
        patch. With 0 patches they are not computed.
    """
    exposure, scale_g, scale_p, inflation, robust, min_cosine = residuals
    out[:] = 0.0
    sums[:] = 0.0
    estimated = np.flatnonzero(known == 0)
    scratch = Scratch(
        np.zeros(_ROWS * residual.LANES, np.float32),
        np.empty((_TOTALS, residual.LANES), np.float32),
        np.empty((len(estimated), 8 + ERRORS, residual.LANES), np.float32),
    )
    for t in range(len(targets.scale)):
        for k in range(targets.ends[t], targets.ends[t + 1]):
            view = views[k]
            begin, end = sources.begin[view], sources.end[view]
            pair = residual.Residuals(
                exposure[k], scale_g[k], scale_p[k], inflation, robust, min_cosine
            )
            camera = CameraErrors(
                errors,
                estimated,
                sources.measures_range[view],
                targets.measures_range[t],
                targets.scale[t],
                sources.lens,
            )
            _pair_equations(
                sources.points[begin:end],
                sources.patches[begin:end],
                images[t],
                T[k],
                pair,
                camera,
                scratch,
                out[k],
                sums[k],
            )


@kernel
def _pair_equations(
    points: Float32,
    patches: Int64,
    target: residual.TargetImage,
    T: Float64,
    residuals: residual.Residuals,
    camera: CameraErrors,
    scratch: Scratch,
    out: Float64,
    sums: Float64,
) -> None:
    """Add those of one pair, vectorised in blocks as in `alignment`."""
    errors, estimated, radial_source, radial_target, target_scale, lens = camera
    has_errors = (errors != 0).any()
    errors32 = errors.astype(np.float32)
    exposure, scale_g, scale_p, inflation, robust, min_cosine = residuals
    image, lookup, lookup_frame = target
    block, total, error_total = scratch
    total[:] = 0
    error_total[:] = 0
    for first in range(0, len(points), residual.LANES):
        count = min(residual.LANES, len(points) - first)
        residual.load_block(block, points[first : first + count])
        if len(estimated) > 0:
            block[_MEASURED * residual.LANES :] = block[
                residual.POINT * residual.LANES : (residual.POINT + 3) * residual.LANES
            ]
        if has_errors:
            _correct_points(block, errors32, lens, radial_source)
        residual.transform_block(block, T)
        if has_errors:
            _distort_projection(block, errors32, lens, radial_target)
        residual.project_block(block, count, image, lookup, lookup_frame)
        if target_scale != 1:
            _scale_planes(block, target_scale)
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
        if len(estimated) > 0:
            _respond_to_errors(block, T, lens, radial_source, radial_target, True)
            _add_error_products(error_total, block, estimated)
        _add_support(total[_SUPPORT], block, residual.WEIGHT_G)
        if scale_p > 0:
            residual.compare_albedos(block, T, exposure, scale_p, robust)
            residual.add_products(total, block, 8)
            if len(estimated) > 0:
                _respond_to_errors(block, T, lens, radial_source, radial_target, False)
                _add_error_products(error_total, block, estimated)
            _add_support(total[_SUPPORT], block, residual.WEIGHT_P)
        for statistic in (
            residual.IN_FRONT,
            residual.WEIGHT_P,
            residual.SQUARES_P,
            residual.COUNT_P,
        ):
            index = statistic - residual.INLIERS
            column = total[_COUNTS + index]
            row = block[
                (residual.STAT + index) * residual.LANES : (residual.STAT + index + 1)
                * residual.LANES
            ]
            for k in range(residual.LANES):
                column[k] += row[k]
    residual.sum_columns(total)
    q = 0
    for p in range(8):
        for o in range(p, 8):
            if o < 7:
                out[_product(p, o)] = total[q, 0]
            elif p < 7:
                out[GRADIENT + p] = total[q, 0]
            q += 1
    for k in range(len(estimated)):
        residual.sum_columns(error_total[k])
        unknown = 7 + estimated[k]
        for p in range(7):
            out[_product(p, unknown)] = error_total[k, p, 0]
        out[GRADIENT + unknown] = error_total[k, 7, 0]
        for o in range(k, len(estimated)):
            out[_product(unknown, 7 + estimated[o])] = error_total[k, 8 + o, 0]
    out[IN_FRONT] = total[_COUNTS + residual.IN_FRONT - residual.INLIERS, 0]
    out[WEIGHT_P] = total[_COUNTS + residual.WEIGHT_P - residual.INLIERS, 0]
    out[SQUARES_P] = total[_COUNTS + residual.SQUARES_P - residual.INLIERS, 0]
    out[TERMS] = out[COMPARED] + total[_COUNTS + residual.COUNT_P - residual.INLIERS, 0]
    out[SUPPORT] = total[_SUPPORT, 0]


@kernel
def _product(p: int, o: int) -> int:
    """Return the position in `out` of the product of two unknowns, p <= o."""
    return PRODUCTS + p * UNKNOWNS - p * (p - 1) // 2 + o - p


@kernel
def _respond_to_errors(
    block: Float32,
    T: Float64,
    lens: Float32,
    radial_source: bool,
    radial_target: bool,
    is_distance: bool,
) -> None:
    """Write the Jacobians of a block's residuals with respect to the errors of the camera.

    The displacement b(p) of a point by an error of size 1 is along p for those of the range; errors
    of the intrinsics move it sideways, by the slope of the lens's distortion, and along p so that
    the measured depth is kept. The same mean of both views' normals or gradients is used for source
    and target: otherwise the difference between these, which the pose cannot explain, would be
    attributed to the errors.
    """
    r00, r01, r02 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2])
    r10, r11, r12 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2])
    r20, r21, r22 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2])
    one, zero, tiny = np.float32(1), np.float32(0), np.float32(_EPSILON)
    radial_p = one if radial_source else zero
    radial_q = one if radial_target else zero
    # The albedo of a pixel is that of its ray, whatever its range. Neither gradient has a part
    # along the rays of its own image: with their mean, the response to the range of the source
    # alone is that to a common one.
    from_q = zero if is_distance else one
    for k in range(residual.LANES):
        m0 = block[residual.JACOBIAN * residual.LANES + k]
        m1 = block[(residual.JACOBIAN + 1) * residual.LANES + k]
        m2 = block[(residual.JACOBIAN + 2) * residual.LANES + k]
        n0 = r00 * m0 + r01 * m1 + r02 * m2
        n1 = r10 * m0 + r11 * m1 + r12 * m2
        n2 = r20 * m0 + r21 * m1 + r22 * m2
        px = block[_MEASURED * residual.LANES + k]
        py = block[(_MEASURED + 1) * residual.LANES + k]
        pz = block[(_MEASURED + 2) * residual.LANES + k]
        qz = block[residual.Z * residual.LANES + k]
        qx = qz * block[residual.XN * residual.LANES + k]
        qy = qz * block[residual.YN * residual.LANES + k]
        lateral_p, lateral_q = px * px + py * py, qx * qx + qy * qy
        p2, q2 = max(lateral_p + pz * pz, tiny), max(lateral_q + qz * qz, tiny)
        along_p = m0 * px + m1 * py + m2 * pz
        along_q = n0 * qx + n1 * qy + n2 * qz
        kept_p, kept_q = radial_p * along_p / p2, radial_q * along_q / q2
        rho2_p = lateral_p / max(pz * pz, tiny)
        rho2_q = lateral_q / max(qz * qz, tiny)
        bend_p = projection_kernels.bend(rho2_p, lens)
        bend_q = projection_kernels.bend(rho2_q, lens)
        # Lengthening the distorted ray lengthens the ray itself by this factor.
        longer_p, longer_q = one - bend_p * rho2_p, one - bend_q * rho2_q
        across_p, across_q = m0 * px + m1 * py, n0 * qx + n1 * qy
        scaled_p, scaled_q = across_p - lateral_p * kept_p, across_q - lateral_q * kept_q
        steep_p = bend_p * across_p / max(pz * pz, tiny) + longer_p * kept_p
        steep_q = bend_q * across_q / max(qz * qz, tiny) + longer_q * kept_q
        center_p = pz / projection_kernels.distortion(rho2_p, lens)
        center_q = qz / projection_kernels.distortion(rho2_q, lens)
        per_metre_p, per_metre_q = along_p / np.sqrt(p2), along_q / np.sqrt(q2)
        block[(_RESPONSE + OFFSET) * residual.LANES + k] = per_metre_p - per_metre_q
        block[(_RESPONSE + SOURCE_OFFSET) * residual.LANES + k] = per_metre_p - from_q * per_metre_q
        block[(_RESPONSE + SCALE) * residual.LANES + k] = along_p - along_q
        block[(_RESPONSE + SOURCE_SCALE) * residual.LANES + k] = along_p - from_q * along_q
        block[(_RESPONSE + FOCAL) * residual.LANES + k] = longer_p * scaled_p - longer_q * scaled_q
        block[(_RESPONSE + CENTER_X) * residual.LANES + k] = center_p * (
            m0 - px * steep_p
        ) - center_q * (n0 - qx * steep_q)
        block[(_RESPONSE + CENTER_Y) * residual.LANES + k] = center_p * (
            m1 - py * steep_p
        ) - center_q * (n1 - qy * steep_q)
        block[(_RESPONSE + DISTORTION) * residual.LANES + k] = rho2_p * scaled_p - rho2_q * scaled_q


@kernel
def _add_error_products(total: Float32, block: Float32, estimated: Int64) -> None:
    """Add the products of the Jacobians of estimated errors with J and r, and with each other."""
    for i in range(len(estimated)):
        begin = (_RESPONSE + estimated[i]) * residual.LANES
        a = block[begin : begin + residual.LANES]
        for p in range(8):
            b = block[(residual.JACOBIAN + p) * residual.LANES :]
            row = total[i, p]
            for k in range(residual.LANES):
                row[k] += a[k] * b[k]
        for o in range(i, len(estimated)):
            begin = (_RESPONSE + estimated[o]) * residual.LANES
            b = block[begin : begin + residual.LANES]
            row = total[i, 8 + o]
            for k in range(residual.LANES):
                row[k] += a[k] * b[k]


@kernel
def _correct_points(block: Float32, errors: Float32, lens: Float32, radial: bool) -> None:
    """Displace the points of a block by camera errors, see `_respond_to_errors`."""
    x = block[residual.POINT * residual.LANES : (residual.POINT + 1) * residual.LANES]
    y = block[(residual.POINT + 1) * residual.LANES : (residual.POINT + 2) * residual.LANES]
    z = block[(residual.POINT + 2) * residual.LANES : (residual.POINT + 3) * residual.LANES]
    one, tiny = np.float32(1), np.float32(_EPSILON)
    offset, scale = errors[OFFSET], one + errors[SCALE]
    focal, distortion = one + errors[FOCAL], errors[DISTORTION]
    center_x, center_y = errors[CENTER_X], errors[CENTER_Y]
    for k in range(residual.LANES):
        nonzero = max(z[k], tiny)  # columns without a point may be 0
        xn, yn = x[k] / nonzero, y[k] / nonzero
        rho2 = xn * xn + yn * yn
        length = np.sqrt(rho2 + one)
        factor = focal * projection_kernels.distortion(rho2, lens)
        # The pixel sees another ray, and along it what it measured: z or radial range.
        ray_x, ray_y = projection_kernels.undistorted(
            factor * xn + center_x, factor * yn + center_y, xn, yn, lens
        )
        ray_x += distortion * rho2 * xn
        ray_y += distortion * rho2 * yn
        shorter = length / np.sqrt(ray_x * ray_x + ray_y * ray_y + one)
        depth = (z[k] * scale + offset / length) * (shorter if radial else one)
        x[k], y[k], z[k] = ray_x * depth, ray_y * depth, depth


@kernel
def _distort_projection(block: Float32, errors: Float32, lens: Float32, radial: bool) -> None:
    """Move the transformed points of a block to where the erroneous target would measure them.

    This is the inverse of `_correct_points`, except for terms of second order by a distortion.
    """
    xn = block[residual.XN * residual.LANES : (residual.XN + 1) * residual.LANES]
    yn = block[residual.YN * residual.LANES : (residual.YN + 1) * residual.LANES]
    z = block[residual.Z * residual.LANES : (residual.Z + 1) * residual.LANES]
    one = np.float32(1)
    offset, scale = errors[OFFSET], one + errors[SCALE]
    focal, distortion = one + errors[FOCAL], errors[DISTORTION]
    center_x, center_y = errors[CENTER_X], errors[CENTER_Y]
    for k in range(residual.LANES):
        # Only where the point is projected; no branch, so that the loop is vectorised.
        is_projected = z[k] > np.float32(projection_kernels.MIN_DEPTH)
        length = np.sqrt(xn[k] * xn[k] + yn[k] * yn[k] + one)
        smaller = one + distortion * (xn[k] * xn[k] + yn[k] * yn[k])
        x, y = xn[k] / smaller, yn[k] / smaller
        factor = projection_kernels.distortion(x * x + y * y, lens)
        ray_x, ray_y = projection_kernels.undistorted(
            (factor * x - center_x) / focal, (factor * y - center_y) / focal, x, y, lens
        )
        longer = length / np.sqrt(ray_x * ray_x + ray_y * ray_y + one)
        depth = (z[k] - offset / length) / scale * (longer if radial else one)
        xn[k] = ray_x if is_projected else xn[k]
        yn[k] = ray_y if is_projected else yn[k]
        z[k] = depth if is_projected else z[k]


@kernel
def _scale_planes(block: Float32, scale: float) -> None:
    """Multiply the depth of the target's planes that a block's points are compared with."""
    distance, variance = residual.PIXEL + residual.DISTANCE, residual.PIXEL + residual.VARIANCE
    scale32, squared = np.float32(scale), np.float32(scale * scale)
    for k in range(residual.LANES):
        block[distance * residual.LANES + k] *= scale32
        block[variance * residual.LANES + k] *= squared


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
def _add_support(total: Float32, block: Float32, statistic: int) -> None:
    """Add the support of the residuals whose robust weights are in a statistic."""
    index = residual.STAT + statistic - residual.INLIERS
    row = block[index * residual.LANES : (index + 1) * residual.LANES]
    for k in range(residual.LANES):
        total[k] += tukey.support(row[k])


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
    block = np.zeros(residual.ROWS * residual.LANES, np.float32)
    T = np.zeros((4, 4))
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
        for first in range(start, stop, residual.LANES):
            if first - start - shared > max_unseen:
                break
            count = min(residual.LANES, stop - first)
            residual.load_block(block, points[first : first + count])
            residual.transform_block(block, T)
            residual.project_block(block, count, image, lookup, lookup_frame)
            shared += _on_same_surfaces(block, T, tolerance, min_cosine)
        fraction = shared / max(stop - start, 1)
        out[s] = fraction if fraction >= min_overlap else 0.0


@kernel
def _on_same_surfaces(block: Float32, T: Float64, tolerance: float, min_cosine: float) -> int:
    """Return how many points of a block are on the planes of their pixels, see `overlaps`."""
    r00, r01, r02 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2])
    r10, r11, r12 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2])
    r20, r21, r22 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2])
    tolerance32, min_cosine32 = np.float32(tolerance), np.float32(min_cosine)
    shared = 0
    for k in range(residual.LANES):
        n0 = block[(residual.PIXEL + residual.PLANE) * residual.LANES + k]
        n1 = block[(residual.PIXEL + residual.PLANE + 1) * residual.LANES + k]
        n2 = block[(residual.PIXEL + residual.PLANE + 2) * residual.LANES + k]
        s0 = block[residual.NORMAL * residual.LANES + k]
        s1 = block[(residual.NORMAL + 1) * residual.LANES + k]
        s2 = block[(residual.NORMAL + 2) * residual.LANES + k]
        z = block[residual.Z * residual.LANES + k]
        ray = n0 * block[residual.XN * residual.LANES + k]
        ray += n1 * block[residual.YN * residual.LANES + k] + n2
        distance = z * ray - block[(residual.PIXEL + residual.DISTANCE) * residual.LANES + k]
        cosine = (
            n0 * (r00 * s0 + r01 * s1 + r02 * s2)
            + n1 * (r10 * s0 + r11 * s1 + r12 * s2)
            + n2 * (r20 * s0 + r21 * s1 + r22 * s2)
        )
        near = (abs(distance) <= tolerance32 * z) & (cosine >= min_cosine32)
        shared += 1 if near & (block[residual.HAS_PLANE * residual.LANES + k] > 0) else 0
    return shared


@kernel
def marginalise_shared_errors(
    sums: Float64,
    correlation: Float64,
    variance: Float64,
    pairs: Int64,
    cutoff: float,
    rows: Float64,
) -> None:
    """Marginalise the patches' shared errors out of the normal equations of pairs, in place.

    What they explain of the residuals is added to the support.

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
    cutoff
        Residual that has no weight, in standard deviations.
    rows
        (N, SIZE) equations of the pairs, see `pair_equations`; updated.
    """
    for k in range(len(pairs)):
        explained = _marginalise(sums[pairs[k]], correlation, variance[k], rows[pairs[k]])
        # The slope of the support (1 - r^2 / cutoff^2)^3 by the squared residual is its weight.
        rows[pairs[k], SUPPORT] += 3 / cutoff**2 * explained


@kernel
def _marginalise(sums: Float64, correlation: Float64, variance: float, row: Float64) -> float:
    """Do the same for one pair; return by how much its weighted squared residuals decrease."""
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
        index = _product(p, p)
        for o in range(p, 6):
            for k in range(count):
                row[index + o - p] -= R[k, 1 + p] * R[k, 1 + o] - Z[k, 1 + p] * Z[k, 1 + o]
    explained = 0.0
    for k in range(count):
        explained += R[k, 0] ** 2 - Z[k, 0] ** 2
    return explained
