"""Projection of a point into a view, and the Jacobian of a point under a perturbation.

And the lenses of `cameras`; and the radial distortion by the coefficients of `lens.fitted`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.compute import inlined, kernel

MIN_DEPTH = 0.02  # m; points nearer to a camera are not projected
# Smallest slope of a lens's distortion, and Newton iterations that invert it.
MIN_SLOPE, _ITERATIONS = 0.1, 3


class Lens(NamedTuple):
    """The lens of a camera, in pixels.

    Attributes
    ----------
    fx, fy, cx, cy
        Of a pinhole camera.
    k1, k2, p1, p2, k3, k4, k5, k6
        Distortion in the order of OpenCV; 0 where the model has none.
    angular
        Whether k1 to k4 are of the angle to the axis (fisheye), not of its tangent.
    tangential
        How often the mixed tangential terms count: twice in OpenCV.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    k4: float
    k5: float
    k6: float
    angular: bool
    tangential: float


@kernel
def _distorted(x: float, y: float, lens: Lens) -> tuple[float, float]:
    r2 = x * x + y * y
    if lens.angular:
        r = np.sqrt(r2)
        theta = np.arctan(r)
        t2 = theta * theta
        theta *= 1 + t2 * (lens.k1 + t2 * (lens.k2 + t2 * (lens.k3 + t2 * lens.k4)))
        scale = theta / r if r > 1e-9 else 1.0
        return x * scale, y * scale
    above = 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    scale = above / (1 + r2 * (lens.k4 + r2 * (lens.k5 + r2 * lens.k6)))
    mixed_u, mixed_v = lens.tangential * lens.p1 * x * y, lens.tangential * lens.p2 * x * y
    u = x * scale + (mixed_u + lens.p2 * (r2 + 2 * x * x))
    return u, y * scale + (lens.p1 * (r2 + 2 * y * y) + mixed_v)


@kernel
def distort(rays: Float64, lens: Lens) -> Float64:
    """Return rays (N, 2) as distorted by the lens."""
    out = np.empty_like(rays)
    for k in range(len(rays)):
        out[k, 0], out[k, 1] = _distorted(rays[k, 0], rays[k, 1], lens)
    return out


@kernel
def project_by_lens(points: Float64, lens: Lens) -> Float64:
    """Return the pixels (N, 2) of points (N, 3) in the camera's frame; NaN if z <= 0."""
    out = np.full((len(points), 2), np.nan)
    for k in range(len(points)):
        z = points[k, 2]
        if z > 0:
            u, v = _distorted(points[k, 0] / z, points[k, 1] / z, lens)
            out[k, 0], out[k, 1] = u * lens.fx + lens.cx, v * lens.fy + lens.cy
    return out


@kernel
def project_ray(
    x: float, y: float, lookup: Float32, lookup_frame: Float64
) -> tuple[float, float, int, int]:
    """Return the pixel (u, v) of a ray, interpolated in a lookup table, and its lookup cell.

    Parameters
    ----------
    x, y
        Ray coordinates x/z and y/z.
    lookup
        (A, B, 2) pixel (u, v) of each node of a regular grid over ray coordinates.
    lookup_frame
        (4,) origin and inverse spacing of the grid: x0, y0, 1/dx, 1/dy.

    Returns
    -------
    u, v, and column and row of the lookup cell: -1 for rays outside the grid.
    """
    fu = (x - lookup_frame[0]) * lookup_frame[2]
    fv = (y - lookup_frame[1]) * lookup_frame[3]
    if not (fu >= 0 and fv >= 0 and fu < lookup.shape[1] - 1 and fv < lookup.shape[0] - 1):
        return 0.0, 0.0, -1, -1
    i = int(fu)
    j = int(fv)
    au = fu - i
    av = fv - j
    u = (1 - av) * ((1 - au) * lookup[j, i, 0] + au * lookup[j, i + 1, 0]) + av * (
        (1 - au) * lookup[j + 1, i, 0] + au * lookup[j + 1, i + 1, 0]
    )
    v = (1 - av) * ((1 - au) * lookup[j, i, 1] + au * lookup[j, i + 1, 1]) + av * (
        (1 - au) * lookup[j + 1, i, 1] + au * lookup[j + 1, i + 1, 1]
    )
    return u, v, i, j


@kernel
def in_image(u: float, v: float, cell: int, rows: int, columns: int) -> bool:
    """Whether the result of `project_ray` lies in an image of `rows` x `columns`."""
    return cell >= 0 and u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5


@kernel
def nearest_pixel(
    x: float, y: float, lookup: Float32, lookup_frame: Float64, rows: int, columns: int
) -> tuple[int, int]:
    """Return row and column of the pixel that a ray is nearest to; -1 outside the image."""
    u, v, cell, _ = project_ray(x, y, lookup, lookup_frame)
    if not in_image(u, v, cell, rows, columns):
        return -1, -1
    return int(v + 0.5), int(u + 0.5)


