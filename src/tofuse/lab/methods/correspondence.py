"""Matchers of the literature: normal shooting, projection, features (section 2.9.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.bounds import Bounded, Bounds, NotEmpty
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import icp_kernels, interfaces
from tofuse.engine.parts import part
from tofuse.lab.methods.cloud_search_kernels import grid_search
from tofuse.lab.methods.featured_tree import FeaturedKdTree
from tofuse.lab.methods.neighbourhoods import mean_curvature

Invariant = Literal["curvature", "moments"]

# Min cosine of the angle between the line and the normal; more grazing lines are rejected.
_MIN_COSINE = 0.1


@part("matcher", "normal-shooting", label="validated")
@dataclass(frozen=True)
class NormalShooting(Bounded, interfaces.Matcher):
    """Intersection of a source point's normal with the target's surface (Chen and Medioni 1992).

    The surface is sampled, so the intersection is iterated as in the paper: the line is intersected
    with the tangent plane of the closest target point, then with that of the point closest to the
    intersection, and so on. The target point closest to the last intersection is returned.

    Attributes
    ----------
    steps
        Number of iterations.
    """

    steps: Annotated[int, Bounds(1)] = 3

    def prepare(self, target: interfaces.Points) -> interfaces.Search:
        """Build the tree, once for all iterations."""
        return _NormalSearch(KdTree(target.points), self.steps)


@dataclass(frozen=True, eq=False)
class _NormalSearch:
    tree: KdTree
    steps: int

    def match(self, alignment: interfaces.Alignment, reach: float) -> interfaces.Matches:
        start, target = alignment.transformed, alignment.target
        rotation = se3.pose(alignment.T_target_source[:3, :3])
        directions = icp_kernels.transform_points(rotation, alignment.source.normals)
        intersection = start
        index, _ = self.tree.nearest(intersection, reach)
        for _ in range(self.steps):
            clamped = np.maximum(index, 0)
            n = target.normals[clamped]
            cosine = (directions * n).sum(1)
            intersects = (index >= 0) & (np.abs(cosine) > _MIN_COSINE)
            cosine = np.where(intersects, cosine, 1.0)
            t = ((target.points[clamped] - start) * n).sum(1) / cosine
            intersection = np.where(intersects[:, None], start + t[:, None] * directions, np.nan)
            index, _ = self.tree.nearest(intersection, reach)
        source = np.flatnonzero(index >= 0)
        index = index[source]
        difference = start[source] - target.points[index]
        distance = np.sqrt((difference * difference).sum(1))
        return interfaces.Matches(source, index, distance).keep(distance <= reach)


@part("matcher", "projection", label="validated")
@dataclass(frozen=True)
class Projection(interfaces.Matcher):
    """The target point on the pixel to which a source point projects ("reverse calibration").

    Blais and Levine (1995). Needs a target with a camera, best with all of its points.
    """

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def prepare(self, target: interfaces.Points) -> interfaces.Search:
        """Index the target's points by pixel."""
        return _GridSearch(*_grid(target), 0)


@part("matcher", "projection-search", label="validated")
@dataclass(frozen=True)
class ProjectionSearch(Bounded, interfaces.Matcher):
    """The closest point around the pixel to which a source point projects (section 2.9.3).

    The search continues around the closest point within `radius` until none is closer. Needs a
    target with a camera.

    Attributes
    ----------
    radius
        Pixels.
    """

    radius: Annotated[int, Bounds(1)] = 2
    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def prepare(self, target: interfaces.Points) -> interfaces.Search:
        """Index the target's points by pixel."""
        return _GridSearch(*_grid(target), self.radius)


def _grid(target: interfaces.Points) -> tuple[RangeFrame, Int64]:
    view = target.view
    if not isinstance(view, RangeFrame):
        raise RegistrationError(
            "is a cloud without a camera: points can't be projected into it",
            where=f"frame {view.index}",
            remedy="use the matcher 'closest-point'",
        )
    grid = np.full(view.valid.shape, -1, np.int64)
    grid.ravel()[np.flatnonzero(view.valid)[target.index]] = np.arange(len(target))
    return view, grid


@dataclass(frozen=True, eq=False)
class _GridSearch:
    view: RangeFrame
    grid: Int64
    radius: int

    def match(self, alignment: interfaces.Alignment, reach: float) -> interfaces.Matches:
        transformed = alignment.transformed
        pixels = np.ascontiguousarray(self.view.camera.project(transformed))
        index = np.empty(len(transformed), np.int64)
        distance2 = np.empty(len(transformed))
        grid_search(
            self.grid, alignment.target.points, transformed, pixels, self.radius, index, distance2
        )
        source = np.flatnonzero(distance2 <= reach * reach)
        return interfaces.Matches(source, index[source], np.sqrt(distance2[source]))


