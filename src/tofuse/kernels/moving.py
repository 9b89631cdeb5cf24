"""Per-pixel evidence of motion between two posed views, and where evidence goes with the camera.

Every `stride`-th pixel of a view (the cells) is projected into another view. Along the ray it falls
on, its depth z is compared with that of the other view, z_t: a static scene makes them differ by
the noise of both, with variance v, while something that moved in between may be anywhere on the ray
up to z_t. The logarithm of the ratio of the two likelihoods is

    llr = (d^2 / v - g) / 2,    g = log(z_t^2 / (2 pi v)),

where d is the difference of depth. It is negative where the views agree.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Bool, Float32, Float64, UInt8
from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import landing

# Outcomes of a comparison.
NONE = 0  # no depth, or it projects to where the other view has none
AGREES = 1  # both views saw the same surface
IN_FRONT = 2  # in space that the other view saw through
BEHIND = 3  # behind what the other view saw
UNCLEAR = 4  # at an outline of either view, where a pixel more or less decides

_NEAREST = 0.02  # m; what comes nearer to the other camera is not compared
_EDGE_SIGMAS = 4.0  # depths of neighbours that differ by less are no outline


# What follows takes numbers, not arrays: Numba counts references to each array handed over.


@kernel
def cell_depth(w: float, plane_variance: float, z: float, sigma: float) -> tuple[float, float]:
    """Depth in m of a pixel and its variance: of its plane (w = 1/z), else as measured; or 0."""
    if w > 0:
        depth = 1.0 / w
        square = depth * depth
        return depth, plane_variance * square * square
    if z > 0 and sigma > 0:
        return z, sigma * sigma
    return 0.0, 0.0


@kernel
def _along(w: float, on_ray: float) -> float:
    """1/z of a pixel's plane on a ray that is within the pixel, where it is w at its centre.

    At a grazing angle half a pixel can be far along the plane, which is limited.
    """
    return min(max(on_ray, 0.9 * w), 1.1 * w) if w > 0 else w


@kernel
def moved_point(
    r00: float, r01: float, r02: float, t0: float,
    r10: float, r11: float, r12: float, t1: float,
    r20: float, r21: float, r22: float, t2: float,
    x: float, y: float, depth: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Ray coordinates (x/z, y/z) and z of the point at `depth` on the ray (x, y), moved by (r, t).

    All 0 where it comes too near to the camera.
    """
    px, py = x * depth, y * depth
    z = r20 * px + r21 * py + r22 * depth + t2
    if not z > _NEAREST:
        return 0.0, 0.0, 0.0
    per_z = 1.0 / z
    u = (r00 * px + r01 * py + r02 * depth + t0) * per_z
    v = (r10 * px + r11 * py + r12 * depth + t1) * per_z
    return u, v, z


@kernel
def inside(u: float, v: float, node: int, rows: int, columns: int) -> bool:
    """Whether what `landing` returned is a pixel of an image."""
    return node >= 0 and u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5


