"""Response of refined views to errors of the camera: shared by all, or with a profile over them.

Sections of the images tell errors of the camera from others that look like them, such as multipath
or mixed pixels: an error of the camera is the same in all sections, near and far.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit  # scipy.stats takes long to import

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.graph import sparse
from tofuse.engine.refinement.joint_alignment import DAMPING, Priors, weak_prior
from tofuse.engine.stored_views import SampledView, pair_equations
from tofuse.engine.stored_views import pair_equation_kernels as kernels

# Quadrants of the images, each with a near and a far half.
SECTIONS = 8
# Significance of an error in standard deviations of a normal distribution.
SIGNIFICANT = 4.0
_SHARED = kernels.SOURCE_SCALE  # number of errors that all views share
_ESTIMATE_ALL = np.zeros(kernels.ERRORS, np.int64)
_MAX_CORRELATION = 0.97  # of errors of successive views


@dataclass(frozen=True, eq=False)
class Response:
    """Sensitivity of each pair to single errors of the camera, all poses being free to follow.

    The K errors are those that all views share, in the order of `kernels`, or the scale of the
    depth by K profiles over the views.

    Attributes
    ----------
    gradient, information
        (M, K) of each pair i < j, both directions together, or of each section: first and second
        derivative of its robust cost (Tukey's biweight).
    motion
        (K, N, 6) twist by which each pose follows, per unit of the error.
    """

    gradient: Float64
    information: Float64
    motion: Float64

    def estimate(self) -> Float64:
        """(K,) estimate of each error alone, by one Newton step."""
        return np.asarray(
            -self.gradient.sum(0) / np.maximum(self.information.sum(0), 1e-12), np.float64
        )

    def sigma(self, pairs: Intp, view_count: int) -> Float64:
        """(K,) standard deviations, from the scatter between views (sandwich estimator).

        It includes noise that neighbouring pixels share and errors of single views, but not errors
        that all views have in common.

        Parameters
        ----------
        pairs
            (M, 2) positions of the views.
        view_count
            Number of views.
        """
        return self._sigma((self._of_views(pairs, view_count) ** 2).sum(0), view_count)

    def sigma_by_rows(self) -> Float64:
        """(K,) standard deviations as of `sigma`, from the scatter between rows, as of sections."""
        residual_gradient = self.gradient + self.information * self.estimate()
        return self._sigma((residual_gradient**2).sum(0), len(self.gradient))

    def serial(self, pairs: Intp, view_count: int) -> tuple[Float64, Float64]:
        """Return standard deviations and effective numbers of views (K,) of profiles over time.

        As `sigma` and `informative_views`, but for views whose errors resemble those of the views
        before and after, as with multipath, which changes from room to room: with the
        autocovariances up to a lag that follows from that of the next view (Newey and West 1987;
        Andrews 1991, equation 6.2), which also reduces the number of independent views.
        Arguments as of `sigma`; the views are in the order of time.
        """
        v = self._of_views(pairs, view_count)
        variance = np.maximum((v**2).sum(0), 1e-24)
        next_one = ((v[1:] * v[:-1]).sum(0) / variance).clip(0, _MAX_CORRELATION)
        alpha = (2 * next_one / (1 - next_one**2)) ** 2
        # Weights decrease from 1 at lag 0 to 0 at this one; with white noise no lag counts.
        width = np.minimum(np.maximum(1.1447 * (alpha * view_count) ** (1 / 3), 1), view_count)
        total = variance.copy()
        for lag in range(1, view_count):
            total += 2 * np.maximum(1 - lag / width, 0) * (v[lag:] * v[:-lag]).sum(0)
        independent = self.informative_views(pairs, view_count) * np.minimum(1.5 / width, 1)
        sigma = self._sigma(np.maximum(total, variance), view_count)
        return sigma, np.asarray(independent, np.float64)

    def _of_views(self, pairs: Intp, view_count: int) -> Float64:
        """(N, K) gradients of the views at the estimates."""
        residual_gradient = self.gradient + self.information * self.estimate()
        return _by_view(residual_gradient, pairs, view_count)

    def _sigma(self, variance: Float64, view_count: int) -> Float64:
        """(K,) standard deviations, by the variances of the sums of the gradients."""
        # One degree of freedom is lost, as the estimate is that of the same views.
        scatter = np.sqrt(variance * view_count / max(view_count - 1, 1))
        return np.asarray(scatter / np.maximum(self.information.sum(0), 1e-12), np.float64)

    def informative_views(self, pairs: Intp, view_count: int) -> Float64:
        """(K,) effective number of views that determine each error; arguments as of `sigma`."""
        information = np.maximum(_by_view(self.information, pairs, view_count), 0.0)
        squares = np.maximum((information**2).sum(0), 1e-24)
        return np.asarray(information.sum(0) ** 2 / squares, np.float64)


def _derivatives(
    H: Float64, g: Float64, column: Float64, initial_motion: Float64, follow: Float64
) -> tuple[Float64, Float64]:
    """First and second derivatives (P,) of the costs of pairs by a combination of errors.

    Parameters
    ----------
    H, g
        As of `Linearised`.
    column
        (P, ERRORS) combination of the errors.
    initial_motion, follow
        (P, 6) motions of the relative poses: without the errors, and per unit of them.
    """
    mixed = (H[:, :6, 6:] @ column[..., None])[..., 0]
    slope = g[:, :6] + (H[:, :6, :6] @ initial_motion[..., None])[..., 0]
    first = (g[:, 6:] * column).sum(1) + (mixed * initial_motion).sum(1) + (slope * follow).sum(1)
    second = (
        np.einsum("mi,mij,mj->m", column, H[:, 6:, 6:], column)
        + 2 * (mixed * follow).sum(1)
        + np.einsum("mi,mij,mj->m", follow, H[:, :6, :6], follow)
    )
    return first, second


def _sections(points: Float32) -> Intp:
    """Return the section (N,) of each point (N, 3 or more) of a view."""
    if len(points) == 0:
        return np.zeros(0, np.intp)
    x, y = (points[:, :2] / points[:, 2:3]).T
    section = 4 * (x > np.median(x)) + 2 * (y > np.median(y))
    for quadrant in np.unique(section):
        inside = section == quadrant
        depth = points[inside, 2]
        section[inside] += depth > np.median(depth)
    return np.asarray(section, np.intp)


def _by_view(of_pairs: Float64, pairs: Intp, view_count: int) -> Float64:
    """Return the sums (N, K) over the pairs of each view, given values (M, K) of pairs (M, 2)."""
    out = np.zeros((view_count, of_pairs.shape[1]))
    for ends in pairs.T:
        np.add.at(out, ends, of_pairs)
    return out


@dataclass(frozen=True, eq=False)
class Linearised:
    """Refined views, linearised in their poses and in errors of the camera.

    Attributes
    ----------
    state, poses, errors
        Directed pairs (P,), and where they are linearised: (N, 4, 4) and (ERRORS,).
    system, T_i_j
        The system of the poses, and its relative poses (P + priors, 4, 4).
    H, g
        (P, 6 + ERRORS, 6 + ERRORS) and (P, 6 + ERRORS) normal equations of the pairs.
    factor
        Factorised system of the poses.
    curvature
        Ratio of the curvature of the robust cost to that with constant weights.
    """

    state: pair_equations.DirectedPairs
    poses: Float64
    errors: Float64
    system: sparse.PairSystem
    T_i_j: Float64
    H: Float64
    g: Float64
    factor: sparse.Factor
    curvature: float

    @classmethod
    def of(
        cls,
        views: Sequence[SampledView],
        poses: Float64,
        pairs: Intp,
        options: pair_equations.RefineOptions,
        priors: Priors,
        errors: Float64 | None = None,
    ) -> Linearised:
        """Linearise views at refined poses.

        Parameters
        ----------
        views, options, priors
            As for `refine`.
        poses
            (N, 4, 4) T_world_camera, refined with these errors.
        pairs
            (M, 2) positions of views i < j.
        errors
            (ERRORS,) of the camera; None: without any.
        """
        errors = np.zeros(kernels.ERRORS) if errors is None else errors
        stage = options.rounds[-1]
        state = pair_equations.DirectedPairs.of(views, pairs, options)
        system = priors.system(len(views), np.stack([state.target, state.source], 1))
        state.evaluate(poses, errors, np.ones(kernels.ERRORS, np.int64), stage)
        state.without_exposure()
        state.rescale(stage)
        state.evaluate(poses, errors, _ESTIMATE_ALL, stage)
        H, g = state.without_exposure(range(kernels.ERRORS))
        i, j = system.pairs.T
        T_i_j = se3.inverse(poses[i]) @ poses[j]
        prior_H, prior_g = priors.equations(T_i_j[len(H) :])
        matrix, gradient = system.relative(
            np.concatenate([H[:, :6, :6], prior_H]),
            np.concatenate([g[:, :6], prior_g]),
            T_i_j,
            weak_prior(len(poses)),
        )
        factor = system.factor(matrix, gradient, DAMPING)
        assert factor is not None, "every pose has a prior, so the system is not singular"
        # Reweighted least squares holds the weights constant, and their curvature exceeds that of
        # the cost. A single step with it falls short, and a sandwich estimate by it is too small
        # (Huber 1981, Robust Statistics, section 3.2: the mean of psi').
        curvature = tukey.consistency(projective.ROBUST)
        return cls(state, poses, errors, system, T_i_j, H, g, factor, curvature)

    def response_to_errors(self) -> Response:
        """Return the response to each error that all views share."""
        return self._response(self._shared_errors())

    def response_of_sections(self) -> Response:
        """Return the same by sections of the images, if poses follow as by whole images."""
        motion = self.response_to_errors().motion
        step, follow = self._relative(self._initial_step()), list(map(self._relative, motion))
        sections = [_sections(view.points) for view in self.state.views]
        first, second = np.zeros((2, SECTIONS, len(follow)))
        for row in range(SECTIONS):
            part = self.state.with_points([np.flatnonzero(s == row) for s in sections])
            part.evaluate(self.poses, self.errors, _ESTIMATE_ALL, self.state.options.rounds[-1])
            equations = part.without_exposure(range(kernels.ERRORS))
            for k, column in enumerate(self._shared_errors()):
                of_pairs = _derivatives(*equations, column, step, follow[k])
                first[row, k], second[row, k] = (x.sum() for x in of_pairs)
        return Response(first, second * self.curvature, motion)

    def _shared_errors(self) -> list[Float64]:
        return [np.eye(kernels.ERRORS)[[k] * len(self.H)] for k in range(_SHARED)]

    def response_to_scales(self, profiles: Float64) -> Response:
        """Return the response to the scale of the depth by profiles (K, N) over the views."""
        columns = np.zeros((len(profiles), len(self.H), kernels.ERRORS))
        of_target = profiles[:, self.state.target]
        # The response to the scale of the target is the remainder of that to a common one.
        columns[..., kernels.SOURCE_SCALE] = profiles[:, self.state.source] - of_target
        columns[..., kernels.SCALE] = of_target
        return self._response(columns)

    def _response(self, columns: Iterable[Float64]) -> Response:
        """Return the response to combinations (P, ERRORS) of the errors of each directed pair."""
        H, initial_motion = self.H, self._relative(self._initial_step())
        prior_rows = np.zeros((len(self.T_i_j) - len(H), 6))
        first, second, motion = [], [], []
        for column in columns:
            mixed = (H[:, :6, 6:] @ column[..., None])[..., 0]
            gradient = self.system.gradient(np.concatenate([mixed, prior_rows]), self.T_i_j)
            follow = self.factor.solve(gradient)
            assert follow is not None, "the system is finite"
            motion.append(follow)
            of_pairs = _derivatives(H, self.g, column, initial_motion, self._relative(follow))
            first.append(of_pairs[0])
            second.append(of_pairs[1])
        # Both directions of a pair together.
        by_pair = [np.array(x).reshape(len(x), 2, -1).sum(1).T for x in (first, second)]
        return Response(by_pair[0], by_pair[1] * self.curvature, np.array(motion))

    def _initial_step(self) -> Float64:
        step = self.factor.step()
        assert step is not None, "the system is finite"
        return step

    def _relative(self, step: Float64) -> Float64:
        """Return the motion (P, 6) of the relative poses by a step (N, 6)."""
        source, target = self.state.source, self.state.target
        A = se3.adjoint(se3.inverse(self.T_i_j[: len(source)]))
        return np.asarray(step[source] - (A @ step[target][..., None])[..., 0], np.float64)

    def scale_scores(self, profiles: Float64) -> Float64:
        """Return (K,) how much scales by profiles (K, N) reduce the cost, for many profiles."""
        count, H, g = profiles.shape[1], self.H, self.g
        ends = self.state.source, self.state.target
        At = np.swapaxes(se3.adjoint(se3.inverse(self.T_i_j[: len(H)])), 1, 2)
        # Equations by the scales of the source and of the target, and their coupling to poses.
        of_ends = np.zeros((kernels.ERRORS, 2))
        of_ends[kernels.SOURCE_SCALE] = 1, -1
        of_ends[kernels.SCALE, 1] = 1
        second = of_ends.T @ H[:, 6:, 6:] @ of_ends
        mixed = H[:, :6, 6:] @ of_ends
        first = g[:, 6:] @ of_ends
        gradient, information = np.zeros(count), np.zeros((count, count))
        coupling = np.zeros((count, count, 6))  # of each pose to each scale
        for a, end in enumerate(ends):
            np.add.at(gradient, end, first[:, a])
            np.add.at(coupling, (ends[0], end), mixed[..., a])
            np.add.at(coupling, (ends[1], end), -(At @ mixed[..., a, None])[..., 0])
            for b, other in enumerate(ends):
                np.add.at(information, (end, other), second[:, a, b])
        columns = np.swapaxes(coupling[self.system.free], 1, 2).reshape(-1, count) @ profiles.T
        solved = self.factor.solve_columns(columns)
        slope = profiles @ gradient - self.factor.gradient.ravel() @ solved
        curvature = ((profiles @ information) * profiles).sum(1) - (columns * solved).sum(0)
        return np.asarray(slope**2 / np.maximum(curvature, 1e-12), np.float64)


def significance_of(view_count: float, tests: int = 1) -> float:
    """Return the number of standard deviations that a significant error must exceed.

    The probability of chance is that of four standard deviations of a normal distribution. Few
    views determine their own scatter poorly, so that the estimate follows Student's t-distribution.
    Of several tests, one of which is picked, each must be less likely (Bonferroni).
    """
    return -float(stdtrit(max(view_count - 1, 1), ndtr(-SIGNIFICANT) / tests))
