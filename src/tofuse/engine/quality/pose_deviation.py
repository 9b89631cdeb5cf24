"""Deviation of input poses from pairwise registrations, and its statistical significance.

Pairs of views measure the motion between them (`pair_measurements`), with far more pairs
than poses. A least squares fit gives the poses that agree best with all pairs, and its residuals
the errors of registrations in this recording, relative to their stated covariances. The input poses
are consistent if they agree with the pairs as well as correct ones would.

With x the perturbations from the fitted poses to the input poses, and S the covariance of the
fitted poses, a correction d makes the input poses consistent if (x - d)^T S^-1 (x - d) is below a
threshold. The smallest such correction is the solution of a trust-region problem,
(M + m S^-1) (x - d) = M x, with the m at which the threshold is met (More and Sorensen 1983). M is
the norm: the rms displacement over the views of the surfaces in view, by the translation, and by
the rotation at the median depth. Gauge freedom and degenerate directions cost nothing.

The norm of the smallest correction is stated for two thresholds: one that correct poses usually
meet, which estimates the error, and one that 95 % of them meet, which is its lower bound.

Independent measurements of relative poses from pairs of overlapping views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import scipy  # loads its parts when they are used
from scipy.special import fdtri, gammaincinv

from tofuse.engine.alignment import covariance, projective
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.graph import (
    Measured,
    PoseGraph,
    build_graph,
    graph_covariances,
    robust,
    solver,
    sparse,
)
from tofuse.engine.quality.pose_accuracy import ObservedErrors, accuracy_of, without_degenerate
from tofuse.engine.quality.trajectory_errors import align
from tofuse.engine.refinement import joint_alignment
from tofuse.engine.stored_views import PosedView, SampledView, overlaps, pair_equations
from tofuse.engine.views import PreparedView

_ALIGNMENT = projective.ProjectiveOptions()
# Pairs are selected as in joint refinement, with fewer per view: each has six measurements.
_PAIRS = pair_equations.RefineOptions(neighbours=6)


def measured_pairs(views: Sequence[PosedView[PreparedView]], poses: Float64) -> PoseGraph:
    """Align every pair of views that overlap, and each view with the one before it.

    The poses only select the pairs and initialise their alignments.

    Parameters
    ----------
    views
        In the order of their frames.
    poses
        (N, 4, 4) T_world_camera.

    Returns
    -------
    A graph of the frames with these poses, every edge with the covariance of its alignment
    (`alignment.uncertainty`). Degenerate directions of a pair have almost no information.
    """
    pairs = _overlapping(views, poses)
    surfaces = [view.view for view in views]
    ids = [view.index for view in views]

    def measured(i: int, j: int) -> tuple[Measured, Float64]:
        target = [projective.Target(surfaces[i])]
        T_i_j = se3.inverse(poses[i]) @ poses[j]
        aligned = projective.align(surfaces[j], target, T_i_j, _ALIGNMENT)
        C = covariance(surfaces[j], target, aligned, _ALIGNMENT)
        information = np.asarray(np.linalg.inv(C), np.float64)
        edge = Measured(ids[i], ids[j], aligned.T_world_source, information)
        return edge, aligned.unobservable * projective.UNITS

    edges = run_all([partial(measured, i, j) for i, j in pairs.tolist()])
    graph = build_graph(ids, poses, [edge for edge, _ in edges])
    return without_degenerate(graph, [degenerate for _, degenerate in edges])


def _overlapping(views: Sequence[PosedView[PreparedView]], poses: Float64) -> Intp:
    """Return (M, 2) positions i < j of the views that are compared."""
    sampled = [SampledView.of(view.view, _PAIRS.points) for view in views]
    pairs = joint_alignment.spread_evenly(
        overlaps(sampled, poses, _PAIRS.overlap)[0], _PAIRS.neighbours
    )
    later = np.arange(1, len(views))
    return np.unique(np.concatenate([pairs, np.stack([later - 1, later], 1)]), axis=0)


_CONFIDENCE = 0.95
# Of a chi-square variable with six degrees of freedom: its median, and Huber's threshold.
_CHI2_MEDIAN, _CHI2_99 = 2 * float(gammaincinv(3, 0.5)), 2 * float(gammaincinv(3, 0.99))
_ITERATIONS = 3
# Degrees of freedom of the prior of the scale, which is 1 for the stated covariances.
_PRIOR_DOF = 6.0
# Systematic errors of the camera, equal in all views of a place, affect no residual. Ratio of the
# squared perturbations of the true poses to those in the residuals: typically, and in 95 % of
# recordings (docs/uncertainty.md).
TYPICAL_RATIO, _MAX_RATIO = 1.5, 6.0
# Information of a direction, in units of 1 cm and 1 degree, that no measurement constrains.
_MIN_INFORMATION = 1e-4
_MIN_SCALE = 1e-6
_BRACKET_STEP = np.log(100.0)  # of the weights when bracketing the root


@dataclass(frozen=True, eq=False)
class Fit:
    """The least squares fit of poses to the measurements of all pairs.

    Attributes
    ----------
    graph
        With these poses; its information is scaled to the errors of this recording.
    scale
        Standard deviation of the residuals, relative to the stated one.
    dof
        Degrees of freedom of the poses, without unconstrained ones.
    scale_dof
        Degrees of freedom of the estimate of the scale.
    depth_m
        Median depth of the views, m.
    """

    graph: PoseGraph
    scale: float
    dof: float
    scale_dof: float
    depth_m: float


@dataclass(frozen=True, eq=False)
class Deviation:
    """Deviation of input poses from the registrations of a recording.

    Attributes
    ----------
    estimate_m
        Rms displacement of the surfaces in view by errors of the poses; 0 if none are detected.
    at_least_m, at_most_m
        Its bounds, each 95 %. `at_least_m` is 0 if the poses are consistent with the depth;
        `at_most_m` is inf if a direction is not bounded by any measurement.
    distance_m
        Distance from the fitted poses, which have errors too.
    ids
        (V,) indices of the frames that were compared.
    of_views_m
        (V,) displacement of each, whose rms is `estimate_m`.
    errors
        (V, 6) perturbations from the fitted poses to these, m and rad.
    steps
        (S, 2) positions of the views between which the motion alone is inconsistent.
    fit
        The fit they were compared with; other poses of the recording can be compared with it too.
    """

    estimate_m: float
    at_least_m: float
    at_most_m: float
    distance_m: float
    ids: Intp
    of_views_m: Float64
    errors: Float64 = field(repr=False)
    steps: Intp
    fit: Fit = field(repr=False)

    @property
    def consistent(self) -> bool:
        """Whether the depth does not contradict the poses."""
        return self.at_least_m == 0

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of `judge.json`."""
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
    """Fit the poses of a graph to its measurements, and estimate the scale of their errors.

    Both are robust to wrong registrations (Huber 1964, his second proposal). The pairs of a view
    share its errors: all pairs together have the weight of one per pose but the first.

    Parameters
    ----------
    graph
        Of two views or more, see `pair_measurements`.
    depth_m
        Median depth of the views, m.
    """
    n, m = len(graph.ids), len(graph.edges)
    information, poses = graph.information, graph.poses
    variance_scale = max(float(np.median(graph.squared_errors())) / _CHI2_MEDIAN, _MIN_SCALE)
    measured_dof = int(
        (
            np.linalg.eigvalsh(information * np.outer(projective.UNITS, projective.UNITS))
            > _MIN_INFORMATION
        ).sum()
    )
    scale_dof = max(measured_dof - 6 * (n - 1), 0)
    for _ in range(_ITERATIONS):
        solution = _robust_fit(
            replace(graph, poses=poses, information=information / variance_scale)
        )
        poses = solution.poses
        chi2 = variance_scale * float((solution.weights**2 * solution.chi2).sum())
        variance_scale = (_PRIOR_DOF + chi2) / (_PRIOR_DOF + scale_dof)
    per_pair = (n - 1) / m
    scaled_information = (solution.weights * per_pair / variance_scale)[:, None, None] * information
    return Fit(
        replace(graph, poses=poses, information=scaled_information),
        float(np.sqrt(variance_scale)),
        per_pair * measured_dof,
        _PRIOR_DOF + per_pair * scale_dof,
        depth_m,
    )