@kernel
def residual_ratios(
    rays: Float32,
    z: Float32,
    sigma: Float32,
    planes: Float32,
    plane_variance: Float32,
    moving: Bool,
    stride: int,
    every: int,
    other_z: Float32,
    other_sigma: Float32,
    other_planes: Float32,
    other_variance: Float32,
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    model_error: float,
) -> Float32:
    """Absolute differences of depth over their sigma, (N,), where both views know a depth.

    Takes every `every`-th cell in both directions that is not known to move (`moving`, one per
    cell); the other parameters are those of `compare`.
    """
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    rows, columns = moving.shape
    out = np.empty(((rows + every - 1) // every) * ((columns + every - 1) // every), np.float32)
    n = 0
    for a in range(0, rows, every):
        for b in range(0, columns, every):
            i, j = a * stride, b * stride
            if moving[a, b]:
                continue
            depth, variance = cell_depth(
                np.float64(planes[i, j, 3]),
                np.float64(plane_variance[i, j]),
                np.float64(z[i, j]),
                np.float64(sigma[i, j]),
            )
            if not depth > 0:
                continue
            x, y, here = moved_point(
                r00,
                r01,
                r02,
                t0,
                r10,
                r11,
                r12,
                t1,
                r20,
                r21,
                r22,
                t2,
                np.float64(rays[i, j, 0]),
                np.float64(rays[i, j, 1]),
                depth,
            )
            if here == 0:
                continue
            u, v, node, _ = landing(x, y, lookup, lookup_frame)
            if not inside(u, v, node, other_z.shape[0], other_z.shape[1]):
                continue
            k, m = int(v + 0.5), int(u + 0.5)
            on_ray = other_planes[k, m, 0] * x + other_planes[k, m, 1] * y + other_planes[k, m, 2]
            there, other = cell_depth(
                _along(np.float64(other_planes[k, m, 3]), on_ray),
                np.float64(other_variance[k, m]),
                np.float64(other_z[k, m]),
                np.float64(other_sigma[k, m]),
            )
            if not there > 0:
                continue
            total = variance + other + model_error * model_error * there * there
            out[n] = abs(here - there) / np.sqrt(total)
            n += 1
    return out[:n]


@kernel
def compare(
    rays: Float32,
    z: Float32,
    sigma: Float32,
    planes: Float32,
    plane_variance: Float32,
    stride: int,
    other_z: Float32,
    other_sigma: Float32,
    other_planes: Float32,
    other_variance: Float32,
    other_moving: Bool,
    other_stride: int,
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    scale: float,
    model_error: float,
    edge_jump: float,
    radius: int,
    max_evidence: float,
    max_agreement: float,
    flagged_weight: float,
    outcome: UInt8,
    llr: Float32,
    start: int,
    stop: int,
) -> None:
    """Compare the rows start..stop of the cells of a view with another view.

    Parameters
    ----------
    rays, z, sigma, planes, plane_variance
        Of the view, as in `PreparedView`.
    stride, other_stride
        Pixels from one cell to the next.
    other_z, other_sigma, other_planes, other_variance, lookup, lookup_frame
        Of the other view.
    other_moving
        Cells of the other view that are known to move: that a cell agrees with one of them says
        little.
    T
        (4, 4) T_other_view.
    scale
        By which sigmas are multiplied.
    model_error
        Sigma of errors that noise does not show, as a fraction of the depth.
    edge_jump
        Depths that differ by more than this fraction are an outline.
    radius
        Pixels by which the other view may be misregistered: a point counts as in front of it, or
        behind it, only if it is so for all pixels within.
    max_evidence, max_agreement
        Largest llr, and largest -llr.
    flagged_weight
        Factor of the llr of a cell that agrees with one that moves.
    outcome, llr
        (rows, columns) of cells, written: see above. Of what is behind the other view, llr is that
        of something that moved away from it.
    """
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    rows, columns = other_z.shape
    model2, scale2 = model_error * model_error, scale * scale
    window = (2 * radius + 1) * (2 * radius + 1)
    for a in range(start, stop):
        for b in range(outcome.shape[1]):
            outcome[a, b], llr[a, b] = NONE, 0.0
            i, j = a * stride, b * stride
            depth, variance = cell_depth(
                np.float64(planes[i, j, 3]),
                np.float64(plane_variance[i, j]),
                np.float64(z[i, j]),
                np.float64(sigma[i, j]),
            )
            if not depth > 0:
                continue
            x, y, here = moved_point(
                r00,
                r01,
                r02,
                t0,
                r10,
                r11,
                r12,
                t1,
                r20,
                r21,
                r22,
                t2,
                np.float64(rays[i, j, 0]),
                np.float64(rays[i, j, 1]),
                depth,
            )
            if here == 0:
                continue
            u, v, node, _ = landing(x, y, lookup, lookup_frame)
            if not inside(u, v, node, rows, columns):
                continue
            k, m = int(v + 0.5), int(u + 0.5)
            on_ray = other_planes[k, m, 0] * x + other_planes[k, m, 1] * y + other_planes[k, m, 2]
            there, other = cell_depth(
                _along(np.float64(other_planes[k, m, 3]), on_ray),
                np.float64(other_variance[k, m]),
                np.float64(other_z[k, m]),
                np.float64(other_sigma[k, m]),
            )
            if not there > 0:
                continue
            own = scale2 * variance
            total = own + scale2 * (other + model2 * there * there)
            gap = max(np.log(there * there / (2 * np.pi * total)), 0.0)
            d = here - there
            if d * d <= gap * total:
                outcome[a, b] = AGREES
                llr[a, b] = max(0.5 * (d * d / total - gap), -max_agreement)
                if other_moving[k // other_stride, m // other_stride]:
                    llr[a, b] *= flagged_weight
                continue
            outcome[a, b] = UNCLEAR
            low, high, missing = np.inf, 0.0, 0
            for p in range(max(k - radius, 0), min(k + radius + 1, rows)):
                for q in range(max(m - radius, 0), min(m + radius + 1, columns)):
                    if other_z[p, q] > 0:
                        low = min(low, np.float64(other_z[p, q]))
                        high = max(high, np.float64(other_z[p, q]))
                    else:
                        missing += 1
            d = here - low if d < 0 else here - high
            if (d < 0) != (here < there) or not d * d > gap * total or 2 * missing > window:
                continue
            low, high = depth, depth
            for p in range(max(i - 1, 0), min(i + 2, z.shape[0])):
                for q in range(max(j - 1, 0), min(j + 2, z.shape[1])):
                    if z[p, q] > 0:
                        low = min(low, np.float64(z[p, q]))
                        high = max(high, np.float64(z[p, q]))
            if high - low > max(edge_jump * depth, _EDGE_SIGMAS * np.sqrt(own)):
                continue
            outcome[a, b] = IN_FRONT if d < 0 else BEHIND
            llr[a, b] = min(0.5 * (d * d / total - gap), max_evidence)


@kernel
def carry(
    rays: Float32,
    z: Float32,
    sigma: Float32,
    planes: Float32,
    plane_variance: Float32,
    stride: int,
    before: Float32,
    odds_before: Float32,
    moving_before: Bool,
    tracked_before: UInt8,
    stride_before: int,
    shape_before: tuple[int, int],
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    tolerance: float,
    prior: float,
    depth_now: Float32,
    odds: Float32,
    tracked: UInt8,
    arrived: Bool,
    start: int,
    stop: int,
) -> None:
    """Look up, for the rows start..stop of the cells of a view, what was known of them before.

    Parameters
    ----------
    rays, z, sigma, planes, plane_variance, stride
        Of the view, as in `compare`.
    before, odds_before, moving_before, tracked_before, stride_before
        Cells of the view before: depth in m (0 unknown), log-odds, whether they were segmented, and
        whether they are tracked.
    shape_before, lookup, lookup_frame
        Rows and columns of that view, and where points fall on it.
    T
        (4, 4) T_before_view.
    tolerance
        By which fraction of its depth a surface may have moved since.
    prior
        Log-odds of what was not seen before.
    depth_now, odds, tracked, arrived
        Cells of the view, written. `arrived` is whether the view before saw through there.
    """
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for a in range(start, stop):
        for b in range(odds.shape[1]):
            i, j = a * stride, b * stride
            odds[a, b], tracked[a, b], arrived[a, b] = prior, 0, False
            depth, variance = cell_depth(
                np.float64(planes[i, j, 3]),
                np.float64(plane_variance[i, j]),
                np.float64(z[i, j]),
                np.float64(sigma[i, j]),
            )
            depth_now[a, b] = depth
            if not depth > 0:
                continue
            x, y, here = moved_point(
                r00,
                r01,
                r02,
                t0,
                r10,
                r11,
                r12,
                t1,
                r20,
                r21,
                r22,
                t2,
                np.float64(rays[i, j, 0]),
                np.float64(rays[i, j, 1]),
                depth,
            )
            if here == 0:
                continue
            u, v, node, _ = landing(x, y, lookup, lookup_frame)
            if not inside(u, v, node, shape_before[0], shape_before[1]):
                continue
            k, m = int(v + 0.5), int(u + 0.5)
            k, m = k // stride_before, m // stride_before
            there = np.float64(before[k, m])
            apart = max(tolerance * here, _EDGE_SIGMAS * np.sqrt(variance))
            if there > 0 and abs(here - there) <= apart:
                odds[a, b], tracked[a, b] = odds_before[k, m], tracked_before[k, m]
            else:  # what moves may move with the camera, and be where it was in the image
                k, m = _cell_on_ray(rays[i, j], shape_before, stride_before, lookup, lookup_frame)
                if (
                    k >= 0
                    and moving_before[k, m]
                    and abs(before[k, m] - depth) <= tolerance * depth
                ):
                    odds[a, b] = odds_before[k, m]
            arrived[a, b] = there > here + apart


@kernel
def predict(
    rays: Float32,
    z: Float32,
    stride: int,
    before: Float32,
    moving_before: Bool,
    stride_before: int,
    shape_before: tuple[int, int],
    lookup: Float32,
    lookup_frame: Float64,
    T: Float64,
    tolerance: float,
    radius: int,
    moving: Bool,
) -> None:
    """Mark cells of a view that are near, in the image and in depth, to what moved before.

    `moving` (one per cell of the view) is written, `moving_before` says which cells of the view
    before moved, `radius` is in its cells. The others are those of `carry`.
    """
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for a in range(moving.shape[0]):
        for b in range(moving.shape[1]):
            i, j = a * stride, b * stride
            moving[a, b] = False
            depth = np.float64(z[i, j])
            if not depth > 0:
                continue
            x, y, here = moved_point(
                r00,
                r01,
                r02,
                t0,
                r10,
                r11,
                r12,
                t1,
                r20,
                r21,
                r22,
                t2,
                np.float64(rays[i, j, 0]),
                np.float64(rays[i, j, 1]),
                depth,
            )
            if here == 0:
                continue
            u, v, node, _ = landing(x, y, lookup, lookup_frame)
            if not inside(u, v, node, shape_before[0], shape_before[1]):
                continue
            k, m = int(v + 0.5), int(u + 0.5)
            k, m = k // stride_before, m // stride_before
            moving[a, b] = _moved_near(k, m, here, before, moving_before, tolerance, radius)
            if not moving[a, b]:  # it may move with the camera
                k, m = _cell_on_ray(rays[i, j], shape_before, stride_before, lookup, lookup_frame)
                moving[a, b] = k >= 0 and _moved_near(
                    k, m, depth, before, moving_before, tolerance, radius
                )


@kernel
def _cell_on_ray(
    ray: Float32,
    shape: tuple[int, int],
    stride: int,
    lookup: Float32,
    lookup_frame: Float64,
) -> tuple[int, int]:
    """Cell of a view on one of its rays; -1 where it has none."""
    u, v, node, _ = landing(np.float64(ray[0]), np.float64(ray[1]), lookup, lookup_frame)
    if not inside(u, v, node, shape[0], shape[1]):
        return -1, -1
    return int(v + 0.5) // stride, int(u + 0.5) // stride


@kernel
def _moved_near(
    k: int,
    m: int,
    depth: float,
    before: Float32,
    moving_before: Bool,
    tolerance: float,
    radius: int,
) -> bool:
    """Whether a moving cell is within the radius of cell (k, m), and at about the depth."""
    for p in range(max(k - radius, 0), min(k + radius + 1, before.shape[0])):
        for q in range(max(m - radius, 0), min(m + radius + 1, before.shape[1])):
            if moving_before[p, q] and abs(before[p, q] - depth) <= tolerance * depth:
                return True
    return False