@part("matcher", "closest-compatible", label="validated")
@dataclass(frozen=True)
class ClosestCompatible(Bounded, interfaces.Matcher):
    """The closest target point of similar amplitude (ICCP: Godin, Rioux and Baribeau 1994).

    Points are compatible if their amplitudes differ by less than a factor. The search skips
    incompatible points, where a rejector would drop the pair.

    Attributes
    ----------
    ratio
        Largest ratio of two compatible amplitudes, more than 1.
    """

    ratio: Annotated[float, Bounds(1, exclusive=True)] = 1.2

    def prepare(self, target: interfaces.Points) -> interfaces.Search:
        """Build the tree, once for all iterations."""
        return _CompatibleSearch(
            FeaturedKdTree(target.points), _log_amplitude(target), float(np.log(self.ratio))
        )


@dataclass(frozen=True, eq=False)
class _CompatibleSearch:
    tree: FeaturedKdTree
    features: Float64
    tolerance: float

    def match(self, alignment: interfaces.Alignment, reach: float) -> interfaces.Matches:
        # Amplitudes select candidates; among these only the distance in space counts.
        source_features = _log_amplitude(alignment.source)
        index, distance2 = self.tree.nearest_featured(
            alignment.transformed, self.features, source_features, self.tolerance, reach, 0.0
        )
        source = np.flatnonzero(index >= 0)
        return interfaces.Matches(source, index[source], np.sqrt(distance2[source]))


def _log_amplitude(points: interfaces.Points) -> Float64:
    """(n, 1) logarithm of the amplitude; NaN, which never matches, where missing."""
    amplitude = points.amplitude
    return np.log(np.where(amplitude > 0, amplitude, np.nan))[:, None]


@part("matcher", "closest-invariant", label="validated")
@dataclass(frozen=True)
class ClosestInvariant(Bounded, interfaces.Matcher):
    """The target point closest in space and in invariant features (ICPIF: Sharp et al. 2002).

    Minimises ``|p - q|^2 + sum (a_k (f_k - g_k))^2``. The features are pose-invariant: mean
    curvature, or the three eigenvalues of the second moments of the surface in a ball (whose
    symmetric functions are the paper's moment invariants J1 to J3). They are scaled by their mean
    absolute deviation over the target, and their weight is in resolutions.

    Attributes
    ----------
    features
        Any of "curvature", "moments".
    weight
        Distance, in resolutions, equivalent to one mean absolute deviation of a feature.
    radius
        Radius of the ball for moments, in resolutions.
    """

    features: Annotated[tuple[Invariant, ...], NotEmpty()] = ("moments",)
    weight: Annotated[float, Bounds(0, exclusive=True)] = 20.0
    radius: Annotated[float, Bounds(0, exclusive=True)] = 6.0

    def prepare(self, target: interfaces.Points) -> interfaces.Search:
        """Build the tree, once for all iterations."""
        return _InvariantSearch(self, FeaturedKdTree(target.points), {})


@dataclass(frozen=True, eq=False)
class _InvariantSearch:
    options: ClosestInvariant
    tree: FeaturedKdTree
    # Features of both views, cached at the first matching; the source's by its identity.
    cache: dict[str, tuple[interfaces.Points, Float64]]

    def match(self, alignment: interfaces.Alignment, reach: float) -> interfaces.Matches:
        target_features = self._features("target", alignment.target, alignment.resolution)
        source_features = self._features("source", alignment.source, alignment.resolution)
        deviation = np.array([_mean_deviation(column) for column in target_features.T])
        scale = (
            self.options.weight
            * alignment.resolution
            / (deviation * np.sqrt(target_features.shape[1]))
        )
        index, distance2 = self.tree.nearest_featured(
            alignment.transformed, target_features * scale, source_features * scale, np.inf, reach
        )
        source = np.flatnonzero(index >= 0)
        return interfaces.Matches(source, index[source], np.sqrt(distance2[source]))

    def _features(self, role: str, points: interfaces.Points, resolution: float) -> Float64:
        if role in self.cache and self.cache[role][0] is points:
            return self.cache[role][1]
        columns = []
        for feature in self.options.features:
            if feature == "curvature":
                columns.append(mean_curvature(points)[:, None] * resolution)
            else:
                radius = self.options.radius * resolution
                moments = FeaturedKdTree(points.view.points).moments(points.points, radius)
                columns.append(moments / radius**2)
        self.cache[role] = (points, np.concatenate(columns, 1))
        return self.cache[role][1]


def _mean_deviation(column: Float64) -> float:
    """Mean absolute deviation from the median, ignoring NaN; 1 if it is zero."""
    column = column[np.isfinite(column)]
    deviation = float(np.abs(column - np.median(column)).mean()) if len(column) else 0.0
    return deviation or 1.0
