"""Exhaustive search for the relative pose of two range images, and their agreement under a pose.

Images are resampled to pinhole grids (H, W, 5): the unit normal (away from the camera) and the
distance n . p of the plane on the node's ray; 0, 0, 0 and the negative depth where only a depth is
known; 0 where nothing is known; and the log albedo, NaN where unknown. The frame
(x0, y0, 1/dx, 1/dy) defines the ray coordinates of the nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.alignment import step_kernels
from tofuse.engine.arrays import Float32, Float64, Int32, Int64
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import retract

# m; points nearer to the camera are not projected.
_MIN_DEPTH = 0.05
# Largest penalty of albedo differences, relative to the weight of the supporting points.
_MAX_ALBEDO_PENALTY = 2.0
# A pose has converged when its step is smaller than this fraction of the cut-off.
_CONVERGED = 0.001
# Layout of the counts that `measure_agreement` returns.
PROJECTED = 0
COMPARED = 1
SUPPORT = 2
VIOLATION = 3
SQUARES_M = 4
AGREEMENT_SIZE = 5


# Poses are scored in structure-of-arrays blocks, one pose per column, so that loops over poses are
# vectorised. Rows of a block: the pose (rotation, then translation), the transformed point, the
# target node that it projects to, and the sums: support minus violations, the weights of the points
# whose albedo is compared, and the weighted sums of their log albedo differences and squares.
_LANES = 128
_ROTATION, _TRANSLATION, _POSITION, _PIXEL, _TOTAL, _ALBEDO = 0, 9, 12, 15, 20, 21
_ROWS = 24


class Resampled(NamedTuple):
    """A view resampled to a grid, and some of its points.

    Attributes
    ----------
    points, normals
        (N, 3) m and (N, 3) unit, in the frame of the camera.
    log_albedo
        (N,) at the points, NaN where unknown.
    grid, frame
        The image, as described above.
    """

    points: Float32
    normals: Float32
    log_albedo: Float32
    grid: Float32
    frame: Float64


class ViewPoints(NamedTuple):
    """Points on the planes of a view.

    Attributes
    ----------
    points, normals
        (N, 3) m, and unit, away from the camera.
    sigma
        (N,) of their z, m.
    log_albedo
        (N,) log albedo, NaN where unknown.
    """

    points: Float32
    normals: Float32
    sigma: Float32
    log_albedo: Float32


class Image(NamedTuple):
    """An image that points are compared with.

    Attributes
    ----------
    planes, plane_variance, lookup, lookup_frame
        As in `alignment.ViewImages` and `project_ray`.
    albedo
        (H, W, 3) log albedo (first channel), NaN where unknown.
    nearest
        (H, W) lower bound of the depth, m, 0 where unknown: the free space of pixels without a
        plane.
    """

    planes: Float32
    plane_variance: Float32
    albedo: Float32
    nearest: Float32
    lookup: Float32
    lookup_frame: Float64


class Tolerance(NamedTuple):
    """Tolerance of points that support a pose.

    Attributes
    ----------
    sigmas, floor_m, floor_fraction
        A point supports the pose if its distance from the plane is below `sigmas` standard
        deviations plus `floor_m` plus `floor_fraction` times its depth; it violates free space if
        it is in front of the surface by more than twice that.
    min_cosine
        Smallest cosine between the normals of a supporting point and the plane.
    """

    sigmas: float
    floor_m: float
    floor_fraction: float
    min_cosine: float


@kernel
def _score_points(
    view: Resampled, other: Resampled, reach: float, block: Float32, node: Int32
) -> None:
    """Add the scores of one view's points, projected into the other image, for a block of poses.

    A point supports a pose by up to 1, and counts -2 if it lies in the other camera's free space.

    Parameters
    ----------
    view, other
        The view of the points, and the other one.
    reach
        See `score_grid`.
    block
        (_ROWS * _LANES,) poses and their sums, updated.
    node
        (_LANES,) scratch: flat index of the node that the point projects to.
    """
    points, normals, log_albedo, _, _ = view
    grid, frame = other.grid, other.frame
    rows, columns = np.int32(grid.shape[0]), np.int32(grid.shape[1])
    planes = grid.reshape(grid.size)
    su, sv = np.float32(frame[2]), np.float32(frame[3])
    u0, v0 = np.float32(0.5 - frame[0] * frame[2]), np.float32(0.5 - frame[1] * frame[3])
    min_depth, zero, one, two = np.float32(_MIN_DEPTH), np.float32(0), np.float32(1), np.float32(2)
    # Upper limits, so that coordinates fit into an integer.
    far_u, far_v = np.float32(columns), np.float32(rows)
    reach32, inv_reach2 = np.float32(reach), np.float32(1.0 / (reach * reach))
    for k in range(len(points)):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        projected = 0
        for b in range(_LANES):
            x = block[b] * px + block[_LANES + b] * py + block[2 * _LANES + b] * pz
            y = block[3 * _LANES + b] * px + block[4 * _LANES + b] * py + block[5 * _LANES + b] * pz
            z = block[6 * _LANES + b] * px + block[7 * _LANES + b] * py + block[8 * _LANES + b] * pz
            x += block[_TRANSLATION * _LANES + b]
            y += block[(_TRANSLATION + 1) * _LANES + b]
            z += block[(_TRANSLATION + 2) * _LANES + b]
            in_front = z > min_depth
            inv_z = one / z if in_front else zero
            u = x * inv_z * su + u0
            v = y * inv_z * sv + v0
            inside = in_front & (u > zero) & (v > zero) & (u < far_u) & (v < far_v)
            j = np.int32(u if inside else zero)
            i = np.int32(v if inside else zero)
            node[b] = i * columns + j if inside else np.int32(-1)
            projected += inside
            block[_POSITION * _LANES + b] = x
            block[(_POSITION + 1) * _LANES + b] = y
            block[(_POSITION + 2) * _LANES + b] = z
        if projected == 0:
            continue
        for b in range(_LANES):
            index = 5 * max(node[b], np.int32(0))
            block[_PIXEL * _LANES + b] = planes[index]
            block[(_PIXEL + 1) * _LANES + b] = planes[index + 1]
            block[(_PIXEL + 2) * _LANES + b] = planes[index + 2]
            block[(_PIXEL + 3) * _LANES + b] = planes[index + 3] if node[b] >= 0 else zero
            block[(_PIXEL + 4) * _LANES + b] = planes[index + 4]
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        source_albedo = log_albedo[k]
        for b in range(_LANES):
            m0, m1 = block[_PIXEL * _LANES + b], block[(_PIXEL + 1) * _LANES + b]
            m2, d = block[(_PIXEL + 2) * _LANES + b], block[(_PIXEL + 3) * _LANES + b]
            z = block[(_POSITION + 2) * _LANES + b]
            x, y = block[_POSITION * _LANES + b], block[(_POSITION + 1) * _LANES + b]
            r = m0 * x + m1 * y + m2 * z - d
            n0 = block[b] * nx + block[_LANES + b] * ny + block[2 * _LANES + b] * nz
            n1 = (
                block[3 * _LANES + b] * nx + block[4 * _LANES + b] * ny + block[5 * _LANES + b] * nz
            )
            n2 = (
                block[6 * _LANES + b] * nx + block[7 * _LANES + b] * ny + block[8 * _LANES + b] * nz
            )
            c = m0 * n0 + m1 * n1 + m2 * n2
            violation = ((d > zero) & (r < -reach32)) | ((d < zero) & (z < -d - reach32))
            inlier = (d > zero) & (r >= -reach32) & (r < reach32) & (c > zero)
            w = c * (one - r * r * inv_reach2) if inlier else zero
            block[_TOTAL * _LANES + b] += w - (two if violation else zero)
            albedo_difference = block[(_PIXEL + 4) * _LANES + b] - source_albedo
            known = albedo_difference == albedo_difference
            w = w if known else zero
            albedo_difference = albedo_difference if known else zero
            block[_ALBEDO * _LANES + b] += w
            block[(_ALBEDO + 1) * _LANES + b] += w * albedo_difference
            block[(_ALBEDO + 2) * _LANES + b] += w * albedo_difference * albedo_difference


@kernel
def select_distinct(
    rotations: Float64, translations: Float64, depth: float, min_distance: float, count: int
) -> Int64:
    """Return the indices of the first `count` poses that differ from all those selected before.

    Parameters
    ----------
    rotations, translations
        (N, 3, 3) and (N, 3), best first.
    depth, min_distance
        Poses differ if they displace a point at `depth` m by more than `min_distance` m.
    count
        Maximum number of poses.
    """
    selected = np.empty(min(count, len(rotations)), np.int64)
    size = 0
    for k in range(len(rotations)):
        distinct = True
        for other in selected[:size]:
            trace = 0.0
            distance2 = 0.0
            for i in range(3):
                for j in range(3):
                    trace += rotations[k, i, j] * rotations[other, i, j]
                distance2 += (translations[k, i] - translations[other, i]) ** 2
            angle = np.sqrt(max(3.0 - trace, 0.0))  # about the angle
            if angle * depth + np.sqrt(distance2) <= min_distance:
                distinct = False
                break
        if distinct:
            selected[size] = k
            size += 1
            if size == count:
                break
    return selected[:size]


@kernel
def score_grid(
    source: Resampled,
    target: Resampled,
    rotations: Float64,
    translations: Float64,
    reach: float,
    albedo_sigma: float,
    scores: Float32,
    start: int,
    stop: int,
) -> None:
    """Score the candidate poses of the rotations start..stop, in both directions.

    Parameters
    ----------
    source, target
        The views.
    rotations, translations
        (A, 3, 3) and (A, B, 3), or (1, B, 3) for all rotations, of T_target_source.
    reach
        Distance from a plane within which a point supports the pose, m; a point in front of the
        surface by more than that violates free space.
    albedo_sigma
        Standard deviation of log albedo differences (without exposure) at which the penalty cancels
        the support.
    scores
        (A, B), written: support minus twice the violations minus the albedo penalty, divided by
        the number of points.
    """
    inv_count = 1.0 / max(len(source.points) + len(target.points), 1)
    inv_sigma2 = 1.0 / (albedo_sigma * albedo_sigma)
    poses_per_rotation = translations.shape[1]
    forward, backward = np.zeros(_ROWS * _LANES, np.float32), np.zeros(_ROWS * _LANES, np.float32)
    node = np.empty(_LANES, np.int32)
    for first in range(start * poses_per_rotation, stop * poses_per_rotation, _LANES):
        count = min(_LANES, stop * poses_per_rotation - first)
        for b in range(_LANES):
            a, c = divmod(first + min(b, count - 1), poses_per_rotation)
            R, t = rotations[a], translations[min(a, translations.shape[0] - 1), c]
            for i in range(3):
                inverse_translation = 0.0
                for j in range(3):
                    forward[(_ROTATION + 3 * i + j) * _LANES + b] = R[i, j]
                    backward[(_ROTATION + 3 * i + j) * _LANES + b] = R[j, i]
                    inverse_translation -= R[j, i] * t[j]
                forward[(_TRANSLATION + i) * _LANES + b] = t[i]
                backward[(_TRANSLATION + i) * _LANES + b] = inverse_translation
        forward[_TOTAL * _LANES :] = np.float32(0)
        backward[_TOTAL * _LANES :] = np.float32(0)
        _score_points(source, target, reach, forward, node)
        _score_points(target, source, reach, backward, node)
        for b in range(count):
            total = np.float64(forward[_TOTAL * _LANES + b]) + backward[_TOTAL * _LANES + b]
            k = _ALBEDO * _LANES + b
            weight = np.float64(forward[k]) + backward[k]
            if weight > 0:
                # The mean difference is the exposure, which has opposite signs in the two
                # directions.
                mean = np.float64(forward[k + _LANES]) - backward[k + _LANES]
                square = np.float64(forward[k + 2 * _LANES]) + backward[k + 2 * _LANES]
                penalty = (square - mean * mean / weight) * inv_sigma2
                total -= min(penalty, _MAX_ALBEDO_PENALTY * weight)
            a, c = divmod(first + b, poses_per_rotation)
            scores[a, c] = total * inv_count


@kernel
def _add_equations(
    view: Resampled,
    other: Resampled,
    T: Float64,
    forward: bool,
    reach: float,
    min_cosine: float,
    H: Float64,
    g: Float64,
) -> None:
    """Add the equations of a view's points and the other's planes to H (6, 6) and g (6,).

    They are those of the right perturbation of T = T_target_source in either case: if `forward`,
    the view is the source, else the target. Only the lower triangle of H is written.
    """
    points, normals, grid, frame = view.points, view.normals, other.grid, other.frame
    rows, columns = grid.shape[0], grid.shape[1]
    x0, y0, sx, sy = frame[0], frame[1], frame[2], frame[3]
    J = np.empty(6)
    A = np.empty((3, 3))
    t = np.empty(3)
    for i in range(3):
        t[i] = 0.0
        for j in range(3):
            A[i, j] = T[i, j] if forward else T[j, i]
    for i in range(3):
        if forward:
            t[i] = T[i, 3]
        else:
            t[i] = -(T[0, i] * T[0, 3] + T[1, i] * T[1, 3] + T[2, i] * T[2, 3])
    inv_reach2 = 1.0 / (reach * reach)
    for k in range(points.shape[0]):
        px = np.float64(points[k, 0])
        py = np.float64(points[k, 1])
        pz = np.float64(points[k, 2])
        z = A[2, 0] * px + A[2, 1] * py + A[2, 2] * pz + t[2]
        if z <= _MIN_DEPTH:
            continue
        x = A[0, 0] * px + A[0, 1] * py + A[0, 2] * pz + t[0]
        y = A[1, 0] * px + A[1, 1] * py + A[1, 2] * pz + t[1]
        u = (x / z - x0) * sx
        v = (y / z - y0) * sy
        if not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
            continue
        i = int(v + 0.5)
        j = int(u + 0.5)
        d = np.float64(grid[i, j, 3])
        if d <= 0:
            continue
        n0 = np.float64(grid[i, j, 0])
        n1 = np.float64(grid[i, j, 1])
        n2 = np.float64(grid[i, j, 2])
        r = n0 * x + n1 * y + n2 * z - d
        e2 = r * r * inv_reach2
        if e2 >= 1:
            continue
        # The plane's normal in the frame of the points.
        m0 = A[0, 0] * n0 + A[1, 0] * n1 + A[2, 0] * n2
        m1 = A[0, 1] * n0 + A[1, 1] * n1 + A[2, 1] * n2
        m2 = A[0, 2] * n0 + A[1, 2] * n1 + A[2, 2] * n2
        if m0 * normals[k, 0] + m1 * normals[k, 1] + m2 * normals[k, 2] < min_cosine:
            continue
        w = tukey.weight(e2)
        if forward:
            projection_kernels.jacobian_row(J, m0, m1, m2, px, py, pz)
        else:
            # T exp(xi) transforms a target point by exp(-xi) in the source frame.
            projection_kernels.jacobian_row(J, -n0, -n1, -n2, x, y, z)
        for p in range(6):
            g[p] += w * J[p] * r
            for o in range(p + 1):
                H[p, o] += w * J[o] * J[p]


@kernel
def refine_poses(
    source: Resampled,
    target: Resampled,
    reaches: Float64,
    min_cosine: float,
    unit_m: float,
    poses: Float64,
    start: int,
    stop: int,
) -> None:
    """Refine the poses start..stop in place by symmetric projective point-to-plane ICP.

    Parameters
    ----------
    source, target
        The views.
    reaches
        (I,) cut-off of Tukey's biweight in each iteration, m.
    min_cosine
        Smallest cosine between corresponding normals.
    unit_m
        Length in m that corresponds to one radian, for isotropic damping.
    poses
        (N, 4, 4) T_target_source.
    """
    H = np.empty((6, 6))
    step = np.empty(6)
    for c in range(start, stop):
        T = poses[c].copy()
        for k in range(len(reaches)):
            reach = reaches[k]
            H[:] = 0
            step[:] = 0
            _add_equations(source, target, T, True, reach, min_cosine, H, step)
            _add_equations(target, source, T, False, reach, min_cosine, H, step)
            damping = 1e-3 * (H[0, 0] + H[1, 1] + H[2, 2]) + 1e-9
            for p in range(3):
                H[p, p] += damping
                H[p + 3, p + 3] += damping * unit_m * unit_m
            step_kernels.solve_positive(H, step)
            step *= -1
            T = retract(T, step)
            translation2 = step[0] ** 2 + step[1] ** 2 + step[2] ** 2
            rotation2 = step[3] ** 2 + step[4] ** 2 + step[5] ** 2
            # Converged at the final reach.
            if (
                translation2 + unit_m * unit_m * rotation2 < (_CONVERGED * reach) ** 2
                and reach == reaches[-1]
            ):
                break
        for i in range(4):
            for j in range(4):
                poses[c, i, j] = T[i, j]


@kernel
def measure_agreement(
    view_points: ViewPoints,
    image: Image,
    T: Float64,
    tolerance: Tolerance,
    differences: Float32,
    log_cosine_ratios: Float32,
    start: int,
    stop: int,
) -> Float64:
    """Count the points start..stop of a view that agree with another image under a pose.

    Parameters
    ----------
    view_points, image
        The points and the image.
    T
        (4, 4) T_image_points.
    tolerance
        Of points that support the pose.
    differences
        (N,) written: log albedo of the image minus that of the point; NaN without support.
    log_cosine_ratios
        (N,) written for supporting points: log of the ratio of the cosines to the optical axes, in
        the points' own view over the image.

    Returns
    -------
    (AGREEMENT_SIZE,) counts, and the supporting points' sum of squared distances.
    """
    points, normals, sigma, log_albedo = view_points
    planes, plane_variance, albedo, nearest, lookup, lookup_frame = image
    sigmas, floor_m, floor_fraction, min_cosine = tolerance
    out = np.zeros(AGREEMENT_SIZE)
    rows, columns = planes.shape[0], planes.shape[1]
    for k in range(start, stop):
        differences[k] = np.nan
        px = np.float64(points[k, 0])
        py = np.float64(points[k, 1])
        pz = np.float64(points[k, 2])
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z <= _MIN_DEPTH:
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        i, j = projection_kernels.nearest_pixel(x / z, y / z, lookup, lookup_frame, rows, columns)
        if i < 0:
            continue
        out[PROJECTED] += 1
        if planes[i, j, 3] <= 0:
            limit = sigmas * np.float64(sigma[k]) + floor_m + floor_fraction * z
            if nearest[i, j] > 0 and z < nearest[i, j] - 2 * limit:
                out[VIOLATION] += 1
            continue
        out[COMPARED] += 1
        a = np.float64(planes[i, j, 0])
        b = np.float64(planes[i, j, 1])
        c = np.float64(planes[i, j, 2])
        length = np.sqrt(a * a + b * b + c * c)
        r = (a * x + b * y + c * z - 1.0) / length
        m0 = (T[0, 0] * a + T[1, 0] * b + T[2, 0] * c) / length
        m1 = (T[0, 1] * a + T[1, 1] * b + T[2, 1] * c) / length
        m2 = (T[0, 2] * a + T[1, 2] * b + T[2, 2] * c) / length
        dr_dz = (m0 * px + m1 * py + m2 * pz) / pz
        sigma_r = dr_dz * np.float64(sigma[k])
        variance = sigma_r * sigma_r + np.float64(plane_variance[i, j]) / (length * length)
        limit = sigmas * np.sqrt(variance) + floor_m + floor_fraction * z
        if r < -2 * limit:
            out[VIOLATION] += 1
        elif abs(r) < limit and (
            m0 * normals[k, 0] + m1 * normals[k, 1] + m2 * normals[k, 2] >= min_cosine
        ):
            out[SUPPORT] += 1
            out[SQUARES_M] += r * r
            differences[k] = albedo[i, j, 0] - log_albedo[k]
            source_slope2, image_slope2 = (px * px + py * py) / (pz * pz), (x * x + y * y) / (z * z)
            log_cosine_ratios[k] = 0.5 * np.log((1 + image_slope2) / (1 + source_slope2))
    return out


@kernel
def lowest_plane(
    points: Float64,
    normals: Float64,
    tolerance: Float64,
    candidates: Int64,
    min_cosine: float,
    max_below: float,
    below_factor: float,
) -> int:
    """Return the candidate whose plane has the most points on it, and few points below it.

    Parameters
    ----------
    points, normals
        (n, 3) m, unit.
    tolerance
        (n,) tolerance of a point's distance to a plane, m.
    candidates
        Indices of the points whose tangent planes are tried.
    min_cosine
        Smallest cosine between the normals of a plane and of a point on it.
    max_below
        Planes with more points below are rejected; if all are, the first candidate is returned.
    below_factor
        A point counts as below a plane at more than `below_factor` times its tolerance.
    """
    best = candidates[0]
    max_on_plane = 0
    for k in candidates:
        nx, ny, nz = normals[k]
        height = points[k, 0] * nx + points[k, 1] * ny + points[k, 2] * nz
        on_plane = 0
        below = 0
        for i in range(len(points)):
            r = points[i, 0] * nx + points[i, 1] * ny + points[i, 2] * nz - height
            if r > below_factor * tolerance[i]:
                below += 1
                if below > max_below:
                    break
            elif abs(r) < tolerance[i]:
                cosine = normals[i, 0] * nx + normals[i, 1] * ny + normals[i, 2] * nz
                on_plane += cosine > min_cosine
        if below <= max_below and on_plane > max_on_plane:
            max_on_plane = on_plane
            best = k
    return best
