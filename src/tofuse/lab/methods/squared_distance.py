"""Registration by squared distances (Pottmann, Leopoldseder and Hofer 2004)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.kernels.cloud_sums import matrix_sums
from tofuse.lab.methods.neighbourhoods import neighbourhood, with_normals
from tofuse.parts import part
from tofuse.registration.interfaces import Alignment, Matches
from tofuse.registration.pairs import SurfacePairs, solve, surface_pairs
from tofuse.registration.surface_metrics import PointToPlane, SurfaceMetric


@part("metric", "squared-distance", label="validated")
@dataclass(frozen=True)
class SquaredDistance(SurfaceMetric):
    """The squared distance to the target's surface, to second order in the motion.

    At distance d from a surface with radii of curvature rho_1 and rho_2, on its side, the squared
    distance is, in the principal frame of the foot point (section 2 of the paper)::

        F_d(x) = d / (d - rho_1) x_1^2 + d / (d - rho_2) x_2^2 + x_3^2

    where coefficients below zero are set to zero, so that the sum has a minimum. On the surface
    only the distance to the tangent plane is left, as in point-to-plane; far from it all three
    count, as in point-to-point. Points move by the field of velocities c + c' x p that makes the
    sum least (instantaneous kinematics), and then by the helical motion with the same axis and
    pitch, through the angle atan |c'|, as the field is no rigid motion (section 3).
    """

    def motion(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.motion`."""
        pairs = surface_pairs(matches, alignment)
        kept = with_normals(matches, alignment)
        W = approximant(kept, alignment)
        turn = alignment.T_target_source[:3, :3]
        H, g, _ = matrix_sums(
            pairs.points, pairs.residual, np.einsum("ji,njk,kl->nil", turn, W, turn), pairs.weight
        )
        field = solve(H, g, pairs.size)
        speed = float(np.linalg.norm(field[3:]))
        return pairs.motion(field * (math.atan(speed) / speed) if speed > 0 else field)

    def fit(self, pairs: SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`: at the end the sum is that of point-to-plane."""
        return PointToPlane().fit(pairs)


def approximant(matches: Matches, alignment: Alignment) -> Float64:
    """Return F_d of each pair as a matrix (m, 3, 3) in the target's frame.

    ``F_d(x) = (x - q)^T W (x - q)`` with q the target point.
    """
    j = matches.target
    bending = neighbourhood(alignment.target).bending
    n = alignment.target.normals[j]
    d = ((alignment.moved[matches.source] - alignment.target.points[j]) * n).sum(1)
    bent = d[:, None] * bending.curvature[j]
    share = np.divide(bent, bent - 1, out=np.zeros_like(bent), where=bent < 0)
    tangents = bending.directions[j]
    along: Float64 = np.einsum("nt,nti,ntj->nij", share, tangents, tangents)
    return along + n[:, :, None] * n[:, None]
