"""The symmetric objective of ICP (Rusinkiewicz 2019)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3, unit_vectors
from tofuse.engine.icp import icp_kernels, interfaces, surface_metrics
from tofuse.engine.parts import part


@part("metric", "symmetric", label="validated")
@dataclass(frozen=True)
class Symmetric(surface_metrics.SurfaceMetric):
    """Distances along the sum of both normals (Rusinkiewicz 2019).

    ``sum w_i ((R p_i - R^-1 q_i + t) . (n_pi + n_qi))^2``: each view gets half of the rotation. It
    is zero wherever two points and their normals are consistent with a circle, so that curved
    surfaces may slide, and has faster convergence and a larger basin than point-to-plane.

    Attributes
    ----------
    loss
        "square" as in the paper; "huber", "cauchy" or "tukey" downweight large residuals.
    """

    loss: surface_metrics.Loss = "square"

    def motion(self, matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
        """See `Metric.motion`; no motion along unconstrained directions."""
        pairs = surface_metrics.surface_pairs(matches, alignment, source=True)
        n = pairs.source_normals + pairs.target_normals
        r = (pairs.residual * n).sum(1)
        weight = pairs.weight * surface_metrics.loss_weights(self.loss, r, pairs.resolution)
        # p and q in the source's frame, centred between both.
        p = pairs.points
        q = p - pairs.residual
        centre = (p.mean(0) + q.mean(0)) / 2
        J = np.hstack([n, np.cross(p + q - 2 * centre, n)])
        # Not by BLAS, whose sums depend on the number of threads.
        H, g = np.einsum("k,ki,kj->ij", weight, J, J), np.einsum("k,ki->i", weight * r, J)
        x = surface_metrics.solve(H, g, 2 * pairs.size)
        tangent = float(np.linalg.norm(x[3:]))
        angle = math.atan(tangent)
        half = se3.pose(se3.so3_exp(x[3:] * (angle / tangent if tangent > 0 else 0.0)))
        motion = half @ se3.translation(x[:3] * math.cos(angle)) @ half
        T = pairs.T_target_source
        return T @ se3.about(pairs.centre + centre, motion) @ se3.inverse(T)

    def fit(self, pairs: surface_metrics.SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`: along the mean normal."""
        n = unit_vectors(pairs.source_normals + pairs.target_normals)
        r = (pairs.residual * n).sum(1)
        weight = pairs.weight * surface_metrics.loss_weights(self.loss, r, pairs.resolution)
        H, _, square = icp_kernels.plane_sums(pairs.points, n, n, r, weight)
        variance = surface_metrics.variance_of(square, weight, pairs.resolution)
        return H / variance, variance
