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
from numpy.typing import NDArray

from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import landing

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

# Outcomes of a comparison.
NONE = 0  # no depth, or it projects to where the other view has none
AGREES = 1  # both views saw the same surface
IN_FRONT = 2  # in space that the other view saw through
BEHIND = 3  # behind what the other view saw
UNCLEAR = 4  # at an outline of either view, where a pixel more or less decides

_NEAREST = 0.02  # m; what comes nearer to the other camera is not compared
_EDGE_SIGMAS = 4.0  # depths of neighbours that differ by less are no outline


@kernel
def cell_depth(
    z: Float32, sigma: Float32, planes: Float32, plane_variance: Float32, i: int, j: int
) -> tuple[float, float]:
    """Depth in m of pixel (i, j) and its variance: of its plane, else as measured; 0 if unknown."""
    w = planes[i, j, 3]
    if w > 0:
        depth = 1.0 / w
        return depth, plane_variance[i, j] * depth * depth * depth * depth
    if z[i, j] > 0 and sigma[i, j] > 0:
        s = np.float64(sigma[i, j])
        return np.float64(z[i, j]), s * s
    return 0.0, 0.0


@kernel
def _depth_along(
    z: Float32,
    sigma: Float32,
    planes: Float32,
    plane_variance: Float32,
    i: int,
    j: int,
    x: float,
    y: float,
) -> tuple[float, float]:
    """As `cell_depth`, where the plane of the pixel meets the ray (x, y), which is within it."""
    w = planes[i, j, 3]
    if w > 0:
        along = planes[i, j, 0] * x + planes[i, j, 1] * y + planes[i, j, 2]
        # At a grazing angle half a pixel can be far along the plane.
        along = min(max(along, 0.9 * w), 1.1 * w)
        depth = 1.0 / along
        return depth, plane_variance[i, j] * depth * depth * depth * depth
    return cell_depth(z, sigma, planes, plane_variance, i, j)


@kernel
def _depth_range(z: Float32, i: int, j: int, radius: int) -> tuple[float, float, int]:
    """Least and largest valid depth in a window, and how many pixels of it are invalid."""
    low, high, missing = np.inf, 0.0, 0
    for a in range(max(i - radius, 0), min(i + radius + 1, z.shape[0])):
        for b in range(max(j - radius, 0), min(j + radius + 1, z.shape[1])):
            value = np.float64(z[a, b])
            if value > 0:
                low = min(low, value)
                high = max(high, value)
            else:
                missing += 1
    return low, high, missing


@kernel
def moved_point(
    T: Float64, x: float, y: float, depth: float
) -> tuple[float, float, float]:
    """Ray coordinates (x/z, y/z) and z, under T, of the point at `depth` on the ray (x, y)."""
    px, py = x * depth, y * depth
    z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * depth + T[2, 3]
    if not z > _NEAREST:
        return 0.0, 0.0, 0.0
    u = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * depth + T[0, 3]) / z
    v = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * depth + T[1, 3]) / z
    return u, v, z


