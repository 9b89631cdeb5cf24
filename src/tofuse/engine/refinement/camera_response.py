"""Errors of the camera that refined views show: shared by all, or with a profile over them.

Shared errors are estimated together, as they resemble each other: alone, the focal length takes the
effect of an offset of the range, and conversely. Sections of the images tell them from others that
look like them, such as multipath or mixed pixels: an error of the camera is the same in all
sections, near and far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr, stdtrit  # scipy.stats takes long to import

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.graph import sparse
from tofuse.engine.refinement.joint_alignment import Priors, weak_prior
from tofuse.engine.stored_views import SampledView, pair_equations
from tofuse.engine.stored_views import pair_equation_kernels as kernels

# Quadrants of the images, each with a near and a far half.
SECTIONS = 8
# Significance of an error in standard deviations of a normal distribution.
SIGNIFICANT = 4.0
_ESTIMATE_ALL = np.zeros(kernels.ERRORS, np.int64)
# Errors of the source view alone, and of all views.
_OFFSETS = kernels.SOURCE_OFFSET, kernels.OFFSET
_SCALES = kernels.SOURCE_SCALE, kernels.SCALE
_MAX_CORRELATION = 0.97  # of errors of successive views


@dataclass(frozen=True, eq=False)
class Response:
    """Sensitivity of each pair to the scale of the depth, all poses being free to follow.

    It changes over the views by one of K profiles.

    Attributes
    ----------
    gradient, information
        (M, K) of each pair i < j, both directions together: first and second derivative of its
        robust cost (Tukey's biweight).
    motion
        (K, N, 6) twist by which each pose follows, per unit of the error.
    """

    gradient: Float64
    information: Float64
    motion: Float64

    def estimate(self) -> Float64:
        """(K,) estimate of each scale alone, by one Newton step."""
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

    def serial(self, pairs: Intp, view_count: int) -> tuple[Float64, Float64]:
        """Return standard deviations and effective numbers of views (K,) of profiles over time.

        As `sigma` and `informative_views`, but for views whose errors resemble those of the views
        before and after, as with multipath, which changes from room to room. Arguments as of
        `sigma`; the views are in the order of time.
        """
        variance, independent = _serial(self._of_views(pairs, view_count))
        informative = self.informative_views(pairs, view_count)
        return self._sigma(variance, view_count), informative * independent

    def _of_views(self, pairs: Intp, view_count: int) -> Float64:
        """(N, K) gradients of the views at the estimates."""
        return _by_view(self.gradient + self.information * self.estimate(), pairs, view_count)

    def _sigma(self, variance: Float64, view_count: int) -> Float64:
        """(K,) standard deviations, by the variances of the sums of the gradients."""
        # One degree of freedom is lost, as the estimate is that of the same views.
        scatter = np.sqrt(variance * view_count / max(view_count - 1, 1))
        return np.asarray(scatter / np.maximum(self.information.sum(0), 1e-12), np.float64)

    def informative_views(self, pairs: Intp, view_count: int) -> Float64:
        """(K,) effective number of views that determine each error; arguments as of `sigma`."""
        return _informative(_by_view(self.information, pairs, view_count))


@dataclass(frozen=True, eq=False)
class Posterior:
    """What views tell of K errors of the camera.

    Attributes
    ----------
    errors, covariance
        (K,) most likely errors, and (K, K).
    evidence
        Logarithm of the probability of the views, but for a constant.
    """

    errors: Float64
    covariance: Float64
    evidence: float


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Equations of K errors of the camera that all views share, all poses being free to follow.

    Attributes
    ----------
    initial
        (K,) errors at which they are linearised.
    gradient, information
        (K,) and (K, K) derivatives of the robust cost (Tukey's biweight).
    dispersion
        Ratio of the scatter of the gradients to that by the noise of independent pixels. All that
        the views tell is worth so much less (quasi-likelihood, McCullagh and Nelder 1989, section
        4.5). Noise that neighbouring pixels share, and errors of single views, scatter between
        views; multipath, mixed pixels and periodic errors between sections of the images.
    motion
        (K, N, 6) twist by which each pose follows, per unit of each error.
    serial_sigma, independent
        (K,) standard deviation of each estimate, and effective number of views, if the errors of
        views resemble those of the views before and after, see `Response.serial`.
    """

    initial: Float64
    gradient: Float64
    information: Float64
    dispersion: float
    motion: Float64
    serial_sigma: Float64
    independent: Float64

    def posterior(self, sigmas: Float64) -> Posterior:
        """Return the posterior of the errors, given standard deviations (K,) before the views."""
        prior = np.diag(1 / sigmas**2)
        information, gradient = (x / self.dispersion for x in (self.information, self.gradient))
        covariance = np.linalg.inv(information + prior)
        step = -covariance @ (gradient + prior @ self.initial)
        errors = self.initial + step
        cost = step @ (0.5 * information @ step + gradient) + 0.5 * errors @ prior @ errors
        volume = 0.5 * np.linalg.slogdet(covariance)[1] - np.log(sigmas).sum()
        return Posterior(errors, np.asarray(covariance, np.float64), float(volume - cost))


def _informative(information: Float64) -> Float64:
    """Return the effective number (K,) of views with information (N, K)."""
    information = np.maximum(information, 0.0)
    squares = np.maximum((information**2).sum(0), 1e-24)
    return np.asarray(information.sum(0) ** 2 / squares, np.float64)


def _serial(v: Float64) -> tuple[Float64, Float64]:
    """Return the variances (K,) of the sums of series (N, K) whose values resemble the next ones.

    With the autocovariances up to a lag that follows from that of the next value (Newey and West
    1987; Andrews 1991, equation 6.2); and the fractions (K,) of the values that are independent.
    """
    count = len(v)
    variance = np.maximum((v**2).sum(0), 1e-24)
    next_one = ((v[1:] * v[:-1]).sum(0) / variance).clip(0, _MAX_CORRELATION)
    alpha = (2 * next_one / (1 - next_one**2)) ** 2
    # Weights decrease from 1 at lag 0 to 0 at this one; with white noise no lag counts.
    width = np.minimum(np.maximum(1.1447 * (alpha * count) ** (1 / 3), 1), count)
    total = variance.copy()
    for lag in range(1, count):
        total += 2 * np.maximum(1 - lag / width, 0) * (v[lag:] * v[:-lag]).sum(0)
    return np.maximum(total, variance), np.minimum(1.5 / width, 1)


def _scatter(gradients: Float64) -> Float64:
    """Return the covariance (K, K) of the sum of gradients (n, K), by how they differ."""
    deviations = gradients - gradients.mean(0)
    n = len(gradients)
    return np.asarray(n / (n - 1) * deviations.T @ deviations, np.float64)


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
        factor = priors.factor(system, H[:, :6, :6], g[:, :6], T_i_j, weak_prior(len(poses)))
        # Reweighted least squares holds the weights constant, and their curvature exceeds that of
        # the cost. A single step with it falls short, and a sandwich estimate by it is too small
        # (Huber 1981, Robust Statistics, section 3.2: the mean of psi').
        curvature = tukey.consistency(projective.ROBUST)
        return cls(state, poses, errors, system, T_i_j, H, g, factor, curvature)

    def shared_errors(self, errors: Sequence[int], changes: Float64 | None = None) -> SharedErrors:
        """Return the equations of errors, by their numbers in `kernels`.

        And, after them, of offsets and of scales that change over the views by profiles (D, N).
        """
        columns = np.tile(np.eye(kernels.ERRORS)[:, errors], (len(self.H), 1, 1))
        if changes is not None:
            changing = [self._changing(changes, *kind) for kind in (_OFFSETS, _SCALES)]
            columns = np.concatenate([columns, *changing], 2)
        motion, along = self._along(columns)
        first, second = self._derivatives(self.H, self.g, along)
        gradient = first.sum(0)
        information = second.sum(0) + 1e-9 * np.eye(len(gradient))
        estimate = -np.linalg.solve(information, gradient)
        of_views = _by_view(first + second @ estimate, self.state.pairs, len(self.poses))
        of_sections = self._of_sections(along, estimate)
        # A pair counts for both of its views. Noise is in both scatters, on the safe side.
        dispersion = sum(
            weight * float(np.trace(np.linalg.solve(information, _scatter(gradients))))
            for weight, gradients in ((0.5, of_views), (1.0, of_sections))
        ) / len(information)
        initial = np.append(self.errors[list(errors)], np.zeros(len(gradient) - len(errors)))
        count = len(self.poses)
        variance, independent = _serial(of_views @ np.linalg.inv(information))
        informative = np.diagonal(second, axis1=1, axis2=2)
        informative = _informative(_by_view(informative, self.state.pairs, count))
        return SharedErrors(
            initial,
            gradient,
            information,
            max(dispersion, 1.0),
            motion,
            np.sqrt(variance * count / max(count - 1, 1)),
            informative * independent,
        )

    def response_to_scales(self, profiles: Float64) -> Response:
        """Return the response to the scale of the depth by profiles (K, N) over the views."""
        motion, along = self._along(self._changing(profiles, *_SCALES))
        first, second = self._derivatives(self.H, self.g, along)
        return Response(first, np.diagonal(second, axis1=1, axis2=2), motion)

    def _derivatives(self, H: Float64, g: Float64, along: Float64) -> tuple[Float64, Float64]:
        """First (M, K) and second (M, K, K) derivatives of the costs of pairs by combined changes.

        Parameters
        ----------
        H, g
            (P, 6 + ERRORS, 6 + ERRORS) and (P, 6 + ERRORS) equations of the directed pairs.
        along
            (P, 6 + ERRORS, K) changes of the relative poses and errors.
        """
        slope = g + (H[:, :, :6] @ self._step[..., None])[..., 0]
        along_t = np.swapaxes(along, 1, 2)
        first, second = (along_t @ slope[..., None])[..., 0], along_t @ H @ along
        # Both directions of a pair together.
        half = len(first) // 2
        return first[:half] + first[half:], self.curvature * (second[:half] + second[half:])

    def _changing(self, profiles: Float64, of_source: int, of_all: int) -> Float64:
        """Return errors (P, ERRORS, K) of the directed pairs that change by profiles (K, N).

        `of_source` is the number of the error of the source view alone, `of_all` of all views.
        """
        columns = np.zeros((len(self.H), kernels.ERRORS, len(profiles)))
        of_target = profiles[:, self.state.target].T
        # The response to the error of the target is the remainder of that to a common one.
        columns[:, of_source] = profiles[:, self.state.source].T - of_target
        columns[:, of_all] = of_target
        return columns

    def section_sigma(self, profile: Float64, *, in_metres: bool = False) -> float:
        """Standard deviation of a change by a profile (1, N), from the scatter between sections.

        Of the scale, or of the range in m. An error that differs over the image is no change of the
        range, though with steady motion views drift apart by it: what enters on one side leaves on
        the other.
        """
        of_source, of_all = _OFFSETS if in_metres else _SCALES
        _, along = self._along(self._changing(profile, of_source, of_all))
        first, second = (x.sum(0) for x in self._derivatives(self.H, self.g, along))
        scatter = _scatter(self._of_sections(along, -first / second[0]))
        return float(np.sqrt(scatter[0, 0]) / max(second[0, 0], 1e-12))

    def _of_sections(self, along: Float64, estimate: Float64) -> Float64:
        """Return the gradients (SECTIONS, K) of sections of the images at an estimate (K,)."""
        sections = [_sections(view.points) for view in self.state.views]
        gradients = []
        for section in range(SECTIONS):
            part = self.state.with_points([np.flatnonzero(s == section) for s in sections])
            part.evaluate(self.poses, self.errors, _ESTIMATE_ALL, self.state.options.rounds[-1])
            first, second = self._derivatives(*part.without_exposure(range(kernels.ERRORS)), along)
            gradients.append(first.sum(0) + second.sum(0) @ estimate)
        return np.array(gradients)

    def _along(self, columns: Float64) -> tuple[Float64, Float64]:
        """Return how poses follow combinations (P, ERRORS, K) of the errors of directed pairs.

        The twists (K, N, 6) of the poses, and the changes (P, 6 + ERRORS, K) of the relative poses
        and errors of the pairs.
        """
        mixed = self.H[:, :6, 6:] @ columns
        prior_rows = np.zeros((len(self.T_i_j) - len(mixed), 6))
        motion = []
        for k in range(columns.shape[2]):
            of_pairs = np.concatenate([mixed[..., k], prior_rows])
            follow = self.factor.solve(self.system.gradient(of_pairs, self.T_i_j))
            assert follow is not None, "the system is finite"
            motion.append(follow)
        relative = np.stack([self._relative(follow) for follow in motion], 2)
        return np.array(motion), np.concatenate([relative, columns], 1)

    @cached_property
    def _step(self) -> Float64:
        """Motion (P, 6) of the relative poses to their optimum without changes of the errors."""
        step = self.factor.step()
        assert step is not None, "the system is finite"
        return self._relative(step)

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
