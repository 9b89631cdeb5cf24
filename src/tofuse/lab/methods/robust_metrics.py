"""Robust least squares for pairs with many outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.icp import icp_kernels, icp_parts, interfaces, surface_metrics
from tofuse.engine.parts import part

# Factor of mu per round (Yang et al. 2020, remark 5).
_MU_FACTOR = 1.4
_MAX_ROUNDS = 100
# Truncation of the general loss, for a proper distribution (Chebrolu et al. 2021), in scales.
_TRUNCATION = 10.0


@part("metric", "gnc", label="validated")
@dataclass(frozen=True)
class Graduated(Bounded, interfaces.Metric):
    """Truncated least squares by graduated non-convexity (Yang, Antonante, Tzoumas, Carlone 2020).

    Pairs with a distance above c contribute c^2. As that sum has many minima, a convex surrogate is
    minimised first (mu small), and made less convex in each round, starting at the last solution:
    point-to-point with the weights of eq 14, ::

        w = 0                                   if r^2 >= (mu + 1) / mu c^2
            c / r sqrt(mu (mu + 1)) - mu        between
            1                                   if r^2 <= mu / (mu + 1) c^2

    It needs no initial inlier set and tolerates 70 to 80 % outliers.

    Attributes
    ----------
    inlier
        c: largest distance of an inlier, in resolutions.
    """

    inlier: Annotated[float, Bounds(0, exclusive=True)] = 2.0

    def motion(self, matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
        """See `Metric.motion`."""
        return self._solve(matches, alignment)[0]

    def information(self, matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
        """See `Metric.information`; of the inliers."""
        _, weighted = self._solve(matches, alignment)
        return icp_parts.PointToPoint().information(
            weighted.keep(weighted.weights() > 0), alignment
        )

    def _solve(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> tuple[Float64, interfaces.Matches]:
        c2 = (self.inlier * alignment.resolution) ** 2
        p = alignment.transformed[matches.source]
        q = alignment.target.points[matches.target]
        weights = matches.weights()
        weighted = replace(matches, weight=weights)
        motion = icp_parts.PointToPoint().motion(weighted, alignment)
        mu = 0.0
        for _ in range(_MAX_ROUNDS):
            r2 = ((icp_kernels.transform_points(motion, p) - q) ** 2).sum(1)
            if mu == 0:
                largest = float(r2.max())
                if largest <= c2:
                    break  # no pair is beyond c: plain least squares
                mu = c2 / (2 * largest - c2)
            w = np.sqrt(c2 / np.maximum(r2, 1e-300) * mu * (mu + 1)) - mu
            w = np.where(r2 >= (mu + 1) / mu * c2, 0.0, np.clip(w, 0.0, 1.0))
            weighted = replace(matches, weight=weights * w)
            motion = icp_parts.PointToPoint().motion(weighted, alignment)
            if np.all((w == 0) | (w == 1)):
                break
            mu *= _MU_FACTOR
        return motion, weighted


@part("metric", "adaptive", label="validated")
@dataclass(frozen=True)
class Adaptive(surface_metrics.TangentPlanes):
    """Point-to-plane with a loss whose shape is estimated from the residuals.

    The general loss of Barron (2019), ::

        rho(r) = |a - 2| / a ((r^2 / |a - 2| + 1)^(a / 2) - 1),    r in scales

    is that of least squares for a = 2, Cauchy for 0, Geman-McClure for -2, Welsch for minus
    infinity. The shape maximises the likelihood of the residuals, with the distribution truncated
    at ten scales so that it exists for negative shapes (Chebrolu et al. 2021).
    """

    def weights(self, residual: Float64, resolution: float) -> Float64:
        """See `TangentPlanes.weights`."""
        x = surface_metrics.in_scales(residual, resolution)
        a = estimate_shape(x)
        return np.asarray((x * x / abs(a - 2) + 1) ** (a / 2 - 1)) if a < 2 else np.ones(len(x))


def general_loss(x: Float64, shape: float) -> Float64:
    """rho of Barron (2019), eq 8, for residuals in scales."""
    if shape == 2:
        return x * x / 2
    if shape == 0:
        return np.log1p(x * x / 2)
    b = abs(shape - 2)
    return np.asarray(b / shape * ((x * x / b + 1) ** (shape / 2) - 1))


def estimate_shape(x: Float64) -> float:
    """Return the maximum-likelihood shape for residuals x (in scales)."""
    shapes, normalisers = _distributions()
    truncated = np.minimum(np.abs(x), _TRUNCATION)
    cost = [
        float(general_loss(truncated, float(a)).mean()) + float(z)
        for a, z in zip(shapes, normalisers, strict=True)
    ]
    return float(shapes[int(np.argmin(cost))])


@cache
def _distributions() -> tuple[Float64, Float64]:
    """Shapes, and the logarithm of the integral of exp(-rho) up to the truncation for each."""
    shapes = np.r_[np.arange(-10, -2, 1.0), np.arange(-2, 2.01, 0.25)]
    x = np.linspace(-_TRUNCATION, _TRUNCATION, 4001)
    step = x[1] - x[0]
    return shapes, np.array(
        [np.log(np.exp(-general_loss(x, float(a))).sum() * step) for a in shapes]
    )