@kernel
def pixel_at(
    x: float, y: float, lookup: Float32, lookup_frame: Float64, rows: int, columns: int
) -> tuple[int, int]:
    """Pixel (i, j) that the ray (x, y) falls on, (-1, -1) outside of the image."""
    u, v, node, _ = landing(x, y, lookup, lookup_frame)
    if node < 0 or not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
        return -1, -1
    return int(v + 0.5), int(u + 0.5)


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
    rows, columns = moving.shape
    out = np.empty(((rows + every - 1) // every) * ((columns + every - 1) // every), np.float32)
    n = 0
    for a in range(0, rows, every):
        for b in range(0, columns, every):
            i, j = a * stride, b * stride
            if moving[a, b]:
                continue
            depth, variance = cell_depth(z, sigma, planes, plane_variance, i, j)
            if not depth > 0:
                continue
            x, y, here = moved_point(T, rays[i, j, 0], rays[i, j, 1], depth)
            if here == 0:
                continue
            k, m = pixel_at(x, y, lookup, lookup_frame, other_z.shape[0], other_z.shape[1])
            if k < 0:
                continue
            there, other = _depth_along(
                other_z, other_sigma, other_planes, other_variance, k, m, x, y
            )
            if not there > 0:
                continue
            v = variance + other + model_error * model_error * there * there
            out[n] = abs(here - there) / np.sqrt(v)
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
        Of the view, as in `SurfaceMap`.
    stride, other_stride
        Pixels from one cell to the next.
    other_z, other_sigma, other_planes, other_variance, lookup, lookup_frame
        Of the other view.
    other_moving
        Cells of the other view that are known to move: what agrees with them is not static.
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
        Factor of the llr where a cell agrees with one that moves.
    outcome, llr
        (rows, columns) of cells, written: see above. Of what is behind the other view, llr is that
        of something that moved away from it.
    """
    rows, columns = other_z.shape
    model2, scale2 = model_error * model_error, scale * scale
    window = (2 * radius + 1) * (2 * radius + 1)
    for a in range(start, stop):
        for b in range(outcome.shape[1]):
            outcome[a, b], llr[a, b] = NONE, 0.0
            i, j = a * stride, b * stride
            depth, variance = cell_depth(z, sigma, planes, plane_variance, i, j)
            if not depth > 0:
                continue
            x, y, here = moved_point(T, rays[i, j, 0], rays[i, j, 1], depth)
            if here == 0:
                continue
            k, m = pixel_at(x, y, lookup, lookup_frame, rows, columns)
            if k < 0:
                continue
            there, other = _depth_along(
                other_z, other_sigma, other_planes, other_variance, k, m, x, y
            )
            if not there > 0:
                continue
            own = scale2 * variance
            v = own + scale2 * (other + model2 * there * there)
            gap = max(np.log(there * there / (2 * np.pi * v)), 0.0)
            d = here - there
            if d * d <= gap * v:
                value = max(0.5 * (d * d / v - gap), -max_agreement)
                if other_moving[k // other_stride, m // other_stride]:
                    value *= flagged_weight
                outcome[a, b], llr[a, b] = AGREES, value
                continue
            outcome[a, b] = UNCLEAR
            low, high, missing = _depth_range(other_z, k, m, radius)
            d = here - low if d < 0 else here - high
            if (d < 0) != (here < there) or not d * d > gap * v or 2 * missing > window:
                continue
            low, high, _ = _depth_range(z, i, j, 1)
            if high - low > max(edge_jump * depth, _EDGE_SIGMAS * np.sqrt(own)):
                continue
            outcome[a, b] = IN_FRONT if d < 0 else BEHIND
            llr[a, b] = min(0.5 * (d * d / v - gap), max_evidence)


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
    start: int,
    stop: int,
) -> None:
    """Look up, for the rows start..stop of the cells of a view, what was known of them before.

    Parameters
    ----------
    rays, z, sigma, planes, plane_variance, stride
        Of the view, as in `compare`.
    before, odds_before, tracked_before, stride_before
        Cells of the view before: depth in m (0 unknown), log-odds, and whether they are tracked.
    shape_before, lookup, lookup_frame
        Rows and columns of that view, and where points fall on it.
    T
        (4, 4) T_before_view.
    tolerance
        By which fraction of its depth a surface may have moved since.
    prior
        Log-odds of what was not seen before.
    depth_now, odds, tracked
        Cells of the view, written.
    """
    for a in range(start, stop):
        for b in range(odds.shape[1]):
            i, j = a * stride, b * stride
            odds[a, b], tracked[a, b] = prior, 0
            depth, variance = cell_depth(z, sigma, planes, plane_variance, i, j)
            depth_now[a, b] = depth
            if not depth > 0:
                continue
            x, y, here = moved_point(T, rays[i, j, 0], rays[i, j, 1], depth)
            if here == 0:
                continue
            k, m = pixel_at(x, y, lookup, lookup_frame, shape_before[0], shape_before[1])
            if k < 0:
                continue
            k, m = k // stride_before, m // stride_before
            there = np.float64(before[k, m])
            apart = max(tolerance * here, _EDGE_SIGMAS * np.sqrt(variance))
            if there > 0 and abs(here - there) <= apart:
                odds[a, b], tracked[a, b] = odds_before[k, m], tracked_before[k, m]


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
    for a in range(moving.shape[0]):
        for b in range(moving.shape[1]):
            i, j = a * stride, b * stride
            moving[a, b] = False
            depth = np.float64(z[i, j])
            if not depth > 0:
                continue
            x, y, here = moved_point(T, rays[i, j, 0], rays[i, j, 1], depth)
            if here == 0:
                continue
            k, m = pixel_at(x, y, lookup, lookup_frame, shape_before[0], shape_before[1])
            if k < 0:
                continue
            k, m = k // stride_before, m // stride_before
            for p in range(max(k - radius, 0), min(k + radius + 1, before.shape[0])):
                for q in range(max(m - radius, 0), min(m + radius + 1, before.shape[1])):
                    if moving_before[p, q] and abs(before[p, q] - here) <= tolerance * here:
                        moving[a, b] = True
