"""Unit quaternions in the thesis's order ``q = [u, v, w, s]``, scalar last (section 2.4).

This is also the order of TUM trajectories (qx qy qz qw) and of SciPy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64


def unnormalised_matrix(q: ArrayLike) -> Float64:
    """``R_u(q)`` of eq 2.12, (..., 3, 3): a rotation scaled by ``q . q``."""
    u, v, w, s = np.moveaxis(np.asarray(q, float), -1, 0)
    rows = [
        [s * s + u * u - v * v - w * w, 2 * (u * v - s * w), 2 * (u * w + s * v)],
        [2 * (u * v + s * w), s * s - u * u + v * v - w * w, 2 * (v * w - s * u)],
        [2 * (u * w - s * v), 2 * (v * w + s * u), s * s - u * u - v * v + w * w],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def to_matrix(q: ArrayLike) -> Float64:
    """``R(q) = R_u(q) / (q . q)`` of eq 2.11: orthogonal for any q other than zero."""
    q = np.asarray(q, float)
    return unnormalised_matrix(q) / (q * q).sum(-1)[..., None, None]


def to_pose(q: ArrayLike, t: ArrayLike) -> Float64:
    """Rigid motions (..., 4, 4) with the rotation of q (..., 4) and translation t (..., 3)."""
    t = np.asarray(t, float)
    T = np.zeros((*t.shape[:-1], 4, 4))
    T[..., :3, :3] = to_matrix(q)
    T[..., :3, 3] = t
    T[..., 3, 3] = 1
    return T


def length(q: ArrayLike) -> Float64:
    """Norm (...) of quaternions read from files; infinite if float64 can't hold its square."""
    with np.errstate(over="ignore"):
        return np.asarray(np.linalg.norm(np.asarray(q, float), axis=-1))


def from_matrix(R: ArrayLike) -> Float64:
    """Unit quaternion (..., 4) with s >= 0 of rotation matrices (..., 3, 3).

    Each of the four components can be found from the diagonal; the largest is used to divide,
    so no angle loses precision (Shepperd 1978).
    """
    R = np.asarray(R, float)
    d = np.stack([R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]], -1)
    trace = d.sum(-1)
    # Four times the squares of u, v, w, s.
    squares = np.concatenate([1 + 2 * d - trace[..., None], (1 + trace)[..., None]], -1)
    best = squares.argmax(-1)
    uv = R[..., 1, 0] + R[..., 0, 1]
    uw = R[..., 0, 2] + R[..., 2, 0]
    vw = R[..., 2, 1] + R[..., 1, 2]
    us = R[..., 2, 1] - R[..., 1, 2]
    vs = R[..., 0, 2] - R[..., 2, 0]
    ws = R[..., 1, 0] - R[..., 0, 1]
    candidates = np.stack(
        [
            np.stack([squares[..., 0], uv, uw, us], -1),
            np.stack([uv, squares[..., 1], vw, vs], -1),
            np.stack([uw, vw, squares[..., 2], ws], -1),
            np.stack([us, vs, ws, squares[..., 3]], -1),
        ],
        -2,
    )
    q = np.take_along_axis(candidates, best[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def multiply(a: ArrayLike, b: ArrayLike) -> Float64:
    """Product with ``to_matrix(multiply(a, b)) == to_matrix(a) @ to_matrix(b)``."""
    au, av, aw, as_ = np.moveaxis(np.asarray(a, float), -1, 0)
    bu, bv, bw, bs = np.moveaxis(np.asarray(b, float), -1, 0)
    return np.stack(
        [
            as_ * bu + au * bs + av * bw - aw * bv,
            as_ * bv - au * bw + av * bs + aw * bu,
            as_ * bw + au * bv - av * bu + aw * bs,
            as_ * bs - au * bu - av * bv - aw * bw,
        ],
        -1,
    )
