"""Errors and normal equations of the edges of a pose graph, see `minimisation`."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.compute import kernel
from tofuse.engine.geometry import compose, twist_between


@kernel
def errors(measurements: Float64, poses: Float64, pairs: Intp, e: Float64) -> None:
    """Write the errors log(Z^-1 T_i_j) of M edges, of rotations by less than pi, to `e` (M, 6).

    Parameters
    ----------
    measurements, poses, pairs
        (M, 4, 4) Z, (N, 4, 4) poses and (M, 2) ends i, j of the edges.
    """
    for m in range(len(pairs)):
        expected = compose(poses[pairs[m, 0]], measurements[m])
        e[m] = twist_between(expected, poses[pairs[m, 1]])


@kernel
def normal_equations(
    e: Float64, information: Float64, weights: Float64, H: Float64, g: Float64
) -> None:
    """Write w J^T W J and w J^T W e of M edges, for right perturbations of their relative poses.

    Parameters
    ----------
    e, information, weights
        (M, 6) errors log(Z^-1 T_i_j), (M, 6, 6) information W and (M,) weights w of the edges. J is
        the inverse right Jacobian of e: ``log(exp(e) exp(d)) = e + J d + O(d^2)``.
    H, g
        (M, 6, 6) and (M, 6), are overwritten.
    """
    J, WJ = np.zeros((6, 6)), np.empty((6, 6))
    scratch = np.empty((8, 3, 3))
    for m in range(len(e)):
        _jacobian_inverse(e[m], J, scratch)
        for a in range(6):
            for b in range(6):
                total = 0.0
                for c in range(6):
                    total += information[m, a, c] * J[c, b]
                WJ[a, b] = total
        for a in range(6):
            for b in range(a, 6):
                total = 0.0
                for c in range(6):
                    total += J[c, a] * WJ[c, b]
                H[m, a, b] = H[m, b, a] = weights[m] * total
            total = 0.0
            for c in range(6):
                total += WJ[c, a] * e[m, c]
            g[m, a] = weights[m] * total


@kernel
def _jacobian_inverse(e: Float64, J: Float64, scratch: Float64) -> None:
    """Write the inverse right Jacobian of a twist (6,) to J (6, 6), zero below its diagonal.

    From the left one at the opposite twist (Barfoot, State Estimation for Robotics, eqs 7.86 and
    7.95). Singular where the rotation is a full turn.
    """
    V, W, VW, WV, WVW, left, coupling, product = scratch
    _hat(-e[0], -e[1], -e[2], V)
    _hat(-e[3], -e[4], -e[5], W)
    _multiply(V, W, VW)
    _multiply(W, V, WV)
    _multiply(WV, W, WVW)
    angle2 = e[3] * e[3] + e[4] * e[4] + e[5] * e[5]
    angle = np.sqrt(angle2)
    # The coefficients cancel at small angles, where series are exact to double precision.
    if angle < 0.1:
        s3 = 1 / 6 - angle2 / 120 + angle2**2 / 5040 - angle2**3 / 362880
        c2 = 1 / 24 - angle2 / 720 + angle2**2 / 40320 - angle2**3 / 3628800
        c3 = 1 / 120 - angle2 / 2520 + angle2**2 / 120960 - angle2**3 / 9979200
        inverse = 1 / 12 + angle2 / 720 + angle2**2 / 30240 + angle2**3 / 1209600
    else:
        half = np.sin(angle / 2)
        s3 = (angle - np.sin(angle)) / angle**3
        c2 = (0.5 - 2 * half * half / angle2) / angle2
        c3 = (c2 - 3 * (1 / 6 - s3) / angle2) / 2
        # (1 + cos) / sin, without its 0 / 0 at half a turn.
        inverse = (1 - 0.5 * angle * np.cos(angle / 2) / half) / angle2
    for a in range(3):
        for b in range(3):
            square = 0.0
            fourth = 0.0
            for k in range(3):
                square += W[a, k] * W[k, b]
                fourth += W[a, k] * WV[k, b] + VW[a, k] * W[k, b]
            left[a, b] = (1.0 if a == b else 0.0) - 0.5 * W[a, b] + inverse * square
            coupling[a, b] = (
                0.5 * V[a, b]
                + s3 * (WV[a, b] + VW[a, b] + WVW[a, b])
                + c2 * (fourth - 3 * WVW[a, b])
            )
            for k in range(3):
                coupling[a, b] += c3 * (WVW[a, k] * W[k, b] + W[a, k] * WVW[k, b])
    _multiply(left, coupling, product)
    for a in range(3):
        for b in range(3):
            J[a, b] = J[3 + a, 3 + b] = left[a, b]
            total = 0.0
            for k in range(3):
                total += product[a, k] * left[k, b]
            J[a, 3 + b] = -total


@kernel
def _hat(x: float, y: float, z: float, out: Float64) -> None:
    """Write the matrix of the cross product with (x, y, z)."""
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2] = -z, y
    out[1, 0], out[1, 2] = z, -x
    out[2, 0], out[2, 1] = -y, x


@kernel
def _multiply(A: Float64, B: Float64, out: Float64) -> None:
    """Write A B, of matrices (3, 3)."""
    for a in range(3):
        for b in range(3):
            out[a, b] = A[a, 0] * B[0, b] + A[a, 1] * B[1, b] + A[a, 2] * B[2, b]
