"""Simultaneous update of all views, each against all others (Bergevin et al. 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.icp import icp_kernels
from tofuse.engine.parts import part
from tofuse.lab.methods.multiview import Cloud, Pairs, RelaxationMethod

# Relative size below which eigenvalues are rounding errors.
_RANK = 1e-10


@part("refinement", "bergevin", label="validated")
@dataclass(frozen=True)
class Bergevin(RelaxationMethod):
    """Each round aligns each view with the tangent planes of all others at their previous poses.

    The views form a star about the first, which is fixed. The increments of all views are computed
    from the same poses and applied together, so that the order of the views does not matter and the
    error is distributed over all of them, not accumulated along a chain. Chen and Medioni's
    distance to the tangent plane, small angles.
    """

    def relax(self, poses: Float64, pairs: Sequence[Pairs], clouds: Sequence[Cloud]) -> Float64:
        """See `RelaxationMethod.relax`."""
        n = len(poses)
        H, g = np.zeros((n, 6, 6)), np.zeros((n, 6))
        centroids = np.array(
            [
                icp_kernels.transform_points(T, c.points).mean(0)
                for T, c in zip(poses, clouds, strict=True)
            ]
        )
        for p in pairs:
            x = icp_kernels.transform_points(poses[p.i], p.p_i)
            normal = p.n_j @ poses[p.j][:3, :3].T
            valid = np.isfinite(normal).all(1)
            r = ((x - icp_kernels.transform_points(poses[p.j], p.p_j)) * normal).sum(1)[valid]
            J = np.column_stack([normal, np.cross(x - centroids[p.i], normal)])[valid]
            H[p.i] += J.T @ J
            g[p.i] += J.T @ r
        out = poses.copy()
        for k in range(1, n):
            if H[k].any():
                step = -np.linalg.lstsq(H[k], g[k], rcond=_RANK)[0]
                out[k] = se3.about(centroids[k], se3.exp(step)) @ poses[k]
        return out
