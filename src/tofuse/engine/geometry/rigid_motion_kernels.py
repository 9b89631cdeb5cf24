"""Rigid motions inside kernels: the exponential map and its inverse."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import kernel


@kernel
def retract(T: Float64, xi: Float64) -> Float64:
    """Return T exp(xi), (4, 4), its rotation re-orthogonalised by one Newton step."""
    w0, w1, w2 = xi[3], xi[4], xi[5]
    angle2 = w0 * w0 + w1 * w1 + w2 * w2
    angle = np.sqrt(angle2)
    if angle < 1e-4:
        s1 = 1 - angle2 / 6
        s2 = 0.5 - angle2 / 24
        s3 = 1.0 / 6 - angle2 / 120
    else:
        s1 = np.sin(angle) / angle
        s2 = (1 - np.cos(angle)) / angle2
        s3 = (angle - np.sin(angle)) / (angle2 * angle)
    W = np.zeros((3, 3))
    W[0, 1], W[0, 2] = -w2, w1
    W[1, 0], W[1, 2] = w2, -w0
    W[2, 0], W[2, 1] = -w1, w0
    R = np.zeros((3, 3))
    V = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            square = 0.0
            for k in range(3):
                square += W[i, k] * W[k, j]
            identity = 1.0 if i == j else 0.0
            R[i, j] = identity + s1 * W[i, j] + s2 * square
            V[i, j] = identity + s2 * W[i, j] + s3 * square
    out = np.zeros((4, 4))
    for i in range(3):
        out[i, 3] = T[i, 3]
        for j in range(3):
            translation = 0.0
            for k in range(3):
                out[i, j] += T[i, k] * R[k, j]
                translation += V[j, k] * xi[k]
            out[i, 3] += T[i, j] * translation
    # One Newton step towards orthogonality: R (3 - R^T R) / 2.
    G = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                G[i, j] += out[k, i] * out[k, j]
    orthogonal = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                h = (3.0 if k == j else 0.0) - G[k, j]
                orthogonal[i, j] += 0.5 * out[i, k] * h
    for i in range(3):
        for j in range(3):
            out[i, j] = orthogonal[i, j]
    out[3, 3] = 1
    return out


@kernel
def compose(A: Float64, B: Float64) -> Float64:
    """Return A B, (4, 4), of two rigid motions."""
    out = np.zeros((4, 4))
    for i in range(3):
        out[i, 3] = A[i, 3]
        for k in range(3):
            out[i, 3] += A[i, k] * B[k, 3]
            for j in range(3):
                out[i, j] += A[i, k] * B[k, j]
    out[3, 3] = 1
    return out


@kernel
def twist_between(A: Float64, B: Float64) -> Float64:
    """Return log(A^-1 B), (6,), for rotations by less than pi."""
    R = np.zeros((3, 3))
    t = np.zeros(3)
    for i in range(3):
        for k in range(3):
            t[i] += A[k, i] * (B[k, 3] - A[k, 3])
            for j in range(3):
                R[i, j] += A[k, i] * B[k, j]
    w0 = R[2, 1] - R[1, 2]
    w1 = R[0, 2] - R[2, 0]
    w2 = R[1, 0] - R[0, 1]
    sine = 0.5 * np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    factor = 0.5 * (angle / sine if sine > 1e-9 else 1.0)
    w0, w1, w2 = factor * w0, factor * w1, factor * w2
    if angle < 0.02:
        c = 1.0 / 12 + angle * angle / 720
    else:
        c = 1.0 / (angle * angle) - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    # The inverse left Jacobian: 1 - W / 2 + c W^2.
    a0, a1, a2 = w1 * t[2] - w2 * t[1], w2 * t[0] - w0 * t[2], w0 * t[1] - w1 * t[0]
    out = np.empty(6)
    out[0] = t[0] - 0.5 * a0 + c * (w1 * a2 - w2 * a1)
    out[1] = t[1] - 0.5 * a1 + c * (w2 * a0 - w0 * a2)
    out[2] = t[2] - 0.5 * a2 + c * (w0 * a1 - w1 * a0)
    out[3], out[4], out[5] = w0, w1, w2
    return out


@kernel
def distance_and_angle(A: Float64, B: Float64) -> tuple[float, float]:
    """Return length of translation (m) and angle of rotation (0 to pi rad) of A^-1 B."""
    R = np.zeros((3, 3))
    square = 0.0
    for i in range(3):
        square += (B[i, 3] - A[i, 3]) ** 2
        for k in range(3):
            for j in range(3):
                R[i, j] += A[k, i] * B[k, j]
    sine2 = (R[2, 1] - R[1, 2]) ** 2 + (R[0, 2] - R[2, 0]) ** 2 + (R[1, 0] - R[0, 1]) ** 2
    return np.sqrt(square), np.arctan2(np.sqrt(sine2), R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
