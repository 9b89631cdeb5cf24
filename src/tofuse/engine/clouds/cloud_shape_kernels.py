"""The shape of a surface around each point of a cloud: plane fits, curvature, edges, moments."""

from __future__ import annotations

import math

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.compute import kernel

# Neighbourhoods with a smaller ratio of their two largest variances are lines without a normal.
_LINE_RATIO = 1e-8


@kernel
def symmetric_eigen(A: Float64, values: Float64, vectors: Float64) -> None:
    """Eigenvalues (3,), ascending, and eigenvectors, in columns (3, 3), of a symmetric A (3, 3).

    Jacobi rotations compute small eigenvalues accurately. A is overwritten.
    """
    for a in range(3):
        for b in range(3):
            vectors[a, b] = 1.0 if a == b else 0.0
    for _ in range(20):
        off_diagonal = abs(A[0, 1]) + abs(A[0, 2]) + abs(A[1, 2])
        if off_diagonal <= 1e-18 * (abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0:
                    continue
                theta = (A[q, q] - A[p, p]) / (2 * A[p, q])
                sign = 1.0 if theta >= 0 else -1.0
                t = sign / (abs(theta) + math.sqrt(theta * theta + 1))
                c = 1 / math.sqrt(t * t + 1)
                s = t * c
                for k in range(3):
                    x = A[k, p]
                    y = A[k, q]
                    A[k, p] = c * x - s * y
                    A[k, q] = s * x + c * y
                for k in range(3):
                    x = A[p, k]
                    y = A[q, k]
                    A[p, k] = c * x - s * y
                    A[q, k] = s * x + c * y
                for k in range(3):
                    x = vectors[k, p]
                    y = vectors[k, q]
                    vectors[k, p] = c * x - s * y
                    vectors[k, q] = s * x + c * y
    for a in range(3):
        values[a] = A[a, a]
    for a in range(2):
        smallest = a
        for b in range(a + 1, 3):
            if values[b] < values[smallest]:
                smallest = b
        if smallest != a:
            values[a], values[smallest] = values[smallest], values[a]
            for k in range(3):
                vectors[k, a], vectors[k, smallest] = vectors[k, smallest], vectors[k, a]


@kernel
def _moments(points: Float64, index: Int64, mean: Float64, C: Float64) -> int:
    """Centroid (3,), covariance (3, 3) and number of the points `index`, up to the first -1."""
    count = 0
    mean[:] = 0.0
    C[:, :] = 0.0
    for k in range(len(index)):
        if index[k] < 0:
            break
        count += 1
        for a in range(3):
            mean[a] += points[index[k], a]
    if count == 0:
        return 0
    for a in range(3):
        mean[a] /= count
    for k in range(count):
        for a in range(3):
            x = points[index[k], a] - mean[a]
            for b in range(a + 1):
                C[a, b] += x * (points[index[k], b] - mean[b])
    for a in range(3):
        for b in range(a + 1):
            C[a, b] /= count
            C[b, a] = C[a, b]
    return count


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
    # Positive if the surface bulges towards the side that the normal points to.
    return -numerator / (2 * (1 + p * p + q * q) ** 1.5)


@kernel
def _widest_gap(
    points: Float64, index: Int64, count: int, centre: Float64, u: Float64, v: Float64
) -> float:
    """Widest angle (rad) without a neighbour in the tangent plane; 2 pi if there are none."""
    angles = np.empty(count)
    m = 0
    for k in range(count):
        x = 0.0
        y = 0.0
        for a in range(3):
            offset = points[index[k], a] - centre[a]
            x += offset * u[a]
            y += offset * v[a]
        if x != 0 or y != 0:
            angle = math.atan2(y, x)
            # Insertion sort: there are few, and NumPy's sort takes long to compile.
            j = m
            while j > 0 and angles[j - 1] > angle:
                angles[j] = angles[j - 1]
                j -= 1
            angles[j] = angle
            m += 1
    if m == 0:
        return 2 * math.pi
    widest = angles[0] + 2 * math.pi - angles[m - 1]
    for k in range(1, m):
        widest = max(widest, angles[k] - angles[k - 1])
    return widest


@kernel
def local_shapes(
    points: Float64,
    index: Int64,
    centres: Float64,
    origin: Float64,
    normals: Float64,
    curvature: Float64,
    gap: Float64,
    roughness: Float64,
) -> None:
    """Fit the surface around each of the `centres` (m, 3) to its neighbours ``points[index[i]]``.

    `index` (m, k) is -1 after the last neighbour. Writes unit normals (m, 3) towards `origin` (3,),
    NaN where the neighbours lie on a line; the mean curvature (m,) in 1/m, positive where the
    surface bulges towards `origin`, NaN where it is not determined; the widest angle `gap` (m,) in
    rad around the centre without a neighbour; and the ratio (m,) of the neighbours' rms extents
    across the plane and along its shorter side.
    """
    mean = np.empty(3)
    C = np.empty((3, 3))
    values = np.empty(3)
    vectors = np.empty((3, 3))
    for i in range(len(centres)):
        count = _moments(points, index[i], mean, C)
        symmetric_eigen(C, values, vectors)
        if count < 3 or not values[1] > _LINE_RATIO * values[2]:
            normals[i, :] = np.nan
            curvature[i] = np.nan
            gap[i] = 2 * math.pi
            roughness[i] = np.nan
            continue
        roughness[i] = math.sqrt(max(values[0], 0.0) / values[1])
        facing = 0.0
        for a in range(3):
            facing += vectors[a, 0] * (origin[a] - centres[i, a])
        sign = 1.0 if facing >= 0 else -1.0
        for a in range(3):
            normals[i, a] = sign * vectors[a, 0]
        u = vectors[:, 2].copy()
        v = vectors[:, 1].copy()
        curvature[i] = _mean_curvature(points, index[i], count, mean, u, v, normals[i])
        gap[i] = _widest_gap(points, index[i], count, centres[i], u, v)
