"""Rigid motions: SE(3) as (..., 4, 4) float64 matrices, vectorised over leading axes.

Twists are (..., 6) vectors (tx, ty, tz, rx, ry, rz) in metres and radians. Perturbations act on
the right, ``T * exp(xi)``, that is in the source frame of ``T_target_source``. The exponential is
the full one (Barfoot, State Estimation for Robotics, eqs 7.86 to 7.95), not the pseudo-exponential
that leaves the translation unchanged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError

MAX_COORDINATE_M = 1e9  # larger coordinates are considered damaged
_MATRIX = "use a rigid motion (4, 4): a rotation, a translation in m, and a last row of 0 0 0 1"
_SMALL = 1e-4  # rad; below it the series are exact to float64


def hat(w: ArrayLike) -> Float64:
    """Return the (..., 3, 3) matrix with ``hat(w) @ v == cross(w, v)``."""
    w = np.asarray(w, float)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def _coefficients(angle: Float64) -> tuple[Float64, Float64, Float64]:
    """Return sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3, without cancellation near zero."""
    small = angle < _SMALL
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    half = np.sin(a / 2)
    s1 = np.where(small, 1 - a2 / 6, np.sin(a) / a)
    s2 = np.where(small, 0.5 - a2 / 24, 2 * half * half / (a * a))
    s3 = np.where(small, 1 / 6 - a2 / 120, (a - np.sin(a)) / a**3)
    # (a - sin a) / a^3 cancels below about 0.02 rad; the series is used up to there.
    middle = (~small) & (angle < 0.02)
    s3 = np.where(middle, 1 / 6 - a2 / 120 + a2 * a2 / 5040, s3)
    return s1, s2, s3


def so3_exp(w: ArrayLike) -> Float64:
    """Rotation matrix (..., 3, 3) of a rotation vector (..., 3) in radians (Rodrigues)."""
    w = np.asarray(w, float)
    s1, s2, _ = _coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + s1[..., None, None] * W + s2[..., None, None] * (W @ W)


def so3_log(R: ArrayLike) -> Float64:
    """Rotation vector (..., 3), of length 0 to pi, of a rotation matrix (..., 3, 3)."""
    from tofuse.engine.geometry.quaternion import from_matrix

    q = from_matrix(R)
    q = np.where(q[..., 3:] < 0, -q, q)
    vector, s = q[..., :3], q[..., 3]
    norm = np.linalg.norm(vector, axis=-1)
    angle = 2 * np.arctan2(norm, s)
    scale = np.where(norm < 1e-10, 2.0, angle / np.where(norm < 1e-10, 1.0, norm))
    return scale[..., None] * vector


def left_jacobian(w: ArrayLike) -> Float64:
    """Left Jacobian of SO(3), (..., 3, 3): translation part of the SE(3) exponential."""
    w = np.asarray(w, float)
    _, s2, s3 = _coefficients(np.linalg.norm(w, axis=-1))
    W = hat(w)
    return np.eye(3) + s2[..., None, None] * W + s3[..., None, None] * (W @ W)


def left_jacobian_inverse(w: ArrayLike) -> Float64:
    """Inverse of `left_jacobian`, (..., 3, 3)."""
    w = np.asarray(w, float)
    angle = np.linalg.norm(w, axis=-1)
    small = angle < 0.02
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    c = np.where(
        small,
        1 / 12 + a2 / 720 + a2 * a2 / 30240,
        1 / (a * a) - (1 + np.cos(a)) / (2 * a * np.where(small, 1.0, np.sin(a))),
    )
    # At pi the quotient is 0 / 0 with limit 0.
    c = np.where(np.abs(a - np.pi) < 1e-7, 1 / np.pi**2, c)
    W = hat(w)
    return np.eye(3) - 0.5 * W + c[..., None, None] * (W @ W)


def exp(xi: ArrayLike) -> Float64:
    """Rigid motion (..., 4, 4) of a twist (..., 6): the full SE(3) exponential."""
    xi = np.asarray(xi, float)
    t = (left_jacobian(xi[..., 3:]) @ xi[..., :3, None])[..., 0]
    return pose(so3_exp(xi[..., 3:]), t)


def log(T: ArrayLike) -> Float64:
    """Twist (..., 6) of a rigid motion (..., 4, 4); the inverse of `exp` for angles below pi."""
    T = np.asarray(T, float)
    w = so3_log(T[..., :3, :3])
    t = (left_jacobian_inverse(w) @ T[..., :3, 3, None])[..., 0]
    return np.concatenate([t, w], axis=-1)


def inverse(T: ArrayLike) -> Float64:
    """Inverse of rigid motions (..., 4, 4): ``T_b_a`` from ``T_a_b``."""
    T = np.asarray(T, float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def adjoint(T: ArrayLike) -> Float64:
    """Adjoint (..., 6, 6): ``T exp(xi) T^-1 == exp(adjoint(T) @ xi)`` in the (t, r) order."""
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    out = np.zeros((*R.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return out


def transform(T: ArrayLike, points: ArrayLike) -> Float64:
    """Map points (..., N, 3) by ``T_a_b`` (..., 4, 4): points of frame b, in frame a."""
    T = np.asarray(T, float)
    return np.asarray(points) @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def about(centre: ArrayLike, T: ArrayLike) -> Float64:
    """Return the motions (..., 4, 4) that act about a centre (3,) as T does about the origin."""
    centre, T = np.asarray(centre, float), np.asarray(T, float)
    return np.asarray(translation(centre) @ T @ translation(-centre)) if centre.any() else T


def pose(R: ArrayLike, t: ArrayLike = 0.0) -> Float64:
    """Return the motions (..., 4, 4) of rotation matrices (..., 3, 3) and translations (..., 3)."""
    R = np.asarray(R, float)
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1
    return T


def translation(t: ArrayLike) -> Float64:
    """Return the translation (4, 4) by t (3,)."""
    return pose(np.eye(3), t)


def point_jacobian(points: ArrayLike) -> Float64:
    """Return the derivatives (..., 3, 6) of ``exp(xi) p`` at zero, ``[I, -hat(p)]``."""
    p = np.asarray(points, float)
    return np.concatenate([np.broadcast_to(np.eye(3), (*p.shape, 3)), -hat(p)], axis=-1)


def interpolate(T_a: ArrayLike, T_b: ArrayLike, fraction: ArrayLike) -> Float64:
    """Motion from T_a (fraction 0) to T_b (fraction 1) at constant body velocity (a screw)."""
    T_a = np.asarray(T_a, float)
    fraction = np.asarray(fraction, float)
    return T_a @ exp(fraction[..., None] * log(inverse(T_a) @ np.asarray(T_b, float)))


def orthonormalise(T: ArrayLike) -> Float64:
    """Replace the rotation by the nearest orthogonal one (SVD), after long products of motions."""
    T = np.array(T, float)
    T[..., :3, :3] = nearest_rotation(T[..., :3, :3])
    return T


def nearest_rotation(M: ArrayLike) -> Float64:
    """Return the rotations R (..., 3, 3) nearest to matrices M: ``R.T @ M`` has the largest trace.

    With ``M = sum q p^T``, R rotates the vectors p to the q in least squares (Arun 1987; Umeyama
    1991).
    """
    U, _, Vt = np.linalg.svd(np.asarray(M, float))
    U[..., :, 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt, np.float64)


def angle(R: ArrayLike) -> Float64:
    """Screw-axis angle, 0 to pi rad, of rotations (..., 3, 3) or motions (..., 4, 4).

    Computed from both sine and cosine, so it is accurate at 0 and at pi (Soderkvist and Wedin).
    """
    R = np.asarray(R, float)
    axis = np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    return np.arctan2(np.linalg.norm(axis, axis=-1), trace - 1)


def is_within(T: ArrayLike, metres: float, rad: float) -> bool:
    """Whether a motion (4, 4) is at most `metres` long, and rotates by at most `rad`."""
    T = np.asarray(T, float)
    return bool(np.linalg.norm(T[:3, 3]) <= metres and angle(T) <= rad)


def lengths(T: ArrayLike) -> Float64:
    """Lengths, m, and angles, rad, (..., 2) of motions (..., 4, 4)."""
    T = np.asarray(T, float)
    return np.stack([np.linalg.norm(T[..., :3, 3], axis=-1), angle(T)], axis=-1)


def change_of_view(T: ArrayLike, depth: ArrayLike) -> Float64:
    """How far motions (..., 4, 4) move a view of this depth, m: as a fraction of it, plus rad."""
    length, rotation = np.moveaxis(lengths(T), -1, 0)
    return np.asarray(length / np.asarray(depth) + rotation)


def largest_sigmas(C: ArrayLike) -> Float64:
    """Standard deviations, m and rad, (..., 2) in the worst directions; NaN where unknown.

    Parameters
    ----------
    C
        (..., 6, 6) covariances of twists, NaN where unknown.
    """
    C = np.asarray(C, float)
    blocks = np.stack([C[..., :3, :3], C[..., 3:, 3:]], axis=-3)
    known = np.isfinite(blocks).all((-2, -1))
    variances = np.linalg.eigvalsh(np.where(known[..., None, None], blocks, 0.0))[..., -1]
    return np.where(known, np.sqrt(variances.clip(0)), np.nan)


def check_pose(T: ArrayLike, *, where: str = "pose") -> Float64:
    """Return T as a float64 (4, 4) array, or raise InputError if it is not a rigid motion."""
    try:
        T = np.asarray(T, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("is not a matrix of numbers", where=where, remedy=_MATRIX) from error
    if T.shape != (4, 4) or not np.isfinite(T).all():
        shape = "" if T.shape == (4, 4) else f", but has shape {T.shape}"
        raise InputError(f"is not a finite 4x4 matrix{shape}", where=where, remedy=_MATRIX)
    R = T[:3, :3]
    # The first condition excludes overflow in the others.
    if np.abs(R).max() > 2 or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        problem = "has no rotation in its upper left 3x3 block"
        raise InputError(problem, where=where, remedy=_MATRIX)
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        # Of a transposed pose the last column is 0 0 0 1.
        remedy = None if T[:3, 3].any() else "transpose it: it seems to be stored by columns"
        raise InputError("has a last row other than 0 0 0 1", where=where, remedy=remedy)
    if np.abs(T[:3, 3]).max() > MAX_COORDINATE_M:
        raise InputError(
            f"has a coordinate of {np.abs(T[:3, 3]).max():.3g} m",
            where=where,
            remedy="use metres, or remove the pose",
        )
    return T


def is_unknown(T: ArrayLike) -> bool:
    """Whether the upper three rows of T (4, 4) have no finite number: there is no pose."""
    return not np.isfinite(np.asarray(T, float)[:3]).any()


def check_poses(poses: ArrayLike, *, where: str, count: int | None = None) -> Float64:
    """Return poses of the user as a float64 (N, 4, 4) array, NaN where there is none.

    Parameters
    ----------
    poses
        (N, 4, 4), NaN where there is none.
    where
        Name of the argument, for errors.
    count
        The required N, if any.

    Raises
    ------
    InputError
        If the shape differs, or a pose is not a rigid motion.
    """
    remedy = f"pass ({'N' if count is None else count}, 4, 4) T_world_camera, NaN where unknown"
    try:
        out = np.array(poses, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("is not an array of numbers", where=where, remedy=remedy) from error
    if out.ndim != 3 or out.shape[1:] != (4, 4) or count not in (None, len(out)):
        raise InputError(f"has shape {out.shape}", where=where, remedy=remedy)
    for k, T in enumerate(out):
        if is_unknown(T):
            out[k] = np.nan
        else:
            check_pose(T, where=f"{where}[{k}]")
    return out
