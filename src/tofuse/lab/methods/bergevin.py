"""Views moved side by side, each against all others (Bergevin et al. 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.kernels.icp import transform_points
from tofuse.lab.methods.multiview import Cloud, Pairs, Relaxing
from tofuse.parts import part

# Relative size of eigenvalues that are rounding errors.
_RANK = 1e-10


@part("refinement", "bergevin", label="validated")
@dataclass(frozen=True)
class Bergevin(Relaxing):
    """In each round each view moves to the tangent planes of all others, where these were before.

    The views form a star about the first, which stays. The increments of all views are worked
    out from the same poses and applied together, so that no order of the views is preferred and
    the error is spread over all of them, not heaped up at the end of a chain. Chen and Medioni's
    distance to the tangent plane, small angles.
    """

    def relax(self, poses: Float64, pairs: Sequence[Pairs], clouds: Sequence[Cloud]) -> Float64:
        """See `Relaxing.relax`."""
        n = len(poses)
        H, g = np.zeros((n, 6, 6)), np.zeros((n, 6))
        middle = np.array(
            [transform_points(T, c.points).mean(0) for T, c in zip(poses, clouds, strict=True)]
        )
        for p in pairs:
            x = transform_points(poses[p.i], p.p_i)
            normal = p.n_j @ poses[p.j][:3, :3].T
            known = np.isfinite(normal).all(1)
            r = ((x - transform_points(poses[p.j], p.p_j)) * normal).sum(1)[known]
            J = np.column_stack([normal, np.cross(x - middle[p.i], normal)])[known]
            H[p.i] += J.T @ J
            g[p.i] += J.T @ r
        out = poses.copy()
        for k in range(1, n):
            if H[k].any():
                step = -np.linalg.lstsq(H[k], g[k], rcond=_RANK)[0]
                out[k] = se3.about(middle[k], se3.exp(step)) @ poses[k]
        return out
