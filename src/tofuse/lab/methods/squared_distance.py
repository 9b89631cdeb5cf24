"""Registration by squared distances (Pottmann, Leopoldseder and Hofer 2004)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.icp import icp_kernels, interfaces, surface_metrics
from tofuse.engine.parts import part
from tofuse.lab.methods.neighbourhoods import neighbourhood, with_normals


@part("metric", "squared-distance", label="validated")
@dataclass(frozen=True)
class SquaredDistance(surface_metrics.SurfaceMetric):
    """The squared distance to the target's surface, to second order in the motion.

    At distance d from a surface with radii of curvature rho_1 and rho_2, on its side, the squared
    distance is, in the principal frame of the foot point (section 2 of the paper)::

        F_d(x) = d / (d - rho_1) x_1^2 + d / (d - rho_2) x_2^2 + x_3^2

    where negative coefficients are set to zero, so that the sum has a minimum. Close to the surface
    this is the point-to-plane distance, far from it point-to-point. The velocity field c + c' x p
    that minimises the sum (instantaneous kinematics) is not a rigid motion, and is replaced by the
    helical motion with the same axis and pitch, through the angle atan |c'| (section 3).
    """

    def motion(self, matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
        """See `Metric.motion`."""
        pairs = surface_metrics.surface_pairs(matches, alignment)
        W = approximant(with_normals(matches, alignment), alignment)
        R = alignment.T_target_source[:3, :3]
        H, g, _ = icp_kernels.matrix_sums(
            pairs.points, pairs.residual, np.einsum("ji,njk,kl->nil", R, W, R), pairs.weight
        )
        velocity = surface_metrics.solve(H, g, pairs.size)
        speed = float(np.linalg.norm(velocity[3:]))
        return pairs.motion(velocity * (math.atan(speed) / speed) if speed > 0 else velocity)

    def fit(self, pairs: surface_metrics.SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`: at convergence the sum is that of point-to-plane."""
        return surface_metrics.PointToPlane().fit(pairs)


def approximant(matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
    """Return F_d of each pair as a matrix (m, 3, 3) in the target's frame.

    ``F_d(x) = (x - q)^T W (x - q)`` with q the target point and W the result.
    """
    j = matches.target
    principal = neighbourhood(alignment.target).principal_curvatures
    n = alignment.target.normals[j]
    d = ((alignment.transformed[matches.source] - alignment.target.points[j]) * n).sum(1)
    d_curvature = d[:, None] * principal.curvature[j]
    weight = np.divide(
        d_curvature, d_curvature - 1, out=np.zeros_like(d_curvature), where=d_curvature < 0
    )
    tangents = principal.directions[j]
    tangential: Float64 = np.einsum("nt,nti,ntj->nij", weight, tangents, tangents)
    return tangential + n[:, :, None] * n[:, None]
