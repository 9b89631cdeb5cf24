"""The Iterative Closest Point algorithm (Besl and McKay 1992), composed of exchangeable parts.

A `Remapping` keeps degenerate directions at the guess.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp_kernels import transform_points
from tofuse.engine.icp.icp_parts import (
    ClosestPoint,
    MaxDistance,
    PointToPoint,
    Random,
    TwoLoops,
    Unique,
    at_most,
)
from tofuse.engine.icp.interfaces import (
    Alignment,
    History,
    Matcher,
    Metric,
    Points,
    Rejector,
    Selector,
    Stopping,
)
from tofuse.engine.icp.surface_shape import NEIGHBOURS
from tofuse.engine.parts import part

_MIN_POINTS = 3


@dataclass(frozen=True, eq=False)
class Remapping:
    """Directions of the right perturbation along which a registration must not move.

    Attributes
    ----------
    directions
        (k, 6) about the source's origin, as in `Registration.unobservable`.
    centre
        (3,) centroid of the source's points, m.
    size
        Their rms distance from it, m, which scales angles to lengths.
    """

    directions: Float64
    centre: Float64
    size: float

    @classmethod
    def of(cls, directions: Float64, points: Float64) -> Remapping:
        """Fix `directions` (k, 6) of a source with points (n, 3)."""
        centre = points.mean(0)
        size = float(np.sqrt(((points - centre) ** 2).sum(1).mean()))
        return cls(directions, centre, size or 1.0)

    def along(self, T: Float64) -> Float64:
        """Return the component (4, 4) of a small motion T in the source's frame along them."""
        return self._project(T, along=True)

    def across(self, T: Float64) -> Float64:
        """Return the component (4, 4) of a small motion T in the source's frame across them."""
        return self._project(T, along=False)

    def _project(self, T: Float64, *, along: bool) -> Float64:
        T_centre_source = se3.translation(-self.centre)
        scale = np.array([1, 1, 1, self.size, self.size, self.size])
        scaled = (self.directions @ se3.adjoint(T_centre_source).T) * scale
        basis = np.linalg.svd(scaled, full_matrices=False)[2]
        xi = se3.log(se3.about(-self.centre, T)) * scale
        component = sum((b * float((b * xi).sum()) for b in basis), np.zeros(6))
        return se3.about(self.centre, se3.exp((component if along else xi - component) / scale))


