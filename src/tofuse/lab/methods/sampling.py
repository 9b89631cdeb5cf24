"""Selectors of the literature: the points of a view used by ICP (section 2.9.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.icp import icp_parts, interfaces, surface_shape
from tofuse.engine.parts import part


@part("selector", "random-each-iteration", label="validated")
@dataclass(frozen=True)
class RandomEachIteration(icp_parts.Random):
    """A random subset, redrawn at each iteration (Masuda, Sakaue and Yokoya 1996).

    Attributes
    ----------
    points
        Number of points; all of a view with fewer.
    """

    each_iteration: ClassVar[bool] = True


@part("selector", "voxel", label="validated")
@dataclass(frozen=True)
class Voxel(Bounded, interfaces.Selector):
    """The point closest to the centre of each voxel: uniform density on surfaces.

    Attributes
    ----------
    size
        Voxel size in m.
    """

    size: Annotated[float, Bounds(0, exclusive=True)] = 0.05

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`; draws nothing."""
        points = view.points.astype(np.float64) / self.size
        cell = np.floor(points)
        distance2 = ((points - cell - 0.5) ** 2).sum(1)
        order = np.lexsort((distance2, cell[:, 2], cell[:, 1], cell[:, 0]))
        cell = cell[order]
        first = np.ones(len(order), bool)
        first[1:] = (cell[1:] != cell[:-1]).any(1)
        return np.sort(order[first])


@part("selector", "normal-space", label="validated")
@dataclass(frozen=True)
class NormalSpace(Bounded, interfaces.Selector):
    """Normal-space sampling (Rusinkiewicz and Levoy 2001).

    Points are binned by normal direction and drawn at random from the bins in turn, so that small
    features with rare normals are not outweighed by large flat surfaces. Points without a normal
    are excluded.

    Attributes
    ----------
    points
        Number of points.
    buckets
        Number along each side of a cube map's faces, 6 buckets^2 in total.
    neighbours
        Points per plane fit, if the view has no normals.
    """

    points: Annotated[int, Bounds(1)] = 1000
    buckets: Annotated[int, Bounds(1)] = 8
    neighbours: Annotated[int, Bounds(3)] = surface_shape.NEIGHBOURS

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`."""
        normals = surface_shape.normals_at(view, np.arange(len(view)), self.neighbours)
        valid = np.flatnonzero(np.isfinite(normals).all(1))
        if len(valid) <= self.points:
            return valid
        order = rng.permutation(len(valid))
        bucket = _bucket(normals[valid[order]], self.buckets)
        # The k-th draw from every bucket comes before the (k + 1)-th from any.
        by_bucket = np.argsort(bucket, kind="stable")
        counts = np.bincount(bucket)
        starts = np.cumsum(counts) - counts
        rank = np.empty(len(valid), np.int64)
        rank[by_bucket] = np.arange(len(valid)) - np.repeat(starts, counts)
        selected = np.argsort(rank, kind="stable")[: self.points]
        return np.sort(valid[order[selected]])


def _bucket(normals: Float64, side: int) -> Int64:
    """Cell (n,) of a cube map with side^2 cells on each face."""
    n = np.arange(len(normals))
    axis = np.abs(normals).argmax(1)
    height = normals[n, axis]
    # Uniform in angle, not in its tangent.
    u = np.arctan(normals[n, (axis + 1) % 3] / np.abs(height)) / (np.pi / 2) + 0.5
    v = np.arctan(normals[n, (axis + 2) % 3] / np.abs(height)) / (np.pi / 2) + 0.5
    i = np.clip((u * side).astype(np.int64), 0, side - 1)
    j = np.clip((v * side).astype(np.int64), 0, side - 1)
    return ((2 * axis + (height > 0)) * side + i) * side + j


@part("selector", "intensity-gradient", label="validated")
@dataclass(frozen=True)
class IntensityGradient(Bounded, interfaces.Selector):
    """The points of largest amplitude gradient (Weik 1997).

    The gradient of the logarithmic amplitude is taken between a pixel's neighbours, all of which
    must be valid. Needs a range image with amplitude.

    Attributes
    ----------
    points
        Number of points.
    """

    points: Annotated[int, Bounds(1)] = 1000

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`; draws nothing.

        Raises
        ------
        RegistrationError
            If the view has no camera or no amplitude.
        """
        if not isinstance(view, RangeFrame) or view.amplitude_image is None:
            raise RegistrationError(
                "has no amplitude image, by whose gradient points are chosen",
                where=f"frame {view.index}",
                remedy="use the selector 'random'",
            )
        valid = view.valid & (view.amplitude_image > 0)
        image = np.where(valid, np.log(np.where(valid, view.amplitude_image, 1)), np.nan)
        gradient = np.zeros(image.shape)
        gradient[1:-1, 1:-1] = np.hypot(
            image[1:-1, 2:] - image[1:-1, :-2], image[2:, 1:-1] - image[:-2, 1:-1]
        )
        strength = np.nan_to_num(gradient[view.valid], nan=0.0)
        order = np.argsort(-strength, kind="stable")[: self.points]
        return np.sort(order[strength[order] > 0])
