"""Joint registration of corresponding point sets of many views (eq 2.8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.kernels.icp import transform_points
from tofuse.lab.methods.multiview import Cloud, Pairs, Relaxing, rotation_to
from tofuse.parts import part

# Weight of the fixed first view relative to all pairs.
_FIXED = 1e6
# Min relative decrease of the error per sweep over all rotations.
_SAME = 1e-12


@part("refinement", "williams-bennamoun", label="validated")
@dataclass(frozen=True)
class WilliamsBennamoun(Relaxing):
    """Simultaneous registration of corresponding point sets (Williams and Bennamoun 2001).

    Minimises ``sum |R_i p_i + t_i - R_j p_j - t_j|^2`` over all pairs and all views. The
    translations follow from the rotations by one linear system (their eq 11), which leaves a trace
    in the rotations only; each rotation in turn is optimised given the others, by a 3 x 3 SVD
    (section 4.3). The error decreases at every step, no rotation is linearised, and no view is
    preferred.

    Attributes
    ----------
    sweeps
        Sweeps over all rotations per round.
    """

    sweeps: int = 20

    def relax(self, poses: Float64, pairs: Sequence[Pairs], clouds: Sequence[Cloud]) -> Float64:
        """See `Relaxing.relax`."""
        return corresponding(poses, pairs, self.sweeps)[0]


def corresponding(
    poses: Float64, pairs: Sequence[Pairs], sweeps: int
) -> tuple[Float64, list[float]]:
    """Return the poses for given correspondences, and the error after each sweep.

    The first view of the connected ones is fixed.
    """
    n = len(poses)
    count = np.zeros((n, n))  # Laplacian of the translations
    first = np.zeros((n, n, 3))  # sum of p_k in the equation of view i: sum_k R_k first[i, k]
    second = np.zeros((n, n, 3, 3))  # sum of p_i p_j^T
    for p in pairs:
        m, a, b = len(p.p_i), p.p_i.sum(0), p.p_j.sum(0)
        count[p.i, p.i] += m
        count[p.j, p.j] += m
        count[p.i, p.j] -= m
        count[p.j, p.i] -= m
        first[p.i, p.i] += a
        first[p.i, p.j] -= b
        first[p.j, p.j] += b
        first[p.j, p.i] -= a
        second[p.i, p.j] += p.p_i.T @ p.p_j
        second[p.j, p.i] += p.p_j.T @ p.p_i
    grounded = np.linalg.pinv(count, hermitian=True)
    R = poses[:, :3, :3].copy()
    # With the translations t = -L^+ u of the rotations, u_i = sum_k R_k first[i, k], the error is
    # a constant less the sum of tr(R_i Q_ij R_j^T).
    Q = second + np.einsum("aki,ab,blj->klij", first, grounded, first)
    errors: list[float] = []
    for _ in range(sweeps):
        for k in range(n):
            others = np.einsum("jkl,jml->km", np.delete(Q[k], k, 0), np.delete(R, k, 0))
            if others.any():
                R[k] = rotation_to(others)
        gain = -float(np.einsum("iab,ijbc,jac->", R, Q, R))
        errors.append(gain)
        if len(errors) > 1 and errors[-2] - errors[-1] <= _SAME * abs(errors[-1]):
            break
    out = np.tile(np.eye(4), (n, 1, 1))
    out[:, :3, :3] = R
    out[:, :3, 3] = -grounded @ np.einsum("kab,ikb->ia", R, first)
    # Gauge freedom of the connected views: the first one is fixed.
    part_of = connected_components(count != 0, directed=False)[1]
    stays = np.unique(part_of, return_index=True)[1][part_of]
    return poses[stays] @ se3.inverse(out[stays]) @ out, errors


@part("refinement", "small-angles", label="validated")
@dataclass(frozen=True)
class SmallAngles(Relaxing):
    """All views by one linear system of small angles: aprxICP (Artner 2009; Borrmann et al. 2008).

    ``sum |x_i + v_i + w_i x x_i - x_j - v_j - w_j x x_j|^2`` over all pairs of points, with
    transformed points x, is quadratic in the motions (v, w) of all views, which are solved for
    jointly; then points are paired again. It is one Gauss-Newton step of eq 2.8, the objective of
    GraphSLAM (Thrun and Montemerlo 2005).
    """

    def relax(self, poses: Float64, pairs: Sequence[Pairs], clouds: Sequence[Cloud]) -> Float64:
        """See `Relaxing.relax`."""
        n = len(poses)
        H, g = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
        middle = np.mean(
            [transform_points(T, c.points).mean(0) for T, c in zip(poses, clouds, strict=True)], 0
        )
        for p in pairs:
            a = transform_points(poses[p.i], p.p_i) - middle
            b = transform_points(poses[p.j], p.p_j) - middle
            A, B, r = se3.point_jacobian(a), se3.point_jacobian(b), a - b
            H[p.i, :, p.i] += np.einsum("nki,nkj->ij", A, A)
            H[p.j, :, p.j] += np.einsum("nki,nkj->ij", B, B)
            mixed = np.einsum("nki,nkj->ij", A, B)
            H[p.i, :, p.j] -= mixed
            H[p.j, :, p.i] -= mixed.T
            g[p.i] += np.einsum("nki,nk->i", A, r)
            g[p.j] -= np.einsum("nki,nk->i", B, r)
        H[0, :, 0] += _FIXED * np.eye(6) * max(float(np.abs(H).max()), 1.0)
        step = -np.linalg.lstsq(H.reshape(6 * n, 6 * n), g.ravel(), rcond=1e-14)[0].reshape(n, 6)
        return np.asarray(se3.about(middle, se3.exp(step)) @ poses)
