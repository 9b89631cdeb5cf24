"""The common parts of ICP, in the order in which an iteration uses them.

Selectors choose the points of a view (section 2.9.2), a matcher pairs them by a kd-tree (2.9.3),
rejectors drop pairs (2.9.4), the point-to-point metric gives the motion, and a stopping rule ends
the iterations. Metrics with normals are in `surface_metrics`, rarer parts in the laboratory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import icp_kernels, interfaces, surface_shape
from tofuse.engine.parts import part

# Relative second singular values below this are rounding errors: the points are collinear.
_RANK_TOLERANCE = 1e-12
_ROUNDING = 1e-14
# Lower limit of the residuals' sigma, as a fraction of the resolution.
_MIN_SIGMA_RATIO = 1e-3
# Relative difference of E up to which iterations repeat.
_REPETITION_TOLERANCE = 1e-6


@part("selector", "all", label="validated")
@dataclass(frozen=True)
class All(interfaces.Selector):
    """Every valid point."""

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`; draws nothing."""
        return np.arange(len(view), dtype=np.int64)


@part("selector", "random", label="validated")
@dataclass(frozen=True)
class Random(Bounded, interfaces.Selector):
    """A random subset, each point as likely as any other (section 3.3).

    Attributes
    ----------
    points
        Number of points; all points of a view with fewer.
    """

    points: Annotated[int, Bounds(1)] = 1000

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`."""
        size = len(view)
        if size <= self.points:
            return np.arange(size, dtype=np.int64)
        drawn = rng.choice(size, self.points, replace=False, shuffle=False)
        return np.sort(drawn.astype(np.int64))


def at_most(points: int | None) -> interfaces.Selector:
    """Return the selector of `points` random points, or of all points for None."""
    return All() if points is None else Random(points)


@part("selector", "uniform", label="validated")
@dataclass(frozen=True)
class Uniform(Bounded, interfaces.Selector):
    """Every k-th point (Turk and Levoy 1994): evenly spread over the pixels of a range image.

    Attributes
    ----------
    points
        k is the largest whole number that leaves this many points, or 1.
    """

    points: Annotated[int, Bounds(1)] = 1000

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """See `Selector.select`; draws nothing."""
        return np.arange(0, len(view), max(1, len(view) // self.points), dtype=np.int64)


@part("matcher", "closest-point", label="validated")
@dataclass(frozen=True)
class ClosestPoint(interfaces.Matcher):
    """The closest point of the target (Besl and McKay 1992), by a kd-tree (section 2.9.5)."""

    def prepare(self, target: interfaces.Points) -> interfaces.Search:
        """Build the tree, once for all iterations: the target doesn't move.

        The tree of a full view is shared by all registrations against it.
        """
        view = target.view
        is_full_view = len(target) == len(view) and bool((np.diff(target.index) == 1).all())
        return _TreeSearch(surface_shape.tree_of(view) if is_full_view else KdTree(target.points))


@dataclass(frozen=True, eq=False)
class _TreeSearch:
    tree: KdTree

    def match(self, alignment: interfaces.Alignment, reach: float) -> interfaces.Matches:
        index, squared = self.tree.nearest(alignment.transformed, reach)
        source = np.flatnonzero(index >= 0)
        return interfaces.Matches(source, index[source], np.sqrt(squared[source]))


@part("rejector", "max-distance", label="validated")
@dataclass(frozen=True)
class MaxDistance(Bounded, interfaces.Rejector):
    """Drops pairs further apart than ``tau = factor * res`` (section 3.2: 2 res).

    Attributes
    ----------
    factor
        In resolutions.
    """

    factor: Annotated[float, Bounds(0, exclusive=True)] = 2.0

    def reach(self, resolution: float) -> float:
        """See `Rejector.reach`."""
        return self.factor * resolution

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        return matches.keep(matches.distance <= self.reach(alignment.resolution))


@part("rejector", "same-side")
@dataclass(frozen=True)
class SameSide(interfaces.Rejector):
    """Drops pairs whose normals point to opposite sides, as those of the two sides of a wall.

    Only for views that were seen from their origins.
    """

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        normals = alignment.source.normals[matches.source] @ alignment.T_target_source[:3, :3].T
        opposite = (normals * alignment.target.normals[matches.target]).sum(1) < 0
        return matches.keep(~opposite)


@part("rejector", "unique", label="validated")
@dataclass(frozen=True)
class Unique(interfaces.Rejector):
    """Of several pairs with the same target point only the shortest stays (Algorithm 1, line 7).

    Of equally short ones the one with the lowest index in the source stays.
    """

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        keep = icp_kernels.shortest_of_each_target(
            matches.target, matches.distance, len(alignment.target)
        )
        return matches.keep(keep)


@part("metric", "point-to-point", label="validated")
@dataclass(frozen=True)
class PointToPoint(interfaces.Metric):
    """Sum of squared distances of the pairs, ``sum w_i |m_i - (R d_i + t)|^2`` (eq 2.7).

    The minimum is found in one step (Arun, Huang and Blostein 1987): with the centroids ``m0``,
    ``d0`` and ``H = sum w_i (d_i - d0) (m_i - m0)^T = U S V^T``,

        R = V diag(1, 1, det(V U^T)) U^T,    t = m0 - R d0.

    The determinant (Umeyama 1991) keeps R from being a reflection, which is otherwise the best
    fit where points are few, planar or very noisy.
    """

    def motion(self, matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
        """See `Metric.motion`.

        Raises
        ------
        RegistrationError
            If there are fewer than three pairs or their points lie on a line.
        """
        if len(matches) < 3:
            raise RegistrationError(
                f"the views have only {quantities.count(len(matches), 'corresponding point')}, "
                "3 are needed"
            )
        d0, m0, H, size = icp_kernels.weighted_moments(
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
        R = (U @ Vt).T
        return se3.pose(R, m0 - R @ d0)

    def information(self, matches: interfaces.Matches, alignment: interfaces.Alignment) -> Float64:
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
        return (
            icp_kernels.point_information(alignment.source.points, matches.source, weight)
            / variance
        )


@part("stopping", "two-loops", label="validated")
@dataclass(frozen=True)
class TwoLoops(Bounded, interfaces.Stopping):
    """The two loops of Algorithm 1.

    The first (lines 1 to 15) runs until the number of corresponding points is the same in two
    iterations. The second (line 16) continues until the change of E from one iteration to the next,
    ``|E_i - E_(i-1)|``, has been below `epsilon` in `k` iterations in a row; its first change is
    that from the last E of the first loop.

    Attributes
    ----------
    epsilon
        Threshold of the change of E; dimensionless.
    k
        Number of consecutive iterations below the threshold.
    max_iterations
        Maximum number of iterations of both loops together.
    """

    epsilon: Annotated[float, Bounds(0, exclusive=True)] = 1e-4
    k: Annotated[int, Bounds(1)] = 3
    max_iterations: Annotated[int, Bounds(1)] = 100

    def met(self, history: interfaces.History) -> bool:
        """See `Stopping.met`."""
        counts, errors = history.correspondences, history.errors
        last = len(errors) - 1
        first = last - self.k
        if first < 1 or any(
            abs(errors[i] - errors[i - 1]) >= self.epsilon for i in range(first + 1, last + 1)
        ):
            return False
        # The first loop must have ended at `first` or before.
        return any(counts[i] == counts[i - 1] for i in range(1, first + 1))


@part("stopping", "small-step", label="validated")
@dataclass(frozen=True)
class SmallStep(Bounded, interfaces.Stopping):
    """Ends when the displacement of the points is below a fraction of the resolution.

    It also ends when the iterations oscillate between two sets of matches.

    Attributes
    ----------
    epsilon
        Threshold of the RMS displacement of the source's points, in resolutions.
    max_iterations
        Maximum number of iterations.
    """

    epsilon: Annotated[float, Bounds(0, exclusive=True)] = 1e-3
    max_iterations: Annotated[int, Bounds(1)] = 50

    def met(self, history: interfaces.History) -> bool:
        """See `Stopping.met`."""
        counts, errors = history.correspondences, history.errors
        if history.steps[-1] < self.epsilon:
            return True
        return (
            len(errors) >= 5
            and counts[-1] == counts[-3] == counts[-5]
            and abs(errors[-1] - errors[-3]) <= _REPETITION_TOLERANCE * errors[-1]
            and abs(errors[-3] - errors[-5]) <= _REPETITION_TOLERANCE * errors[-1]
        )
