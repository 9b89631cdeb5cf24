"""Normal equations of registration metrics over pairs of points, summed in a fixed order.

Motions are right perturbations ``T exp(xi)``, xi = (tx ty tz rx ry rz), and everything is given in
the source's frame: p is a source point, and r the residual rotated into that frame,
``r = R^T (T p - q)``. The derivative of r is ``[I, -hat(p)]``.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import kernel


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
        for c in range(3):
            d = (c + 1) % 3
            e = (c + 2) % 3
            Ja[c] = a[k, c]
            Jb[c] = b[k, c]
            Ja[3 + c] = p[k, d] * a[k, e] - p[k, e] * a[k, d]
            Jb[3 + c] = p[k, d] * b[k, e] - p[k, e] * b[k, d]
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
        for c in range(3):
            d = (c + 1) % 3
            e = (c + 2) % 3
            Ja[c] = a[k, c]
            Jb[c] = b[k, c]
            Ja[3 + c] = p[k, d] * a[k, e] - p[k, e] * a[k, d]
            Jb[3 + c] = p[k, d] * b[k, e] - p[k, e] * b[k, d]
        for u in range(len(directions)):
            x = 0.0
            y = 0.0
            for c in range(6):
                x += Ja[c] * directions[u, c]
                y += Jb[c] * directions[u, c]
            cross[u] += weight[k] * x * y
            squares[u] += weight[k] * (x * x + y * y) / 2
    return cross, squares
