"""Error metrics with normals: point-to-plane, plane-to-plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.icp.icp_kernels import matrix_sums, plane_sums, plane_to_plane_weights
from tofuse.engine.icp.interfaces import Alignment, Matches, Metric
from tofuse.engine.icp.point_pairs import (
    Loss,
    SurfacePairs,
    loss_weights,
    shared_weights,
    solve,
    surface_pairs,
    unobservable_directions,
    variance_of,
)
from tofuse.engine.parts import part


class SurfaceMetric(Metric, Protocol):
    """Base of the metrics with normals."""

    def fit(self, pairs: SurfacePairs) -> tuple[Float64, float]:
        """Return the information (6, 6) about the pairs' centre, and the variance in m^2."""
        ...

    def information(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.information`; sigma is estimated from the residuals.

        Pairs with the same target point share its noise and count less.
        """
        pairs = _independent_pairs(matches, alignment)
        return pairs.to_origin(self.fit(pairs)[0])

    def unobservable(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.unobservable`."""
        pairs = _independent_pairs(matches, alignment)
        return unobservable_directions(pairs, self.fit(pairs)[1])


def _independent_pairs(matches: Matches, alignment: Alignment) -> SurfacePairs:
    weight = matches.weights() * shared_weights(matches, alignment)
    return surface_pairs(replace(matches, weight=weight), alignment, source=True)


class TangentPlanes(SurfaceMetric, Protocol):
    """Squared distances to the target's tangent planes, with weights defined by the metric.

    One Gauss-Newton step on SE(3) is made for each matching.
    """

    def weights(self, residual: Float64, resolution: float) -> Float64:
        """Return the weights (m,) of residuals (m,) in m."""
        ...

    def motion(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.motion`; no motion along directions that no plane constrains."""
        pairs = surface_pairs(matches, alignment)
        r, weight = self._weigh(pairs)
        n = pairs.target_normals
        H, g, _ = plane_sums(pairs.points, n, n, r, weight)
        return pairs.motion(solve(H, g, pairs.size))

    def fit(self, pairs: SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`."""
        n = pairs.target_normals
        r, weight = self._weigh(pairs)
        H, _, square = plane_sums(pairs.points, n, n, r, weight)
        variance = variance_of(square, weight, pairs.resolution)
        return H / variance, variance

    def _weigh(self, pairs: SurfacePairs) -> tuple[Float64, Float64]:
        r: Float64 = (pairs.residual * pairs.target_normals).sum(1)
        return r, pairs.weight * self.weights(r, pairs.resolution)


@part("metric", "point-to-plane", label="validated")
@dataclass(frozen=True)
class PointToPlane(TangentPlanes):
    """Distances from the source's points to the target's tangent planes (Chen and Medioni 1992).

    ``sum w_i ((T d_i - m_i) . n_i)^2``, see `TangentPlanes`.

    Attributes
    ----------
    loss
        "square" as in the paper; "huber", "cauchy" or "tukey" count large residuals less.
    """

    loss: Loss = "square"

    def weights(self, residual: Float64, resolution: float) -> Float64:
        """See `TangentPlanes.weights`."""
        return loss_weights(self.loss, residual, resolution)


@part("metric", "gicp", label="validated")
@dataclass(frozen=True)
class PlaneToPlane(Bounded, SurfaceMetric):
    """Generalised ICP (Segal, Haehnel and Thrun 2009), plane to plane.

    ``sum r_i^T (C_qi + R C_pi R^T)^-1 r_i``, r_i = T p_i - q_i: each point stands for a disc of
    its surface, with variance 1 along it and `epsilon` across. One Gauss-Newton step is made for
    each matching.

    Attributes
    ----------
    epsilon
        Variance across the surface relative to that along it (section III of the paper: 0.001).
    loss
        "square" as in the paper; "huber", "cauchy" or "tukey" count large residuals less.
    """

    epsilon: Annotated[float, Bounds(1e-9, 1)] = 1e-3
    loss: Loss = "square"

    def motion(self, matches: Matches, alignment: Alignment) -> Float64:
        """See `Metric.motion`."""
        pairs = surface_pairs(matches, alignment, source=True)
        W, weight = self._weigh(pairs)
        H, g, _ = matrix_sums(pairs.points, pairs.residual, W, weight)
        return pairs.motion(solve(H, g, pairs.size))

    def fit(self, pairs: SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`; the variance is that across the surface."""
        W, weight = self._weigh(pairs)
        H, _, square = matrix_sums(pairs.points, pairs.residual, W, weight)
        variance = variance_of(square, weight, pairs.resolution)
        return H / variance, variance

    def _weigh(self, pairs: SurfacePairs) -> tuple[Float64, Float64]:
        """Return W (m, 3, 3), normalised to 1 across two parallel discs, and the weights (m,)."""
        W = (
            2
            * self.epsilon
            * plane_to_plane_weights(pairs.target_normals, pairs.source_normals, self.epsilon)
        )
        square = np.einsum("ki,kij,kj->k", pairs.residual, W, pairs.residual)
        size = np.sqrt(np.maximum(square, 0))
        return W, pairs.weight * loss_weights(self.loss, size, pairs.resolution)
