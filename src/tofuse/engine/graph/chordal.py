"""Chordal initialisation of a pose graph, without an initial estimate.

A descent converges to the nearest minimum: from odometry that drifted far, to a wrong one. If
rotations were arbitrary 3 x 3 matrices, the measured rotations would be linear in them, so that
their least squares have one minimum; its matrices are projected to the nearest rotations. With
these, positions are linear as well. The best of the initialisations that Carlone, Tron, Daniilidis
and Dellaert compare ("Initialization techniques for 3D SLAM", ICRA 2015), there after Martinec and
Pajdla (2007).
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.graph.sparse import PairSystem

# Smallest information along a direction, relative to the largest of the edge: its inverse exists.
_MIN_INFORMATION = 1e-12


def chordal_poses(
    poses: Float64, pairs: Intp, measurements: Float64, information: Float64, fixed: Bool
) -> Float64 | None:
    """Return (n, 4, 4) poses by linear least squares, first of rotations, then of positions.

    Parameters
    ----------
    poses
        (n, 4, 4) T_world_k, of which only the fixed ones count.
    pairs
        (m, 2) positions i, j.
    measurements, information
        (m, 4, 4) measured T_i_j and (m, 6, 6) information of ``log(Z^-1 T_i^-1 T_j)``. Rotations
        are weighted by the mean variance of an edge about its three axes, positions by their whole
        covariance.
    fixed
        (n,) mask of fixed poses, at least one of each connected part.

    Returns
    -------
    None where the edges do not determine all poses.
    """
    scale = np.trace(information, axis1=1, axis2=2)
    used = scale > 0
    pairs, measurements, information = pairs[used], measurements[used], information[used]
    system = PairSystem(len(poses), pairs, fixed, size=3)
    i, j = system.pairs.T
    Z, scale = measurements[:, :3, :3], scale[used]
    C = np.linalg.inv(information + (_MIN_INFORMATION * scale)[:, None, None] * np.eye(6))

    precision = 3 / np.trace(C[:, 3:, 3:], axis1=1, axis2=2)
    W_rotation = precision[:, None, None] * np.eye(3)
    Rt = np.where(fixed[:, None, None], np.swapaxes(poses[:, :3, :3], 1, 2), 0.0)
    # R_j^T = Z^T R_i^T, column by column.
    rotation_residual = precision[:, None, None] * (Rt[j] - np.swapaxes(Z, 1, 2) @ Rt[i])
    columns = _solved(
        system,
        (W_rotation, -precision[:, None, None] * Z, W_rotation),
        -Z @ rotation_residual,
        rotation_residual,
    )
    if columns is None:
        return None
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3, :3] = np.swapaxes(Rt + columns, 1, 2)
    out = se3.orthonormalise(out)
    out[fixed] = poses[fixed]
    R = out[:, :3, :3]

    # The translation of an edge's error is R_j^T (t_j - t_i - R_i z).
    Rj = R[i] @ Z
    W = Rj @ np.linalg.inv(C[:, :3, :3]) @ np.swapaxes(Rj, 1, 2)
    t = np.where(fixed[:, None], poses[:, :3, 3], 0.0)
    translation_residual = (t[j] - t[i])[..., None] - R[i] @ measurements[:, :3, 3:]
    translations = _solved(system, (W, -W, W), -W @ translation_residual, W @ translation_residual)
    if translations is None:
        return None
    out[~fixed, :3, 3] = translations[~fixed, :, 0]
    return out


def _solved(
    system: PairSystem, blocks: tuple[Float64, Float64, Float64], g_i: Float64, g_j: Float64
) -> Float64 | None:
    """Return the (n, 3, q) solutions for gradients (m, 3, q); zero for fixed poses."""
    gradients = [system.assemble(*blocks, g_i[..., k], g_j[..., k]) for k in range(g_i.shape[-1])]
    factor = system.factor(*gradients[0])
    if factor is None:
        return None
    solutions = [factor.solve(gradient) for _, gradient in gradients]
    finite = [x for x in solutions if x is not None]
    return np.stack(finite, -1) if len(finite) == len(solutions) else None
