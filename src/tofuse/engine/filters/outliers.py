"""Filters of outliers: points far from their neighbours in space, or at jump edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.cameras import unknown_rays
from tofuse.engine.compute import run_chunks
from tofuse.engine.filters.base import Filter
from tofuse.engine.filters.neighbourhood_kernels import is_steeper
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.geometry import KdTree
from tofuse.engine.parts import part

# Upper limit of k, which bounds the memory.
MAX_NEIGHBOURS = 1000


@part("filter", "neighbour_fraction")
@dataclass(frozen=True)
class NeighbourFraction(Bounded, Filter):
    """Remove a fraction of the points: those with the largest mean distance to their neighbours.

    Chapter 4 removes half of them, with 3 neighbours. Of equal distances later points are removed
    first.

    Attributes
    ----------
    fraction
        Fraction of the points to remove, 0 to 1, rounded down to whole points.
    k
        Number of neighbours.
    """

    fraction: Annotated[float, Bounds(0, 1)] = 0.5
    k: Annotated[int, Bounds(1, MAX_NEIGHBOURS)] = 3

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        distance = mean_neighbour_distance(frame.points, self.k)
        # The small addition keeps 0.29 of 100 points at 29.
        kept = len(distance) - int(self.fraction * len(distance) + 1e-6)
        keep = np.zeros(len(distance), bool)
        keep[np.argsort(distance, kind="stable")[:kept]] = True
        mask = np.zeros(frame.valid.shape, bool)
        mask[frame.valid] = keep
        return mask


def mean_neighbour_distance(points: Float32, k: int) -> Float64:
    """Return the mean distance (N,) in m of points (N, 3) to their k nearest neighbours.

    If there are fewer than k other points, all are used; it is infinite for a single point.
    """
    n = len(points)
    if n < 2:
        return np.full(n, np.inf)
    k = min(k, n - 1)
    # The nearest neighbour is the point itself, or a duplicate of it, at distance 0.
    _, squares = KdTree(points).neighbours(points, k + 1)
    return np.sqrt(squares[:, 1:]).mean(1)


@part("filter", "neighbourhood_angle", label="validated")
@dataclass(frozen=True)
class NeighbourhoodAngle(Bounded, Filter):
    """Remove points at jump edges by the neighbourhood angle (eq 2.6; May et al. 2009).

    A flying pixel, or a point on the rim of the foreground, has a neighbour far behind it along
    nearly the same ray, so the angle at the point between the camera and that neighbour approaches
    180 degrees. On a surface seen at grazing angle g (0 when seen edge on) it is at most about 180
    degrees - g, so the threshold sets the largest tilt that is kept. A background point next to an
    edge has a neighbour in front of it (an angle near 0) and is kept. Noise has the same effect if
    it exceeds, at 170 degrees, 5.7 times the spacing of neighbours: on a camera as coarse and noisy
    as the SR4000 half of the points are removed, so this filter belongs after one by confidence.

    Attributes
    ----------
    threshold
        Largest angle that is kept, rad; raise it to keep surfaces seen at grazing angles.
    """

    threshold: Annotated[float, Bounds(math.pi / 2, math.pi)] = math.radians(170)

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        assert isinstance(frame, RangeFrame)
        steep = np.zeros(frame.depth.shape, bool)
        if self.threshold < math.pi:
            z = frame.z
            if unknown_rays(frame.camera) is not None:
                z = np.where(frame.valid, z, np.float32(0))
            rays, cosine2 = frame.camera.rays(), np.float32(math.cos(self.threshold) ** 2)
            run_chunks(lambda a, b: is_steeper(z, rays, cosine2, a, b, steep), len(z))
        return np.logical_not(steep, out=steep)