def deviation(fit: Fit, poses: Float64) -> Deviation:
    """Compare input poses (V, 4, 4) T_world_camera of the views of a fit with it.

    Raises
    ------
    ValueError
        If the registrations of the fit constrain nothing.
    """
    if not fit.dof > 0:
        raise ValueError("nothing was measured")
    graph = fit.graph
    aligned = align(poses, graph.poses, arm_m=fit.depth_m) @ poses
    x = se3.log(se3.inverse(graph.poses) @ aligned)
    problem = _Corrections(graph, fit.depth_m)
    f_quantile = float(fdtri(fit.dof, fit.scale_dof, _CONFIDENCE))
    estimate = problem.smallest_correction(x, TYPICAL_RATIO * fit.dof)
    bound = problem.smallest_correction(x, _MAX_RATIO * f_quantile * fit.dof)
    fit_accuracy = accuracy_of(graph_covariances.GraphCovariances(graph), ObservedErrors(), 0.0)
    fit_error_m = float(np.hypot(fit_accuracy.position_m, fit.depth_m * fit_accuracy.rotation_rad))
    return Deviation(
        problem.norm(estimate),
        problem.norm(bound),
        problem.norm(x) + fit_error_m,
        problem.norm(x),
        graph.ids,
        problem.lengths(estimate),
        x,
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
        self._system = sparse.PairSystem(n, graph.edges, np.zeros(n, np.bool_))

    def product(self, x: Float64) -> float:
        """Return x^T S^-1 x."""
        i, j = self._graph.edges.T
        e = x[j] - (self._A @ x[i][..., None])[..., 0]
        return float(np.einsum("mi,mij,mj->m", e, self._graph.information, e).sum())

    def lengths(self, x: Float64) -> Float64:
        """Return the (V,) displacements of the surfaces in view, m."""
        return np.asarray(np.linalg.norm(x * self._units, axis=1), np.float64)

    def norm(self, x: Float64) -> float:
        """Return the rms of the displacements, m."""
        return float(np.sqrt((self.lengths(x) ** 2).mean()))

    def smallest_correction(self, x: Float64, max_chi2: float) -> Float64:
        """Return the smallest d (V, 6) with (x - d)^T S^-1 (x - d) <= max_chi2."""
        if self.product(x) <= max_chi2:
            return np.zeros_like(x)

        def excess(log_m: float) -> float:
            return self.product(self._remainder(x, float(np.exp(log_m)))) - max_chi2

        low = high = 0.0
        while excess(low) < 0:
            low -= _BRACKET_STEP
        while excess(high) > 0:
            high += _BRACKET_STEP
        log_m = scipy.optimize.brentq(excess, low, high, xtol=1e-3)
        return x - self._remainder(x, float(np.exp(log_m)))

    def _remainder(self, x: Float64, m: float) -> Float64:
        """Return (M + m S^-1)^-1 M x."""
        M = self._units**2 / len(x)
        unary = np.tile(np.diag(M), (len(x), 1, 1)), -M * x
        H = m * self._graph.information
        remainder = self._system.solve(H, np.zeros((len(H), 6)), self._T_i_j, unary=unary)
        assert remainder is not None, "M is positive definite"
        return remainder


def _steps(graph: PoseGraph, poses: Float64) -> Intp:
    """Return consecutive views between which the motion of poses (V, 4, 4) is inconsistent."""
    i, j = graph.edges.T
    consecutive = np.flatnonzero(j == i + 1)
    per_pair = (len(graph.ids) - 1) / len(graph.edges)
    chi2 = graph.with_poses(poses).squared_errors()[consecutive] / per_pair
    threshold = 2 * float(gammaincinv(3, 1 - (1 - _CONFIDENCE) / max(len(consecutive), 1)))
    return graph.edges[consecutive[chi2 > _MAX_RATIO * threshold]]


def _robust_fit(graph: PoseGraph) -> solver.Solution:
    return solver.solve(
        graph.poses,
        graph.edges,
        graph.measurements,
        graph.information,
        loop=np.ones(len(graph.edges), np.bool_),
        settings=robust.Settings(robust="huber", gate=_CHI2_99),
    )
