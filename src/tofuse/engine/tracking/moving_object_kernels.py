"""Per-pixel evidence of moving objects between two posed views, and its propagation over time.

Every `stride`-th pixel of a view (the cells) is projected into another view. Its depth z in that
view is compared with the depth z_t that the view measured: in a static scene they differ by the
noise of both, with variance v, while an object that moved in between may be anywhere on the ray up
to z_t. The logarithm of the ratio of the two likelihoods is

    llr = (d^2 / v - g) / 2,    g = log(z_t^2 / (2 pi v)),

where d is the depth difference z - z_t. It is negative where the views agree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, UInt8
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel

# Outcomes of a comparison.
NONE = 0  # no depth, or none in the other view at the projection
AGREES = 1  # both views see the same surface
IN_FRONT = 2  # in free space of the other view
BEHIND = 3  # occluded in the other view
AMBIGUOUS = 4  # within the registration error of a depth edge of either view

Rows = tuple[float, ...]

# Standard deviation of the errors of a depth besides its noise, as a fraction: the accuracy in data
# sheets of depth cameras.
_MODEL_ERROR = 0.005
# Neighbours are on a depth edge if their depths differ by more than this fraction, and than this
# multiple of their noise.
EDGE_JUMP, _EDGE_SIGMAS = 0.04, 4.0
# Maximum misregistration of views besides noise, in pixels of the prepared view: a point is in
# front of the other view's surface, or behind it, only if it is so for all pixels within it.
_MISREGISTRATION = 2
# Probability that a comparison of a static pixel is wrong for reasons other than noise. Limits the
# evidence of one frame.
_OUTLIERS = 0.05
MAX_EVIDENCE = -float(np.log(_OUTLIERS))
# Probability that a moving pixel agrees with the keyframe nevertheless: the object still overlaps
# itself. Limits the evidence of one frame that agrees; where the keyframe's surface is known to
# move, the evidence is reduced by this factor.
_SELF_OVERLAP = 0.3
_MAX_AGREEMENT = -float(np.log(_SELF_OVERLAP))
# Prior probability that a pixel moves, and its log-odds.
_PRIOR = 0.05
PRIOR_ODDS = float(np.log(_PRIOR / (1 - _PRIOR)))
# Fraction of its depth by which the surface at a pixel may move between frames.
MAX_MOTION = 0.05
# Dilation of a predicted mask, in cells of the previous view, and by a fraction of its depth.
_DILATION, _MAX_DISTANCE = 3, 2 * MAX_MOTION


class View(NamedTuple):
    """A view that is sampled at every `stride`-th pixel, its cells.

    Attributes
    ----------
    rays, z, sigma, planes, plane_variance
        As in `PreparedView`.
    lookup, lookup_frame
        Projection of the view's camera, as in `project_ray`.
    stride
        Pixels from one cell to the next.
    """

    rays: Float32
    z: Float32
    sigma: Float32
    planes: Float32
    plane_variance: Float32
    lookup: Float32
    lookup_frame: Float64
    stride: int


class Cells(NamedTuple):
    """State of the cells of a view: (rows, columns) each.

    Attributes
    ----------
    depth
        m, 0 unknown.
    odds
        Log-odds of motion.
    moving
        Whether a cell was segmented as moving.
    tracked
        1 where the surface once agreed with a reference, and has been propagated since then.
    """

    depth: Float32
    odds: Float32
    moving: Bool
    tracked: UInt8


# The following functions take scalars, as Numba counts references to each array that is passed. For
# the same reason, the kernels unpack named tuples before their loops.


@kernel
def cell_depth(w: float, plane_variance: float, z: float, sigma: float) -> tuple[float, float]:
    """Return depth (m) and variance of a pixel: of its plane (w = 1/z), else measured; else 0."""
    w, plane_variance = np.float64(w), np.float64(plane_variance)
    z, sigma = np.float64(z), np.float64(sigma)
    if w > 0:
        depth = 1.0 / w
        square = depth * depth
        return depth, plane_variance * square * square
    if z > 0 and sigma > 0:
        return z, sigma * sigma
    return 0.0, 0.0


@kernel
def _plane_inverse_depth(w: float, w_ray: float) -> float:
    """Return 1/z of a pixel's plane on a ray within the pixel, limited to within 10 % of `w`.

    `w` is 1/z at the pixel's centre; at grazing incidence it varies strongly within the pixel.
    """
    return min(max(w_ray, 0.9 * w), 1.1 * w) if w > 0 else w


@kernel
def rows_of(T: Float64) -> Rows:
    """Return the elements of the first three rows of T (4, 4)."""
    return (
        T[0, 0], T[0, 1], T[0, 2], T[0, 3],
        T[1, 0], T[1, 1], T[1, 2], T[1, 3],
        T[2, 0], T[2, 1], T[2, 2], T[2, 3],
    )  # fmt: skip


@kernel
def transform_point(motion: Rows, x: float, y: float, depth: float) -> tuple[float, float, float]:
    """Return (x/z, y/z, z) of the point at `depth` on the ray (x, y), transformed by `motion`.

    `motion` is that of `rows_of`. All are 0 if the point is too near to the camera.
    """
    r00, r01, r02, t0, r10, r11, r12, t1, r20, r21, r22, t2 = motion
    px, py = x * depth, y * depth
    z = r20 * px + r21 * py + r22 * depth + t2
    if not z > projection_kernels.MIN_DEPTH:
        return 0.0, 0.0, 0.0
    inv_z = 1.0 / z
    u = (r00 * px + r01 * py + r02 * depth + t0) * inv_z
    v = (r10 * px + r11 * py + r12 * depth + t1) * inv_z
    return u, v, z


@kernel
def _project_cell(
    depth: float,
    x_ray: float,
    y_ray: float,
    motion: Rows,
    lookup: Float32,
    lookup_frame: Float64,
    rows: int,
    columns: int,
) -> tuple[int, int, float, float, float]:
    """Return row and column of the pixel that a point is seen at, and its (x/z, y/z, z) there.

    The point is at `depth` on the ray (x_ray, y_ray). The row is -1 if it has no depth, is too near
    to the camera, or outside of the image of `rows` x `columns`.
    """
    if not depth > 0:
        return -1, -1, 0.0, 0.0, 0.0
    x, y, z = transform_point(motion, x_ray, y_ray, depth)
    if z == 0:
        return -1, -1, 0.0, 0.0, 0.0
    k, m = projection_kernels.nearest_pixel(x, y, lookup, lookup_frame, rows, columns)
    return k, m, x, y, z


@kernel
def residual_ratios(view: View, moving: Bool, step: int, other: View, T: Float64) -> Float32:
    """Return absolute depth differences divided by their sigma, (N,), where both views have depth.

    Parameters
    ----------
    moving
        (rows, columns) cells that are known to move; they are left out.
    step
        Every `step`-th cell is used, in both directions.

    The other parameters are those of `compare`.
    """
    rays, z, sigma, stride = view.rays, view.z, view.sigma, view.stride
    planes, plane_variance = view.planes, view.plane_variance
    other_z, other_sigma = other.z, other.sigma
    other_planes, other_variance = other.planes, other.plane_variance
    lookup, lookup_frame = other.lookup, other.lookup_frame
    motion = rows_of(T)
    rows, columns = moving.shape
    out = np.empty(((rows + step - 1) // step) * ((columns + step - 1) // step), np.float32)
    n = 0
    for a in range(0, rows, step):
        for b in range(0, columns, step):
            i, j = a * stride, b * stride
            if moving[a, b]:
                continue
            depth, variance = cell_depth(
                planes[i, j, 3], plane_variance[i, j], z[i, j], sigma[i, j]
            )
            k, m, x, y, z_proj = _project_cell(
                depth, np.float64(rays[i, j, 0]), np.float64(rays[i, j, 1]), motion,
                lookup, lookup_frame, other_z.shape[0], other_z.shape[1],
            )  # fmt: skip
            if k < 0:
                continue
            w_ray = other_planes[k, m, 0] * x + other_planes[k, m, 1] * y + other_planes[k, m, 2]
            z_obs, observed_variance = cell_depth(
                _plane_inverse_depth(np.float64(other_planes[k, m, 3]), w_ray),
                other_variance[k, m],
                other_z[k, m],
                other_sigma[k, m],
            )
            if not z_obs > 0:
                continue
            total = variance + observed_variance + _MODEL_ERROR * _MODEL_ERROR * z_obs * z_obs
            out[n] = abs(z_proj - z_obs) / np.sqrt(total)
            n += 1
    return out[:n]


@kernel
def compare(
    view: View,
    other: View,
    other_moving: Bool,
    T: Float64,
    scale: float,
    outcome: UInt8,
    llr: Float32,
    start: int,
    stop: int,
) -> None:
    """Compare the cells of a view, rows start..stop, with another view.

    Parameters
    ----------
    view, other
        The view, and the one it is compared with.
    other_moving
        Cells of the other view that are known to move; agreement with them is weak evidence.
    T
        (4, 4) T_other_view.
    scale
        Factor of the sigmas.
    outcome, llr
        (rows, columns) of cells, written: see above. For cells behind the other view's surface, llr
        is that of an object that has moved away in between.
    start, stop
        Rows of cells.
    """
    rays, z, sigma, stride = view.rays, view.z, view.sigma, view.stride
    planes, plane_variance = view.planes, view.plane_variance
    other_z, other_sigma = other.z, other.sigma
    other_planes, other_variance = other.planes, other.plane_variance
    lookup, lookup_frame, other_stride = other.lookup, other.lookup_frame, other.stride
    motion, radius = rows_of(T), _MISREGISTRATION
    rows, columns = other_z.shape
    model2, scale2 = _MODEL_ERROR * _MODEL_ERROR, scale * scale
    window = (2 * radius + 1) * (2 * radius + 1)
    for a in range(start, stop):
        for b in range(outcome.shape[1]):
            outcome[a, b], llr[a, b] = NONE, 0.0
            i, j = a * stride, b * stride
            depth, variance = cell_depth(
                planes[i, j, 3], plane_variance[i, j], z[i, j], sigma[i, j]
            )
            k, m, x, y, z_proj = _project_cell(
                depth, np.float64(rays[i, j, 0]), np.float64(rays[i, j, 1]), motion,
                lookup, lookup_frame, rows, columns,
            )  # fmt: skip
            if k < 0:
                continue
            w_ray = other_planes[k, m, 0] * x + other_planes[k, m, 1] * y + other_planes[k, m, 2]
            z_obs, observed_variance = cell_depth(
                _plane_inverse_depth(np.float64(other_planes[k, m, 3]), w_ray),
                other_variance[k, m],
                other_z[k, m],
                other_sigma[k, m],
            )
            if not z_obs > 0:
                continue
            scaled_variance = scale2 * variance
            total = scaled_variance + scale2 * (observed_variance + model2 * z_obs * z_obs)
            gate = max(np.log(z_obs * z_obs / (2 * np.pi * total)), 0.0)
            d = z_proj - z_obs
            if d * d <= gate * total:
                outcome[a, b] = AGREES
                llr[a, b] = max(0.5 * (d * d / total - gate), -_MAX_AGREEMENT)
                if other_moving[k // other_stride, m // other_stride]:
                    llr[a, b] *= _SELF_OVERLAP
                continue
            outcome[a, b] = AMBIGUOUS
            side = 1.0 if d > 0 else -1.0
            d, missing = np.inf, 0
            for p in range(max(k - radius, 0), min(k + radius + 1, rows)):
                for q in range(max(m - radius, 0), min(m + radius + 1, columns)):
                    if other_z[p, q] > 0:
                        d = min(d, side * (z_proj - np.float64(other_z[p, q])))
                    else:
                        missing += 1
            if not (d > 0 and d * d > gate * total) or 2 * missing > window:
                continue
            low, high = depth, depth
            for p in range(max(i - 1, 0), min(i + 2, z.shape[0])):
                for q in range(max(j - 1, 0), min(j + 2, z.shape[1])):
                    if z[p, q] > 0:
                        low = min(low, np.float64(z[p, q]))
                        high = max(high, np.float64(z[p, q]))
            if high - low > max(EDGE_JUMP * depth, _EDGE_SIGMAS * np.sqrt(scaled_variance)):
                continue
            outcome[a, b] = IN_FRONT if side < 0 else BEHIND
            llr[a, b] = min(0.5 * (d * d / total - gate), MAX_EVIDENCE)


@kernel
def propagate(
    view: View,
    prev: View,
    prev_cells: Cells,
    T: Float64,
    depths: Float32,
    odds: Float32,
    tracked: UInt8,
    in_free_space: Bool,
    start: int,
    stop: int,
) -> None:
    """Propagate the state of the previous view's cells to the cells of a view, rows start..stop.

    Parameters
    ----------
    view, prev, prev_cells
        The view, the previous view, and the cells of the latter.
    T
        (4, 4) T_prev_view.
    depths, odds, tracked, in_free_space
        (rows, columns) of cells, written. `in_free_space`: the cell lies in free space of the
        previous view.
    start, stop
        Rows of cells.
    """
    rays, z, sigma, stride = view.rays, view.z, view.sigma, view.stride
    planes, plane_variance = view.planes, view.plane_variance
    lookup, lookup_frame, prev_stride = prev.lookup, prev.lookup_frame, prev.stride
    prev_depth, prev_odds, prev_moving, prev_tracked = prev_cells
    prev_shape = prev.z.shape
    motion = rows_of(T)
    for a in range(start, stop):
        for b in range(odds.shape[1]):
            i, j = a * stride, b * stride
            odds[a, b], tracked[a, b], in_free_space[a, b] = PRIOR_ODDS, 0, False
            depth, variance = cell_depth(
                planes[i, j, 3], plane_variance[i, j], z[i, j], sigma[i, j]
            )
            depths[a, b] = depth
            k, m, _, _, z_proj = _project_cell(
                depth, np.float64(rays[i, j, 0]), np.float64(rays[i, j, 1]), motion,
                lookup, lookup_frame, prev_shape[0], prev_shape[1],
            )  # fmt: skip
            if k < 0:
                continue
            k, m = k // prev_stride, m // prev_stride
            z_prev = np.float64(prev_depth[k, m])
            max_difference = max(MAX_MOTION * z_proj, _EDGE_SIGMAS * np.sqrt(variance))
            if z_prev > 0 and abs(z_proj - z_prev) <= max_difference:
                odds[a, b], tracked[a, b] = prev_odds[k, m], prev_tracked[k, m]
            else:  # an object that moves with the camera stays at its place in the image
                k, m = _cell_on_ray(rays[i, j], prev_shape, prev_stride, lookup, lookup_frame)
                if (
                    k >= 0
                    and prev_moving[k, m]
                    and abs(prev_depth[k, m] - depth) <= MAX_MOTION * depth
                ):
                    odds[a, b] = prev_odds[k, m]
            in_free_space[a, b] = z_prev > z_proj + max_difference


@kernel
def predict(view: View, prev: View, prev_cells: Cells, T: Float64, moving: Bool) -> None:
    """Mark cells that are near, in image and depth, to moving cells of the previous view.

    Parameters
    ----------
    moving
        (rows, columns) of cells, written.

    The other parameters are those of `propagate`.
    """
    rays, z, stride = view.rays, view.z, view.stride
    lookup, lookup_frame, prev_stride = prev.lookup, prev.lookup_frame, prev.stride
    prev_depth, prev_moving, prev_shape = prev_cells.depth, prev_cells.moving, prev.z.shape
    motion = rows_of(T)
    for a in range(moving.shape[0]):
        for b in range(moving.shape[1]):
            i, j = a * stride, b * stride
            moving[a, b] = False
            depth = np.float64(z[i, j])
            k, m, _, _, z_proj = _project_cell(
                depth, np.float64(rays[i, j, 0]), np.float64(rays[i, j, 1]), motion,
                lookup, lookup_frame, prev_shape[0], prev_shape[1],
            )  # fmt: skip
            if k < 0:
                continue
            k, m = k // prev_stride, m // prev_stride
            moving[a, b] = _is_near_moving(k, m, z_proj, prev_depth, prev_moving)
            if not moving[a, b]:  # an object may move with the camera
                k, m = _cell_on_ray(rays[i, j], prev_shape, prev_stride, lookup, lookup_frame)
                moving[a, b] = k >= 0 and _is_near_moving(k, m, depth, prev_depth, prev_moving)


@kernel
def _cell_on_ray(
    ray: Float32, shape: tuple[int, int], stride: int, lookup: Float32, lookup_frame: Float64
) -> tuple[int, int]:
    """Return row and column of the cell that a ray projects to; -1 outside the image."""
    k, m = projection_kernels.nearest_pixel(
        np.float64(ray[0]), np.float64(ray[1]), lookup, lookup_frame, shape[0], shape[1]
    )
    return (k // stride, m // stride) if k >= 0 else (-1, -1)


@kernel
def _is_near_moving(k: int, m: int, depth: float, prev_depth: Float32, prev_moving: Bool) -> bool:
    """Whether a moving cell lies near cell (k, m), at a similar depth."""
    radius = _DILATION
    for p in range(max(k - radius, 0), min(k + radius + 1, prev_depth.shape[0])):
        for q in range(max(m - radius, 0), min(m + radius + 1, prev_depth.shape[1])):
            if prev_moving[p, q] and abs(prev_depth[p, q] - depth) <= _MAX_DISTANCE * depth:
                return True
    return False
