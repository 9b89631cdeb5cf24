"""The inner loops of ICP over arrays.

Sums over all pairs of points have a fixed order: BLAS may split the same sums among threads, and
its result then depends on their number.
"""

from __future__ import annotations

import math

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


@kernel
def _write_jacobian(J: Float64, p: Float64, a: Float64) -> None:
    """Write the derivative (6,) of the distance of the point p along the unit vector a."""
    for c in range(3):
        d = (c + 1) % 3
        e = (c + 2) % 3
        J[c] = a[c]
        J[3 + c] = p[d] * a[e] - p[e] * a[d]


@kernel
def plane_sums(
    p: Float64, a: Float64, b: Float64, residual: Float64, weight: Float64
) -> tuple[Float64, Float64, float]:
    """Sum ``w Ja^T Jb`` (6, 6), ``w Ja^T r`` (6,) and ``w r^2`` over pairs.

    ``Ja = [a, p x a]`` is the derivative of the distance along the unit vector a, (m, 3), and Jb
    that along b. If a and b are equal, these are the normal equations of point-to-plane.
    """
    H = np.zeros((6, 6))
    g = np.zeros(6)
    cost = 0.0
    Ja = np.empty(6)
    Jb = np.empty(6)
    for k in range(len(p)):
        w = weight[k]
        _write_jacobian(Ja, p[k], a[k])
        _write_jacobian(Jb, p[k], b[k])
        r = residual[k]
        for c in range(6):
            x = w * Ja[c]
            g[c] += x * r
            for d in range(6):
                H[c, d] += x * Jb[d]
        cost += w * r * r
    return H, g, cost


@kernel
def matrix_sums(
    p: Float64, residual: Float64, W: Float64, weight: Float64
) -> tuple[Float64, Float64, float]:
    """Sum ``w J^T W J`` (6, 6), ``w J^T W r`` (6,) and ``w r^T W r`` over pairs.

    ``J = [I, -hat(p)]``; the residual r is (m, 3); W is (m, 3, 3) and symmetric.
    """
    H = np.zeros((6, 6))
    g = np.zeros(6)
    cost = 0.0
    J = np.zeros((3, 6))
    WJ = np.empty((3, 6))
    for k in range(len(p)):
        w = weight[k]
        for c in range(3):
            d = (c + 1) % 3
            e = (c + 2) % 3
            J[c, c] = 1.0
            J[c, 3 + d] = p[k, e]
            J[c, 3 + e] = -p[k, d]
        for c in range(3):
            for d in range(6):
                x = 0.0
                for e in range(3):
                    x += W[k, c, e] * J[e, d]
                WJ[c, d] = w * x
        for c in range(6):
            for d in range(6):
                for e in range(3):
                    H[c, d] += J[e, c] * WJ[e, d]
            for e in range(3):
                g[c] += WJ[e, c] * residual[k, e]
        for c in range(3):
            for d in range(3):
                cost += w * residual[k, c] * W[k, c, d] * residual[k, d]
    return H, g, cost


@kernel
def plane_to_plane_weights(a: Float64, b: Float64, epsilon: float) -> Float64:
    """Return ``(C_a + C_b)^-1`` (m, 3, 3), C the covariance of a disc with the unit normal a or b.

    ``C_a = I - (1 - epsilon) a a^T``: variance 1 along the surface, epsilon across it.
    """
    out = np.empty((len(a), 3, 3))
    M = np.empty((3, 3))
    for k in range(len(a)):
        for c in range(3):
            for d in range(3):
                M[c, d] = (2.0 if c == d else 0.0) - (1 - epsilon) * (
                    a[k, c] * a[k, d] + b[k, c] * b[k, d]
                )
        determinant = 0.0
        for c in range(3):
            d = (c + 1) % 3
            e = (c + 2) % 3
            determinant += M[0, c] * (M[1, d] * M[2, e] - M[1, e] * M[2, d])
        for c in range(3):
            c1 = (c + 1) % 3
            c2 = (c + 2) % 3
            for d in range(3):
                d1 = (d + 1) % 3
                d2 = (d + 2) % 3
                out[k, d, c] = (M[c1, d1] * M[c2, d2] - M[c1, d2] * M[c2, d1]) / determinant
    return out


@kernel
def direction_products(
    p: Float64, a: Float64, b: Float64, weight: Float64, directions: Float64
) -> tuple[Float64, Float64]:
    """For each direction u (k, 6): sums of ``w Ja u Jb u`` and ``w ((Ja u)^2 + (Jb u)^2) / 2``.

    ``Ja = [a, p x a]`` and ``Jb = [b, p x b]``, as in `plane_sums`.
    """
    cross = np.zeros(len(directions))
    squares = np.zeros(len(directions))
    Ja = np.empty(6)
    Jb = np.empty(6)
    for k in range(len(p)):
        _write_jacobian(Ja, p[k], a[k])
        _write_jacobian(Jb, p[k], b[k])
        for u in range(len(directions)):
            x = 0.0
            y = 0.0
            for c in range(6):
                x += Ja[c] * directions[u, c]
                y += Jb[c] * directions[u, c]
            cross[u] += weight[k] * x * y
            squares[u] += weight[k] * (x * x + y * y) / 2
    return cross, squares


# Neighbourhoods with a smaller ratio of their two largest variances are lines without a normal.
_LINE_RATIO = 1e-8


@kernel
def _rotated(x: float, y: float, c: float, s: float) -> tuple[float, float]:
    """Return (x, y) rotated by an angle with this cosine and sine."""
    return c * x - s * y, s * x + c * y


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
                    A[k, p], A[k, q] = _rotated(A[k, p], A[k, q], c, s)
                for k in range(3):
                    A[p, k], A[q, k] = _rotated(A[p, k], A[q, k], c, s)
                for k in range(3):
                    vectors[k, p], vectors[k, q] = _rotated(vectors[k, p], vectors[k, q], c, s)
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
def moments(points: Float64, index: Int64, mean: Float64, C: Float64) -> int:
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
    gap: Float64,
    extents: Float64,
) -> None:
    """Fit the surface around each of the `centres` (m, 3) to its neighbours ``points[index[i]]``.

    `index` (m, k) is -1 after the last neighbour. Writes unit normals (m, 3) towards `origin` (3,),
    NaN where the neighbours lie on a line; the widest angle `gap` (m,) in rad around the centre
    without a neighbour; and the neighbours' rms extents (m, 2) across the plane and along its
    shorter side.
    """
    mean = np.empty(3)
    C = np.empty((3, 3))
    values = np.empty(3)
    vectors = np.empty((3, 3))
    for i in range(len(centres)):
        count = moments(points, index[i], mean, C)
        symmetric_eigen(C, values, vectors)
        if count < 3 or not values[1] > _LINE_RATIO * values[2]:
            normals[i, :] = np.nan
            gap[i] = 2 * math.pi
            extents[i, :] = np.nan
            continue
        extents[i, 0] = math.sqrt(max(values[0], 0.0))
        extents[i, 1] = math.sqrt(values[1])
        facing = 0.0
        for a in range(3):
            facing += vectors[a, 0] * (origin[a] - centres[i, a])
        sign = 1.0 if facing >= 0 else -1.0
        for a in range(3):
            normals[i, a] = sign * vectors[a, 0]
        u = vectors[:, 2].copy()
        v = vectors[:, 1].copy()
        gap[i] = _widest_gap(points, index[i], count, centres[i], u, v)
