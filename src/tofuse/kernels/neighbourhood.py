"""Neighbourhood operations of the spatial filters, row by row."""

from __future__ import annotations

import math

import numpy as np

from tofuse.arrays import Bool, Float32
from tofuse.kernels.jit import kernel


@kernel
def window_median(z: Float32, half: int, start: int, stop: int, out: Float32) -> None:
    """Write the median of the positive values in the window around each pixel; 0 if there is none.

    Parameters
    ----------
    z
        (H, W) values; 0 is invalid.
    half
        Half width of the window in pixels; it is clipped at the border.
    start, stop
        Rows of `out` (H, W) to write.
    """
    height, width = z.shape
    values = np.empty((2 * half + 1) ** 2, np.float32)
    for i in range(start, stop):
        for j in range(width):
            n = 0
            for v in range(max(0, i - half), min(height, i + half + 1)):
                for u in range(max(0, j - half), min(width, j + half + 1)):
                    value = z[v, u]
                    if value > 0:
                        # Insertion sort.
                        k = n
                        while k > 0 and values[k - 1] > value:
                            values[k] = values[k - 1]
                            k -= 1
                        values[k] = value
                        n += 1
            if n == 0:
                out[i, j] = 0
            elif n % 2 == 1:
                out[i, j] = values[n // 2]
            else:
                out[i, j] = np.float32(0.5) * (values[n // 2 - 1] + values[n // 2])


@kernel
def largest_angle(
    points: Float32,
    valid: Bool,
    start: int,
    stop: int,
    out: Float32,
) -> None:
    """Write the largest angle at each point between the camera and any of its 8 neighbours.

    Parameters
    ----------
    points
        (H, W, 3), the camera at the origin.
    valid
        (H, W).
    start, stop
        Rows of `out` (H, W) to write: radians, 0 where the point or all neighbours are invalid.
    """
    height, width = valid.shape
    for i in range(start, stop):
        for j in range(width):
            out[i, j] = 0
            if not valid[i, j]:
                continue
            x, y, z = (
                np.float64(points[i, j, 0]),
                np.float64(points[i, j, 1]),
                np.float64(points[i, j, 2]),
            )
            # Smallest signed square of the cosine, so that one root is enough.
            min_cosine2 = 2.0
            range2 = x * x + y * y + z * z
            for v in range(max(0, i - 1), min(height, i + 2)):
                for u in range(max(0, j - 1), min(width, j + 2)):
                    if (v == i and u == j) or not valid[v, u]:
                        continue
                    dx = np.float64(points[v, u, 0]) - x
                    dy = np.float64(points[v, u, 1]) - y
                    dz = np.float64(points[v, u, 2]) - z
                    distance2 = dx * dx + dy * dy + dz * dz
                    if distance2 == 0:
                        continue
                    toward = -(x * dx + y * dy + z * dz)
                    min_cosine2 = min(min_cosine2, toward * abs(toward) / (distance2 * range2))
            if min_cosine2 <= 1.0 + 1e-9:
                min_cosine2 = min(max(min_cosine2, -1.0), 1.0)
                out[i, j] = math.acos(math.copysign(math.sqrt(abs(min_cosine2)), min_cosine2))


@kernel
def is_steeper(
    z: Float32,
    rays: Float32,
    cosine2: np.float32,
    start: int,
    stop: int,
    out: Bool,
) -> None:
    """Write where the angle of `largest_angle` exceeds an obtuse threshold.

    The inner loop has no roots, quotients or branches, so that it is vectorised.

    Parameters
    ----------
    z
        (H, W) z depth in m, 0 where invalid.
    rays
        (H, W, 2) x/z and y/z.
    cosine2
        Squared cosine of the obtuse threshold.
    start, stop
        Rows of `out` (H, W) to write: False where the point or all neighbours are invalid.
    """
    height, width = z.shape
    # Points of these rows and of the adjacent ones. Padding and invalid points are at the origin,
    # which is in front of all other points, so that the angle to it is never obtuse.
    points = np.zeros((3, stop - start + 2, width + 2), np.float32)
    for i in range(max(0, start - 1), min(height, stop + 1)):
        for j in range(width):
            if z[i, j] > 0:
                points[0, i - start + 1, j + 1] = rays[i, j, 0] * z[i, j]
                points[1, i - start + 1, j + 1] = rays[i, j, 1] * z[i, j]
                points[2, i - start + 1, j + 1] = z[i, j]
    threshold = np.empty(width, np.float32)
    steep = np.empty(width, np.bool_)
    for i in range(1, stop - start + 1):
        x, y, depth = points[0, i, 1:-1], points[1, i, 1:-1], points[2, i, 1:-1]
        for j in range(width):
            threshold[j] = cosine2 * (x[j] * x[j] + y[j] * y[j] + depth[j] * depth[j])
            steep[j] = False
        for v in range(i - 1, i + 2):
            for u in range(3):
                if v == i and u == 1:
                    continue
                a = points[0, v, u : u + width]
                b = points[1, v, u : u + width]
                c = points[2, v, u : u + width]
                for j in range(width):
                    dx, dy, dz = a[j] - x[j], b[j] - y[j], c[j] - depth[j]
                    dot = x[j] * dx + y[j] * dy + depth[j] * dz
                    distance2 = dx * dx + dy * dy + dz * dz
                    steep[j] |= (dot > 0) & (dot * dot > threshold[j] * distance2)
        for j in range(width):
            out[start + i - 1, j] = steep[j]
