"""IMLS: points to an implicit moving-least-squares surface (Deschaud 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.icp import icp_kernels, interfaces, surface_metrics
from tofuse.engine.parts import part
from tofuse.lab.methods.neighbourhoods import neighbourhood, with_normals

# Cutoff of the weights in widths (exp(-9)).
_CUTOFF = 3.0


@part("metric", "imls", label="validated")
@dataclass(frozen=True)
class Implicit(Bounded, surface_metrics.SurfaceMetric):
    """Distances to the IMLS surface of the target's points (eq 1 of the paper).

    ``I(x) = sum W_i(x) (x - p_i) . n_i / sum W_i(x)`` with ``W_i(x) = exp(-|x - p_i|^2 / h^2)`` is
    the distance of x from the surface; its projection is ``y = x - I(x) n``, with n the normal of
    the closest target point, and the motion minimises ``sum (n . (R x + t - y))^2``. The target's
    noise is averaged over the width h, unlike in point-to-plane.

    Attributes
    ----------
    width
        h, in resolutions (the paper: 0.06 m with points some 0.05 m apart, rounded up here).
    """

    width: Annotated[float, Bounds(0, exclusive=True)] = 2.0

    def motion(self, matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
        """See `Metric.motion`."""
        pairs = surface_metrics.surface_pairs(matches, alignment)
        usable = with_normals(matches, alignment)
        distance = self.distance(alignment.transformed[usable.source], alignment)
        n = pairs.target_normals
        weight = np.where(np.isfinite(distance), pairs.weight, 0.0)
        H, g, _ = icp_kernels.plane_sums(pairs.points, n, n, np.nan_to_num(distance), weight)
        return pairs.motion(surface_metrics.solve(H, g, pairs.size))

    def distance(self, x: Float64, alignment: interfaces.Alignment) -> Float64:
        """I(x), (m,) in m, of points (m, 3) in the target's frame; NaN without neighbours."""
        target, h = alignment.target, self.width * alignment.resolution
        tree = neighbourhood(target).tree
        index, distance2 = tree.neighbours(x, min(target.neighbours, len(tree)))
        height = ((x[:, None] - target.points[index]) * target.normals[index]).sum(2)
        W = np.exp(-distance2 / h**2)
        W[(distance2 > (_CUTOFF * h) ** 2) | ~np.isfinite(height)] = 0.0
        total = W.sum(1)
        sums = (W * np.nan_to_num(height)).sum(1)
        return np.divide(sums, total, out=np.full(len(x), np.nan), where=total > 0)

    def fit(self, pairs: surface_metrics.SurfacePairs) -> tuple[Float64, float]:
        """See `SurfaceMetric.fit`: that of point-to-plane."""
        return surface_metrics.PointToPlane().fit(pairs)
