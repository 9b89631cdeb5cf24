"""How far given poses are from what registrations measure, and whether that can be chance.

Pairs of views measure the motion between them (`posegraph.pair_measurements`), many more pairs than
there are poses. So the poses that fit all pairs best can be found, and the residuals of that fit
show how large the errors of registrations are in this recording, relative to the covariances that
they state. The given poses either agree with the pairs as well as any poses could, or they don't.

With x the perturbations that turn the fitted poses into the given ones, and S the covariance of the
fitted poses, a correction d makes the given poses consistent if (x - d)^T S^-1 (x - d) is no larger
than it may be. The smallest such correction is the solution of a trust-region problem,
(M + m S^-1) (x - d) = M x, with the one m for which it just is (More and Sorensen 1983). M is the
norm: the rms over the views of how far the surfaces in view are displaced, by the translation, and
by the rotation at the median depth. A rigid motion of all poses costs nothing, and neither does
what no measurement constrains.

The size of the smallest correction is stated twice: to where right poses usually are, which
estimates the error, and to where 95 % of them are, which bounds it from below.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2 as chi_squared
from scipy.stats import f as f_distribution

from tofuse.arrays import Float64, Intp
from tofuse.evaluation.trajectory import align
from tofuse.geometry import se3
from tofuse.posegraph.accuracy import Shown, accuracy_of
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.robust import Settings
from tofuse.posegraph.solve import Solution, solve
from tofuse.posegraph.sparse import PairSystem
from tofuse.registration.projective import UNITS

_LEVEL = 0.95
# Of a chi-square variable with six degrees of freedom: its median, and where Huber's loss begins.
_MEDIAN, _RARE = float(chi_squared.median(6)), float(chi_squared.ppf(0.99, 6))
_FITS = 3
# The stated covariances count as much as so many residuals that confirm them.
_STATED = 6.0
# Errors of the camera that all views of a place share show in no residual. The squares of the true
# poses' perturbations are so many times what the residuals show: usually, and in 95 % of recordings
# (docs/uncertainty.md).
_USUAL, _AT_WORST = 1.5, 6.0
# Information of a direction, in units of 1 cm and 1 degree, that no measurement constrains.
_UNMEASURED = 1e-4
_LEAST_SCALE = 1e-6
_STRIDE = np.log(100.0)  # between the weights that are tried first


@dataclass(frozen=True, eq=False)
class Fit:
    """The poses that fit the measurements of all pairs best.

    Attributes
    ----------
    graph
        With these poses; its information is what the pairs together know, at the size of errors
        that this recording shows.
    scale
        Standard deviation of the residuals, relative to the stated one.
    unknowns
        Degrees of freedom of the poses, without those that nothing constrains.
    spare
        Degrees of freedom that the scale rests on.
    depth_m
        Median depth of what the views see.
    """

    graph: PoseGraph
    scale: float
    unknowns: float
    spare: float
    depth_m: float


@dataclass(frozen=True, eq=False)
class Deviation:
    """How far given poses are from what the registrations of a recording measure.

    Attributes
    ----------
    estimate_m
        Rms displacement of the surfaces in view by errors of the poses; 0 where none are seen.
    at_least_m, at_most_m
        Bounds of it, each 95 %. `at_least_m` is 0 where the poses are consistent with the depth;
        `at_most_m` is inf where some direction is not bounded by any measurement.
    distance_m
        Distance from the poses that fit the registrations best, which err as well.
    ids
        (V,) indices of the frames that were compared.
    of_views_m
        (V,) displacement of each that `estimate_m` is the rms of.
    steps
        (S, 2) positions of the views between which the motion alone is inconsistent.
    fit
        What they were compared with; other poses of the same recording can be, too.
    """

    estimate_m: float
    at_least_m: float
    at_most_m: float
    distance_m: float
    ids: Intp
    of_views_m: Float64
    steps: Intp
    fit: Fit = field(repr=False)

    @property
    def consistent(self) -> bool:
        """Whether the depth does not contradict the poses."""
        return self.at_least_m == 0

    def to_dict(self) -> dict[str, Any]:
        """Return what `judge.json` holds."""
        return {
            "estimate_m": self.estimate_m,
            "at_least_m": self.at_least_m,
            "at_most_m": self.at_most_m,
            "distance_m": self.distance_m,
            "frames": self.ids.tolist(),
            "of_frames_m": self.of_views_m.tolist(),
            "inconsistent_steps": self.ids[self.steps].tolist(),
        }


def fitted(graph: PoseGraph, depth_m: float) -> Fit:
    """Fit the poses of a graph to its measurements, and find the size of their errors.

    Wrong registrations count little, for the poses and for the size of errors (Huber 1964, his
    second proposal). Each view takes part in many pairs, which share its errors: all pairs together
    count no more than one for each pose but the first.

    Parameters
    ----------
    graph
        Of two views or more, see `posegraph.pair_measurements`.
    depth_m
        Median depth of what they see.
    """
    n, m = len(graph.ids), len(graph.edges)
    information, poses = graph.information, graph.poses
    square = max(float(np.median(_squares(graph))) / _MEDIAN, _LEAST_SCALE)
    measured = int((np.linalg.eigvalsh(information * np.outer(UNITS, UNITS)) > _UNMEASURED).sum())
    spare = max(measured - 6 * (n - 1), 0)
    for _ in range(_FITS):
        found = _solved(replace(graph, poses=poses, information=information / square))
        poses = found.poses
        left = square * float((found.weights**2 * found.chi2).sum())
        square = (_STATED + left) / (_STATED + spare)
    share = (n - 1) / m
    counted = (found.weights * share / square)[:, None, None] * information
    return Fit(
        replace(graph, poses=poses, information=counted),
        float(np.sqrt(square)),
        share * measured,
        _STATED + share * spare,
        depth_m,
    )


def deviation(fit: Fit, poses: Float64) -> Deviation:
    """Compare given poses (V, 4, 4) of the views of a fit with it.

    Raises
    ------
    ValueError
        If the registrations of the fit constrain nothing.
    """
    if not fit.unknowns > 0:
        raise ValueError("nothing was measured")
    graph = fit.graph
    aligned = align(poses, graph.poses, arm_m=fit.depth_m) @ poses
    x = se3.log(se3.inverse(graph.poses) @ aligned)
    problem = _Corrections(graph, fit.depth_m)
    chance = float(f_distribution.ppf(_LEVEL, fit.unknowns, fit.spare))
    estimate = problem.smallest(x, _USUAL * fit.unknowns)
    least = problem.smallest(x, _AT_WORST * chance * fit.unknowns)
    known = accuracy_of(graph, Shown(), 0.0)
    own = float(np.hypot(known.position_m, fit.depth_m * known.rotation_rad))
    return Deviation(
        problem.norm(estimate),
        problem.norm(least),
        problem.norm(x) + own,
        problem.norm(x),
        graph.ids,
        problem.lengths(estimate),
        _steps(graph, aligned),
        fit,
    )


class _Corrections:
    """Quadratic forms in perturbations (V, 6) of the poses of a graph."""

    def __init__(self, graph: PoseGraph, depth_m: float) -> None:
        n = len(graph.ids)
        i, j = graph.edges.T
        self._graph, self._T_i_j = graph, se3.inverse(graph.poses[i]) @ graph.poses[j]
        self._A = se3.adjoint(se3.inverse(self._T_i_j))
        self._units = np.array([1.0] * 3 + [depth_m] * 3)
        self._system = PairSystem(n, graph.edges, np.zeros(n, np.bool_))

    def product(self, x: Float64) -> float:
        """x^T S^-1 x."""
        i, j = self._graph.edges.T
        e = x[j] - (self._A @ x[i][..., None])[..., 0]
        return float(np.einsum("mi,mij,mj->m", e, self._graph.information, e).sum())

    def lengths(self, x: Float64) -> Float64:
        """(V,) displacements of the surfaces in view, m."""
        return np.asarray(np.linalg.norm(x * self._units, axis=1), np.float64)

    def norm(self, x: Float64) -> float:
        """Rms of the displacements, m."""
        return float(np.sqrt((self.lengths(x) ** 2).mean()))

    def smallest(self, x: Float64, allowed: float) -> Float64:
        """The smallest d (V, 6) with (x - d)^T S^-1 (x - d) <= allowed."""
        if self.product(x) <= allowed:
            return np.zeros_like(x)

        def excess(log_m: float) -> float:
            return self.product(self._rest(x, float(np.exp(log_m)))) - allowed

        low = high = 0.0
        while excess(low) < 0:
            low -= _STRIDE
        while excess(high) > 0:
            high += _STRIDE
        return x - self._rest(x, float(np.exp(brentq(excess, low, high, xtol=1e-3))))

    def _rest(self, x: Float64, m: float) -> Float64:
        """(M + m S^-1)^-1 M x."""
        M = self._units**2 / len(x)
        single = np.tile(np.diag(M), (len(x), 1, 1)), -M * x
        H = m * self._graph.information
        found = self._system.solve(H, np.zeros((len(H), 6)), self._T_i_j, single=single)
        assert found is not None, "M is positive definite"
        return found


def _steps(graph: PoseGraph, poses: Float64) -> Intp:
    """Pairs of views in a row between which the motion by poses (V, 4, 4) can't be chance."""
    i, j = graph.edges.T
    row = np.flatnonzero(j == i + 1)
    share = (len(graph.ids) - 1) / len(graph.edges)
    squares = _squares(replace(graph, poses=poses))[row] / share
    rare = float(chi_squared.ppf(1 - (1 - _LEVEL) / max(len(row), 1), 6))
    return graph.edges[row[squares > _AT_WORST * rare]]


def _squares(graph: PoseGraph) -> Float64:
    """(M,) squared errors of the edges, in units of their information."""
    e = graph.residuals()
    return np.asarray(np.einsum("mi,mij,mj->m", e, graph.information, e), np.float64)


def _solved(graph: PoseGraph) -> Solution:
    return solve(
        graph.poses,
        graph.edges,
        graph.measurements,
        graph.information,
        loop=np.ones(len(graph.edges), np.bool_),
        settings=Settings(robust="huber", gate=_RARE),
    )
