"""The inner loops of ICP over arrays.

Sums over all pairs of points have a fixed order: BLAS may split the same sums among threads, and
its result then depends on their number.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.compute import kernel


@kernel
def transform_points(T: Float64, points: Float64) -> Float64:
    """Transform points (n, 3) by the rigid motion T (4, 4)."""
    out = np.empty_like(points)
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        for a in range(3):
            out[i, a] = T[a, 0] * x + T[a, 1] * y + T[a, 2] * z + T[a, 3]
    return out


@kernel
def shortest_of_each_target(target: Int64, distance: Float64, size: int) -> Bool:
    """Mark, among the pairs (m,) with the same target (0 to size - 1), the shortest one.

    Of equally short pairs the first is marked.
    """
    best = np.full(size, -1, np.int64)
    keep = np.zeros(len(target), np.bool_)
    for i in range(len(target)):
        previous = best[target[i]]
        if previous < 0 or distance[i] < distance[previous]:
            best[target[i]] = i
            keep[i] = True
            if previous >= 0:
                keep[previous] = False
    return keep


@kernel
def weighted_moments(
    p: Float64, q: Float64, i: Int64, j: Int64, weight: Float64
) -> tuple[Float64, Float64, Float64, float]:
    """Weighted moments of the pairs ``p[i[k]], q[j[k]]``, k = 0 .. m - 1.

    Returns the centroids (3,) of both, ``sum w (p - centroid) (q - centroid)^T`` (3, 3), and
    ``sum w (|p|^2 + |q|^2)``, to which rounding errors are proportional.
    """
    total = 0.0
    magnitude = 0.0
    p0 = np.zeros(3)
    q0 = np.zeros(3)
    for k in range(len(i)):
        w = weight[k]
        total += w
        for a in range(3):
            x = p[i[k], a]
            y = q[j[k], a]
            p0[a] += w * x
            q0[a] += w * y
            magnitude += w * (x * x + y * y)
    p0 /= total
    q0 /= total
    H = np.zeros((3, 3))
    for k in range(len(i)):
        for a in range(3):
            x = weight[k] * (p[i[k], a] - p0[a])
            for b in range(3):
                H[a, b] += x * (q[j[k], b] - q0[b])
    return p0, q0, H, magnitude


@kernel
def point_information(points: Float64, i: Int64, weight: Float64) -> Float64:
    """Return ``sum w J^T J`` (6, 6) with ``J = [I, -hat(p)]`` over the points ``points[i[k]]``."""
    total = 0.0
    first_moment = np.zeros(3)
    second_moment = np.zeros((3, 3))
    for k in range(len(i)):
        w = weight[k]
        total += w
        for a in range(3):
            x = w * points[i[k], a]
            first_moment[a] += x
            for b in range(a + 1):
                second_moment[a, b] += x * points[i[k], b]
    out = np.zeros((6, 6))
    for a in range(3):
        out[a, a] = total
        for b in range(a + 1):
            out[3 + a, 3 + b] = -second_moment[a, b]
            out[3 + b, 3 + a] = -second_moment[a, b]
    trace = second_moment[0, 0] + second_moment[1, 1] + second_moment[2, 2]
    for a in range(3):
        out[3 + a, 3 + a] += trace
        # -hat(sum w p) above the diagonal, its transpose below.
        b = (a + 1) % 3
        c = (a + 2) % 3
        out[b, 3 + c] = first_moment[a]
        out[c, 3 + b] = -first_moment[a]
        out[3 + c, b] = first_moment[a]
        out[3 + b, c] = -first_moment[a]
    return out
