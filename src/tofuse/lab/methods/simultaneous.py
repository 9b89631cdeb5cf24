"""Joint registration of corresponding point sets of many views (eq 2.8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.connections import parts_of
from tofuse.engine.geometry import se3
from tofuse.engine.icp import icp_kernels
from tofuse.engine.parts import part
from tofuse.lab.methods.multiview import Cloud, Pairs, RelaxationMethod

# Weight of the fixed first view relative to all pairs.
_GAUGE_WEIGHT = 1e6
# Min relative decrease of the error per sweep over all rotations.
_MIN_RELATIVE_DECREASE = 1e-12


@part("refinement", "williams-bennamoun", label="validated")
@dataclass(frozen=True)
class WilliamsBennamoun(RelaxationMethod):
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
        """See `RelaxationMethod.relax`."""
        return solve_correspondences(poses, pairs, self.sweeps)[0]


def solve_correspondences(
    poses: Float64, pairs: Sequence[Pairs], sweeps: int
) -> tuple[Float64, list[float]]:
    """Return the poses for given correspondences, and the error after each sweep.

    The first view of the connected ones is fixed.
    """
    n = len(poses)
    laplacian = np.zeros((n, n))  # Laplacian of the translations
    first_moment = np.zeros((n, n, 3))  # of view i: sum_k R_k first_moment[i, k]
    second_moment = np.zeros((n, n, 3, 3))  # sum of p_i p_j^T
    for p in pairs:
        m, a, b = len(p.p_i), p.p_i.sum(0), p.p_j.sum(0)
        laplacian[p.i, p.i] += m
        laplacian[p.j, p.j] += m
        laplacian[p.i, p.j] -= m
        laplacian[p.j, p.i] -= m
        first_moment[p.i, p.i] += a
        first_moment[p.i, p.j] -= b
        first_moment[p.j, p.j] += b
        first_moment[p.j, p.i] -= a
        second_moment[p.i, p.j] += p.p_i.T @ p.p_j
        second_moment[p.j, p.i] += p.p_j.T @ p.p_i
    laplacian_inverse = np.linalg.pinv(laplacian, hermitian=True)
    R = poses[:, :3, :3].copy()
    # The translations are t = -L^+ u with u_i = sum_k R_k first_moment[i, k], so the error is a
    # constant minus the sum of tr(R_i Q_ij R_j^T).
    Q = second_moment + np.einsum("aki,ab,blj->klij", first_moment, laplacian_inverse, first_moment)
    errors: list[float] = []
    for _ in range(sweeps):
        for k in range(n):
            H = np.einsum("jkl,jml->km", np.delete(Q[k], k, 0), np.delete(R, k, 0))
            if H.any():
                R[k] = se3.nearest_rotation(H.T)
        errors.append(-float(np.einsum("iab,ijbc,jac->", R, Q, R)))
        if len(errors) > 1 and errors[-2] - errors[-1] <= _MIN_RELATIVE_DECREASE * abs(errors[-1]):
            break
    out = se3.pose(R, -laplacian_inverse @ np.einsum("kab,ikb->ia", R, first_moment))
    # Gauge freedom of the connected views: the first one is fixed.
    component = parts_of(len(laplacian), np.argwhere(laplacian != 0))
    anchor = np.unique(component, return_index=True)[1][component]
    return poses[anchor] @ se3.inverse(out[anchor]) @ out, errors


@part("refinement", "small-angles", label="validated")
@dataclass(frozen=True)
class SmallAngles(RelaxationMethod):
    """All views by one linear system of small angles: aprxICP (Artner 2009; Borrmann et al. 2008).

    ``sum |x_i + v_i + w_i x x_i - x_j - v_j - w_j x x_j|^2`` over all pairs of points, with
    transformed points x, is quadratic in the motions (v, w) of all views, which are solved for
    jointly; then points are paired again. It is one Gauss-Newton step of eq 2.8, the objective of
    GraphSLAM (Thrun and Montemerlo 2005).
    """

    def relax(self, poses: Float64, pairs: Sequence[Pairs], clouds: Sequence[Cloud]) -> Float64:
        """See `RelaxationMethod.relax`."""
        n = len(poses)
        H, g = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
        centroid = np.mean(
            [
                icp_kernels.transform_points(T, c.points).mean(0)
                for T, c in zip(poses, clouds, strict=True)
            ],
            0,
        )
        for p in pairs:
            a = icp_kernels.transform_points(poses[p.i], p.p_i) - centroid
            b = icp_kernels.transform_points(poses[p.j], p.p_j) - centroid
            A, B, r = se3.point_jacobian(a), se3.point_jacobian(b), a - b
            H[p.i, :, p.i] += np.einsum("nki,nkj->ij", A, A)
            H[p.j, :, p.j] += np.einsum("nki,nkj->ij", B, B)
            cross = np.einsum("nki,nkj->ij", A, B)
            H[p.i, :, p.j] -= cross
            H[p.j, :, p.i] -= cross.T
            g[p.i] += np.einsum("nki,nk->i", A, r)
            g[p.j] -= np.einsum("nki,nk->i", B, r)
        H[0, :, 0] += _GAUGE_WEIGHT * np.eye(6) * max(float(np.abs(H).max()), 1.0)
        step = -np.linalg.lstsq(H.reshape(6 * n, 6 * n), g.ravel(), rcond=1e-14)[0].reshape(n, 6)
        return np.asarray(se3.about(centroid, se3.exp(step)) @ poses)
