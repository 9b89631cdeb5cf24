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
def agreement_sums(
    points: Float64,
    pixels: Float64,
    target: Float64,
    normals: Float32,
    step: int,
    max_radius2: float,
) -> tuple[int, int, int, float]:
    """Compare points with the image that they project to.

    Parameters
    ----------
    points, pixels
        (N, 3) in the frame of the target's camera, m, and (N, 2) the pixels that they project to,
        NaN outside.
    target, normals
        (H, W, 3) points of the target, z = 0 where invalid; its normals, 0 where unknown.
    step
        Pixels of the camera from one of the target's to the next.
    max_radius2
        Largest x^2 + y^2 at z = 1 of points in view: beyond, distortion may fold the image.

    Returns
    -------
    Numbers of overlapping points, of points that project to a pixel with a normal, and of inliers
    among these; and the sum of the inliers' squared distances from the plane, m^2.
    """
    height, width = target.shape[:2]
    overlapping, plane_points, inliers, squares = 0, 0, 0, 0.0
    for k in range(len(points)):
        # Ties go to even numbers, as in NumPy.
        u, v = np.rint(pixels[k, 0] / step), np.rint(pixels[k, 1] / step)
        x, y, z = points[k]
        if not (z > 0.05 and u >= 0 and v >= 0 and u < width and v < height):
            continue
        if x * x + y * y > max_radius2 * z * z:
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