@part("registration", "icp", label="validated")
@dataclass(frozen=True)
class Icp(Bounded, Registrar):
    """ICP: match, reject and move until the stopping rule is met.

    Attributes
    ----------
    resolution
        Typical distance between neighbouring points in m (res of the thesis): the unit of distances
        and of the error E.
    source, target
        Choose the points of each view, once for all iterations; the source's are drawn first.
    matcher
        Pairs points.
    rejectors
        Drop pairs, in this order.
    metric
        Computes the motion from the pairs.
    stopping
        Ends the iterations.
    neighbours
        Points of each plane fit, where a part needs normals, curvature or boundaries that the
        view doesn't have.
    """

    resolution: Annotated[float, Bounds(0, 1e9, exclusive=True)] = 0.01
    source: Selector = field(default_factory=Random)
    target: Selector = field(default_factory=Random)
    matcher: Matcher = field(default_factory=ClosestPoint)
    rejectors: tuple[Rejector, ...] = (MaxDistance(), Unique())
    metric: Metric = field(default_factory=PointToPoint)
    stopping: Stopping = field(default_factory=TwoLoops)
    neighbours: Annotated[int, Bounds(3)] = NEIGHBOURS

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: those of its matcher."""
        return self.matcher.takes

    def register(
        self,
        source: Frame,
        target: Frame,
        guess: Float64,
        rng: np.random.Generator,
        remapping: Remapping | None = None,
    ) -> Registration:
        """Register `source` into the frame of `target`, starting from `guess` (T_target_source).

        Number of correspondences, E and rms are those of the last matching, just before the last
        motion. If the iterations run out before the stopping rule is met, the result is the
        estimate so far with `converged` False. The directions of `remapping` are fixed.

        Raises
        ------
        RegistrationError
            If a view has fewer than three points, or if at some iteration the corresponding
            points don't determine a motion (for `PointToPoint`: fewer than three, or collinear).
        """
        data = self._select(self.source, source, rng)
        model = self._select(self.target, target, rng)
        search = self.matcher.prepare(model)
        reach = min((r.reach(self.resolution) for r in self.rejectors), default=math.inf)

        T = se3.orthonormalise(guess)
        transformed = transform_points(T, data.points)
        history = History()
        converged = False
        while not converged and len(history) < self.stopping.max_iterations:
            if self.source.each_iteration and len(history) > 0:
                data = self._select(self.source, source, rng)
                transformed = transform_points(T, data.points)
            if self.target.each_iteration and len(history) > 0:
                model = self._select(self.target, target, rng)
                search = self.matcher.prepare(model)
            alignment = Alignment(data, model, self.resolution, T, transformed)
            matches = search.match(alignment, reach)
            for rejector in self.rejectors:
                matches = rejector.reject(matches, alignment)
            previous = transformed
            motion = self.metric.motion(matches, alignment)
            T = (
                motion @ T
                if remapping is None
                else T @ remapping.across(se3.inverse(T) @ motion @ T)
            )
            # R^T is used as the inverse of R: without this, rounding errors grow with every
            # iteration.
            T = se3.orthonormalise(T)
            transformed = transform_points(T, data.points)
            history.correspondences.append(len(matches))
            history.errors.append(float(matches.distance.sum()) / (len(data) * self.resolution))
            step = math.sqrt(float(((transformed - previous) ** 2).sum()) / len(data))
            history.steps.append(step / self.resolution)
            converged = self.stopping.met(history)

        final = Alignment(data, model, self.resolution, T, transformed)
        return Registration(
            T_target_source=T,
            converged=converged,
            iterations=len(history),
            correspondences=len(matches),
            points=len(data),
            error=history.errors[-1],
            rms_m=math.sqrt(float((matches.distance**2).mean())),
            information=self.metric.information(matches, final),
            unobservable=self.metric.unobservable(matches, final),
            errors=tuple(history.errors),
        )

    def _select(self, selector: Selector, view: Frame, rng: np.random.Generator) -> Points:
        points = Points.of(view, selector.select(view, rng), self.neighbours)
        if len(points) < _MIN_POINTS:
            raise RegistrationError(
                f"has {quantities.count(len(points), 'point')}, {_MIN_POINTS} are needed",
                where=f"frame {view.index}",
            )
        return points


def algorithm_1(
    resolution: float = 0.01,
    points: int | None = 1000,
    epsilon: float = 1e-4,
    k: int = 3,
    max_iterations: int = 100,
) -> Icp:
    """Return Algorithm 1 of the thesis, "Pairwise ICP" (section 3.2).

    A random subset of `points` of each view (None: all points) is kept through all iterations.
    Each takes the closest points, drops pairs further apart than 2 res, keeps the shortest where
    several share a target point, and moves the source by Arun's solution. For the error

        E = sum(d_i) / (n_p res),

    d_i are the distances of the corresponding points and n_p is the number of selected points
    of the source.

    Parameters
    ----------
    resolution
        res, m (section 4.1: 0.01; 1 for the synthetic data).
    points
        Points of each view (section 3.3: 1000).
    epsilon, k
        Stop when E has changed by less than `epsilon` in `k` iterations in a row.
    max_iterations
        Of both loops together.
    """
    selector = at_most(points)
    return Icp(
        resolution,
        source=selector,
        target=selector,
        matcher=ClosestPoint(),
        rejectors=(MaxDistance(2.0), Unique()),
        metric=PointToPoint(),
        stopping=TwoLoops(epsilon, k, max_iterations),
    )