@kernel
def project_rays(
    x: Float32, y: Float32, lookup: Float32, lookup_frame: Float64, u: Float64, v: Float64
) -> None:
    """Project N rays like `project_ray`, in branch-free loops, so that they are vectorised.

    Parameters
    ----------
    x, y
        (N,) ray coordinates.
    lookup, lookup_frame
        As for `project_ray`.
    u, v
        (N,), are overwritten by the pixels, NaN for rays outside the grid.
    """
    table = lookup.reshape(-1)
    cell = np.empty(len(x), np.int32)
    last_u, last_v = np.float64(lookup.shape[1] - 1), np.float64(lookup.shape[0] - 1)
    row = np.int32(2 * lookup.shape[1])
    for k in range(len(x)):
        fu = (np.float64(x[k]) - lookup_frame[0]) * lookup_frame[2]
        fv = (np.float64(y[k]) - lookup_frame[1]) * lookup_frame[3]
        inside = (fu >= 0) & (fv >= 0) & (fu < last_u) & (fv < last_v)
        fu = fu if inside else 0.0
        fv = fv if inside else 0.0
        i, j = np.int32(fu), np.int32(fv)
        cell[k] = j * row + 2 * i
        u[k] = fu - i if inside else np.nan
        v[k] = fv - j
    for k in range(len(x)):
        a = np.uint64(cell[k])
        b = a + np.uint64(row)
        au, av = u[k], v[k]
        u[k] = (1 - av) * ((1 - au) * table[a] + au * table[a + np.uint64(2)]) + av * (
            (1 - au) * table[b] + au * table[b + np.uint64(2)]
        )
        a, b = a + np.uint64(1), b + np.uint64(1)
        v[k] = (1 - av) * ((1 - au) * table[a] + au * table[a + np.uint64(2)]) + av * (
            (1 - au) * table[b] + au * table[b + np.uint64(2)]
        )


@kernel
def jacobian_row(
    J: Float64, m0: float, m1: float, m2: float, px: float, py: float, pz: float
) -> None:
    """Write (m, p x m), the derivative of m . p under a right perturbation, to J[:6]."""
    J[0] = m0
    J[1] = m1
    J[2] = m2
    J[3] = py * m2 - pz * m1
    J[4] = pz * m0 - px * m2
    J[5] = px * m1 - py * m0


@kernel
def distortion(r2: np.float32, lens: Float32) -> np.float32:
    """Return the factor by which the lens moves a ray at the squared distance r2 from the axis.

    Beyond the image it stays as it is there.
    """
    one, s = np.float32(1), min(r2, lens[4])
    return (one + s * (lens[0] + s * (lens[1] + s * (lens[2] + s * lens[3])))) / (one + s)


@kernel
def bend(r2: np.float32, lens: Float32) -> np.float32:
    """Return b: if a ray x (2,) is distorted by the factor f, moving that by d moves x by

    ``(d - b x (x . d)) / f``, the inverse of the slope ``f + f' x x^T`` of the distortion.
    """
    one, two, three, four = np.float32(1), np.float32(2), np.float32(3), np.float32(4)
    above = lens[0] + r2 * (two * lens[1] + r2 * (three * lens[2] + r2 * four * lens[3]))
    factor = distortion(r2, lens)
    slope = two * (above - factor) / (one + r2) if r2 < lens[4] else np.float32(0)
    return slope / max(factor + slope * r2, np.float32(MIN_SLOPE))


@inlined
def undistorted(
    x: np.float32, y: np.float32, near_x: np.float32, near_y: np.float32, lens: Float32
) -> tuple[np.float32, np.float32]:
    """Return the ray of the distorted one (x, y), by Newton's method from a ray near it."""
    near_x, near_y = _nearer(x, y, near_x, near_y, lens)
    near_x, near_y = _nearer(x, y, near_x, near_y, lens)
    return _nearer(x, y, near_x, near_y, lens)


@kernel
def _nearer(
    x: np.float32, y: np.float32, near_x: np.float32, near_y: np.float32, lens: Float32
) -> tuple[np.float32, np.float32]:
    """One iteration."""
    r2 = near_x * near_x + near_y * near_y
    factor, b = distortion(r2, lens), bend(r2, lens)
    dx, dy = x - near_x * factor, y - near_y * factor
    along = b * (near_x * dx + near_y * dy)
    return near_x + (dx - along * near_x) / factor, near_y + (dy - along * near_y) / factor


@kernel
def move_rays(rays: Float32, lens: Float32, scale: float, center: Float64, out: Float32) -> None:
    """Write what pixels see whose distorted rays are scaled, and moved by a center (2,).

    `rays` and `out` are (H, W, 2) x/z and y/z, NaN where unknown.
    """
    scale32, x0, y0 = np.float32(scale), np.float32(center[0]), np.float32(center[1])
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            x, y = rays[i, j, 0], rays[i, j, 1]
            factor = scale32 * distortion(x * x + y * y, lens)
            out[i, j] = undistorted(factor * x + x0, factor * y + y0, x, y, lens)
