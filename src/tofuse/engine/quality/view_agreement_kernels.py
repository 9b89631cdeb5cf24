"""Agreement of one range image with another under a relative pose."""

from __future__ import annotations

import math

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.compute import kernel

# Maximum difference in z of points on the same surface, and distance of those with a residual, m.
_SAME_SURFACE, _INLIER_DISTANCE = 0.25, 0.10


@kernel
def transform_points(points: Float64, T: Float64, out: Float64) -> None:
    """Write the points (N, 3) transformed by T (4, 4); invalid ones (z = 0) become the origin."""
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if z == 0:
            out[k] = 0
            continue
        for r in range(3):
            out[k, r] = T[r, 0] * x + T[r, 1] * y + T[r, 2] * z + T[r, 3]


@kernel
def project_by_lens(points: Float64, lens: Float64, out: Float64) -> None:
    """Write the pixels (N, 2) that points (N, 3) in the camera frame project to; NaN if z <= 0.

    Parameters
    ----------
    lens
        0 fx, 1 fy, 2 cx, 3 cy, 4 k1, 5 k2, 6 p1, 7 p2, 8 k3, 9 k4, 10 k5, 11 k6, 12 model (0
        pinhole; 1 rational, with the order of distortion of OpenCV; 2 fisheye, k1 to k4 in 4, 5,
        8, 9), 13 the largest x^2 + y^2 at z = 1 for which the distortion model is valid.
    """
    for k in range(len(points)):
        z = points[k, 2]
        out[k, 0] = np.nan
        out[k, 1] = np.nan
        if not z > 0:
            continue
        if lens[12] == 0:
            # Multiply before dividing, as in the definition.
            out[k, 0] = lens[0] * points[k, 0] / z + lens[2]
            out[k, 1] = lens[1] * points[k, 1] / z + lens[3]
            continue
        x, y = points[k, 0] / z, points[k, 1] / z
        r2 = x * x + y * y
        if r2 > lens[13]:
            continue
        if lens[12] == 1:
            numerator = 1 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
            denominator = 1 + r2 * (lens[9] + r2 * (lens[10] + r2 * lens[11]))
            scale = numerator / denominator
            u = x * scale + 2 * lens[6] * x * y + lens[7] * (r2 + 2 * x * x)
            v = y * scale + lens[6] * (r2 + 2 * y * y) + 2 * lens[7] * x * y
        else:
            r = math.sqrt(r2)
            theta = math.atan(r)
            t2 = theta * theta
            theta_d = theta * (1 + t2 * (lens[4] + t2 * (lens[5] + t2 * (lens[8] + t2 * lens[9]))))
            scale = theta_d / r if r > 1e-9 else 1.0
            u, v = x * scale, y * scale
        out[k, 0] = lens[0] * u + lens[2]
        out[k, 1] = lens[1] * v + lens[3]


@kernel
def agreement_sums(
    points: Float64, pixels: Float64, target: Float64, normals: Float32
) -> tuple[int, int, int, float]:
    """Compare points with the image that they project to.

    Parameters
    ----------
    points, pixels
        (N, 3) in the frame of the target's camera, m, and (N, 2) their projections, NaN outside.
    target, normals
        (H, W, 3) points of the target, z = 0 where invalid; its normals, 0 where unknown.

    Returns
    -------
    Numbers of overlapping points, of points that project to a pixel with a normal, and of inliers
    among these; and the sum of the inliers' squared distances from the plane, m^2.
    """
    height, width = target.shape[:2]
    overlapping, plane_points, inliers, squares = 0, 0, 0, 0.0
    for k in range(len(points)):
        # Ties go to even numbers, as in NumPy.
        u, v = np.rint(pixels[k, 0]), np.rint(pixels[k, 1])
        if not (points[k, 2] > 0.05 and u >= 0 and v >= 0 and u < width and v < height):
            continue
        j, i = int(u), int(v)
        if not target[i, j, 2] > 0:
            continue
        dz = points[k, 2] - target[i, j, 2]
        if abs(dz) < _SAME_SURFACE:
            overlapping += 1
        nx, ny, nz = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
        if nx == 0 and ny == 0 and nz == 0:
            continue
        plane_points += 1
        dx, dy = points[k, 0] - target[i, j, 0], points[k, 1] - target[i, j, 1]
        if math.sqrt(dx * dx + dy * dy + dz * dz) <= _INLIER_DISTANCE:
            inliers += 1
            r = nx * dx + ny * dy + nz * dz
            squares += r * r
    return overlapping, plane_points, inliers, squares
