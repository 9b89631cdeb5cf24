"""Point-to-plane residuals between views of two cameras of a rig, each with its own range offset.

As in `pair_equations`, source points are compared with the plane of the target pixel that they
project to. Each point has its own row, as the cameras' unknowns are shared by many pairs of views.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel
from tofuse.engine.views import residual_kernels

# Columns of a row: signed distance from the target's plane in m and its variance (0: no
# correspondence), the target's normal in the source's frame, the source's own normal, the corrected
# source point, and the derivatives of the residual by the range offsets of source and target.
RESIDUAL = 0
RESIDUAL_VARIANCE = 1
TARGET_NORMAL = 2
SOURCE_NORMAL = 5
SOURCE_POINT = 8
BY_SOURCE_OFFSET = 11
BY_TARGET_OFFSET = 12
ROW = 13


@kernel
def residuals(
    points: Float32,
    target: residual_kernels.TargetImage,
    T: Float64,
    source_offset: float,
    target_offset: float,
    min_cosine: float,
    out: Float64,
) -> None:
    """Compare points with a target; overwrites `out` (N, ROW).

    Parameters
    ----------
    points, target, T, min_cosine
        As in `alignment.accumulate` and its `Residuals`.
    source_offset, target_offset
        To be added to the ranges of the two cameras, m.
    """
    image, lookup, lookup_frame = target
    rows, columns = image.shape[0], image.shape[1]
    for k in range(points.shape[0]):
        out[k, :] = 0.0
        x = np.float64(points[k, residual_kernels.POINT])
        y = np.float64(points[k, residual_kernels.POINT + 1])
        z = np.float64(points[k, residual_kernels.POINT + 2])
        length = np.sqrt(x * x + y * y + z * z)
        relative_offset = source_offset / length
        b0, b1, b2 = x / length, y / length, z / length
        x += relative_offset * x
        y += relative_offset * y
        z += relative_offset * z
        q0 = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        q1 = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        q2 = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if q2 <= projection_kernels.MIN_DEPTH:
            continue
        i, j = projection_kernels.nearest_pixel(
            q0 / q2, q1 / q2, lookup, lookup_frame, rows, columns
        )
        if i < 0:
            continue
        pixel = image[i, j]
        distance = np.float64(pixel[residual_kernels.DISTANCE])
        if distance == 0:
            continue
        n0 = np.float64(pixel[residual_kernels.PLANE])
        n1 = np.float64(pixel[residual_kernels.PLANE + 1])
        n2 = np.float64(pixel[residual_kernels.PLANE + 2])
        m0 = T[0, 0] * n0 + T[1, 0] * n1 + T[2, 0] * n2
        m1 = T[0, 1] * n0 + T[1, 1] * n1 + T[2, 1] * n2
        m2 = T[0, 2] * n0 + T[1, 2] * n1 + T[2, 2] * n2
        s0 = np.float64(points[k, residual_kernels.NORMAL])
        s1 = np.float64(points[k, residual_kernels.NORMAL + 1])
        s2 = np.float64(points[k, residual_kernels.NORMAL + 2])
        if s0 * m0 + s1 * m1 + s2 * m2 < min_cosine:
            continue
        # The target's offset moves its plane along the ray of the pixel.
        target_derivative = (n0 * q0 + n1 * q1 + n2 * q2) / np.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
        source_sigma = (m0 * x + m1 * y + m2 * z) * np.float64(points[k, residual_kernels.SIGMA])
        row = out[k]
        row[RESIDUAL] = n0 * q0 + n1 * q1 + n2 * q2 - distance - target_offset * target_derivative
        row[RESIDUAL_VARIANCE] = source_sigma * source_sigma + np.float64(
            pixel[residual_kernels.VARIANCE]
        )
        row[TARGET_NORMAL] = m0
        row[TARGET_NORMAL + 1] = m1
        row[TARGET_NORMAL + 2] = m2
        row[SOURCE_NORMAL] = s0
        row[SOURCE_NORMAL + 1] = s1
        row[SOURCE_NORMAL + 2] = s2
        row[SOURCE_POINT] = x
        row[SOURCE_POINT + 1] = y
        row[SOURCE_POINT + 2] = z
        row[BY_SOURCE_OFFSET] = m0 * b0 + m1 * b1 + m2 * b2
        row[BY_TARGET_OFFSET] = -target_derivative
