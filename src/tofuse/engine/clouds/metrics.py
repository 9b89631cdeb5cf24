"""The point-to-point error metric (section 2.9.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.clouds.icp_kernels import point_information, weighted_moments
from tofuse.engine.clouds.interfaces import Alignment, Matches, Metric
from tofuse.engine.errors import RegistrationError
from tofuse.engine.parts import part

# Relative second singular values below this are rounding errors: the points are collinear.
_RANK_TOLERANCE = 1e-12
_ROUNDING = 1e-14
# Lower limit of the residuals' sigma, as a fraction of the resolution.
_MIN_SIGMA_RATIO = 1e-3


@part("metric", "point-to-point", label="validated")
@dataclass(frozen=True)
class PointToPoint(Metric):
    """Sum of squared distances of the pairs, ``sum w_i |m_i - (R d_i + t)|^2`` (eq 2.7).

    The minimum is found in one step (Arun, Huang and Blostein 1987): with the centroids ``m0``,
    ``d0`` and ``H = sum w_i (d_i - d0) (m_i - m0)^T = U S V^T``,

        R = V diag(1, 1, det(V U^T)) U^T,    t = m0 - R d0.

    The determinant (Umeyama 1991) keeps R from being a reflection, which is otherwise the best
    fit where points are few, planar or very noisy.
    """

    def motion(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.motion`.

        Raises
        ------
        RegistrationError
            If there are fewer than three pairs or their points lie on a line.
        """
        if len(matches) < 3:
            raise RegistrationError(
                f"only {len(matches)} points of the views correspond, 3 are needed"
            )
        d0, m0, H, size = weighted_moments(
            alignment.transformed,
            alignment.target.points,
            matches.source,
            matches.target,
            matches.weights(),
        )
        U, S, Vt = np.linalg.svd(H)
        if S[1] <= max(_RANK_TOLERANCE * S[0], _ROUNDING * size):
            raise RegistrationError("the corresponding points lie on a line")
        if np.linalg.det(U) * np.linalg.det(Vt) < 0:
            Vt[2] *= -1
        T = np.eye(4)
        T[:3, :3] = (U @ Vt).T
        T[:3, 3] = m0 - T[:3, :3] @ d0
        return T

    def information(self, matches: Matches, alignment: Alignment) -> Float64:
        """Return ``sum w J^T J / sigma^2`` with ``J = R [I, -hat(p)]``, p in the source's frame.

        ``J`` is the derivative of ``T exp(xi) p``; R cancels. sigma is estimated from the
        residuals, ``sigma^2 = sum w |r|^2 / (3 m - 6)`` (m^2, along each axis), and is at least a
        thousandth of the resolution.

        It assumes that the points of each pair are the same point of the scene. Closest points are
        not, so it is optimistic, above all along a surface: it does not reveal that a flat wall is
        degenerate.
        """
        weight = matches.weights()
        residual = alignment.transformed[matches.source] - alignment.target.points[matches.target]
        degrees_of_freedom = max(3 * len(matches) - 6, 1)
        variance = float((weight[:, None] * residual * residual).sum()) / degrees_of_freedom
        variance = max(variance, (_MIN_SIGMA_RATIO * alignment.resolution) ** 2)
        return point_information(alignment.source.points, matches.source, weight) / variance
