"""Mean curvature of a surface at its points."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.compute import kernel
from tofuse.engine.icp import icp_kernels


@kernel
def _mean_curvature(
    points: Float64, index: Int64, count: int, centre: Float64, u: Float64, v: Float64, n: Float64
) -> float:
    """Mean curvature of ``h = (a x^2 + 2 b x y + c y^2) / 2 + d x + e y + f`` fitted to points."""
    M = np.zeros((6, 7))
    f = np.ones(6)
    for k in range(count):
        x = 0.0
        y = 0.0
        h = 0.0
        for a in range(3):
            offset = points[index[k], a] - centre[a]
            x += offset * u[a]
            y += offset * v[a]
            h += offset * n[a]
        f[0] = x * x / 2
        f[1] = x * y
        f[2] = y * y / 2
        f[3] = x
        f[4] = y
        for a in range(6):
            for b in range(6):
                M[a, b] += f[a] * f[b]
            M[a, 6] += f[a] * h
    # Gaussian elimination; units differ, so each pivot has its own scale.
    scale = np.empty(6)
    for a in range(6):
        scale[a] = M[a, a]
    for a in range(6):
        if not M[a, a] > 1e-9 * scale[a]:
            return np.nan
        for b in range(a + 1, 6):
            w = M[b, a] / M[a, a]
            for c in range(a, 7):
                M[b, c] -= w * M[a, c]
    for a in range(5, -1, -1):
        for b in range(a + 1, 6):
            M[a, 6] -= M[a, b] * M[b, 6]
        M[a, 6] /= M[a, a]
    p = M[3, 6]
    q = M[4, 6]
    numerator = (1 + q * q) * M[0, 6] - 2 * p * q * M[1, 6] + (1 + p * p) * M[2, 6]
    return -numerator / (2 * (1 + p * p + q * q) ** 1.5)


@kernel
def mean_curvatures(points: Float64, index: Int64, normals: Float64) -> Float64:
    """Return the mean curvature (m,) in 1/m of quadrics fitted to neighbours ``points[index[i]]``.

    `index` (m, k) is -1 after the last neighbour, and `normals` (m, 3) are those of
    `icp_kernels.local_shapes`. Positive where the surface bulges towards the side that the normal
    points to; NaN where it is not determined.
    """
    mean = np.empty(3)
    C = np.empty((3, 3))
    values = np.empty(3)
    vectors = np.empty((3, 3))
    out = np.empty(len(index))
    for i in range(len(index)):
        out[i] = np.nan
        if np.isnan(normals[i, 0]):
            continue
        count = icp_kernels.moments(points, index[i], mean, C)
        icp_kernels.symmetric_eigen(C, values, vectors)
        u = vectors[:, 2].copy()
        v = vectors[:, 1].copy()
        out[i] = _mean_curvature(points, index[i], count, mean, u, v, normals[i])
    return out
