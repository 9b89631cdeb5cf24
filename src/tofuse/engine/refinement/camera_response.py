"""Response of refined views to errors of the camera that all of them share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.refinement.joint_alignment import DAMPING, Priors, weak_prior
from tofuse.engine.stored_views import SampledView, pair_equations
from tofuse.engine.stored_views import pair_equation_kernels as kernels


@dataclass(frozen=True, eq=False)
class Response:
    """Sensitivity of each pair to single errors of the camera, all poses being free to follow.

    Attributes
    ----------
    gradient, information
        (M, ERRORS) of each pair i < j, both directions together: first and second derivative of its
        robust cost (Tukey's biweight) at zero error.
    motion
        (ERRORS, N, 6) twist by which each pose follows, per unit of the error.
    """

    gradient: Float64
    information: Float64
    motion: Float64

    def estimate(self) -> Float64:
        """(ERRORS,) estimate of each error alone, by one Newton step."""
        return np.asarray(
            -self.gradient.sum(0) / np.maximum(self.information.sum(0), 1e-12), np.float64
        )

    def sigma(self, pairs: Intp, view_count: int) -> Float64:
        """(ERRORS,) standard deviations, from the scatter between views (sandwich estimator).

        It includes noise that neighbouring pixels share and errors of single views, but not errors
        that all views have in common.

        Parameters
        ----------
        pairs
            (M, 2) positions of the views.
        view_count
            Number of views.
        """
        residual_gradient = self.gradient + self.information * self.estimate()
        view_gradient = np.zeros((view_count, residual_gradient.shape[1]))
        for ends in pairs.T:
            np.add.at(view_gradient, ends, residual_gradient)
        # One degree of freedom is lost, as the estimate is that of the same views.
        scatter = np.sqrt((view_gradient**2).sum(0) * view_count / max(view_count - 1, 1))
        return np.asarray(scatter / np.maximum(self.information.sum(0), 1e-12), np.float64)


def response(
    views: Sequence[SampledView],
    poses: Float64,
    pairs: Intp,
    options: pair_equations.RefineOptions,
    *,
    priors: Priors | None = None,
) -> Response:
    """Compute the sensitivity of refined views to errors of the camera that they share.

    Parameters
    ----------
    views, options
        As for `refine`.
    poses
        (N, 4, 4) T_world_camera, refined without any error.
    pairs
        (M, 2) positions of views i < j.
    priors
        Measurements by other sensors.
    """
    priors = priors or Priors.none()
    zero_errors, estimate_all = np.zeros(kernels.ERRORS), np.zeros(kernels.ERRORS, np.int64)
    stage = options.rounds[-1]
    state = pair_equations.directed_pairs(views, pairs, options)
    system = priors.system(len(views), np.stack([state.target, state.source], 1))
    pair_equations.evaluate(
        views, poses, zero_errors, np.ones_like(estimate_all), state, stage, options
    )
    pair_equations.without_exposure(state)
    pair_equations.rescale(state, stage, options)
    pair_equations.evaluate(views, poses, zero_errors, estimate_all, state, stage, options)
    H, g = pair_equations.without_exposure(state)
    prior_count = len(priors.pairs)
    i, j = system.pairs.T
    T_i_j = se3.inverse(poses[i]) @ poses[j]
    prior_H, prior_g = priors.equations(T_i_j[len(H) :])
    n = len(poses)
    matrix, gradient = system.relative(
        np.concatenate([H[:, :6, :6], prior_H]),
        np.concatenate([g[:, :6], prior_g]),
        T_i_j,
        weak_prior(n),
    )
    factor = system.factor(matrix, gradient, DAMPING)
    assert factor is not None, "every pose has a prior, so the system is not singular"
    A = se3.adjoint(se3.inverse(T_i_j[: len(H)]))

    def relative(step: Float64) -> Float64:
        return step[state.source] - (A @ step[state.target][..., None])[..., 0]

    initial_step = factor.step()
    assert initial_step is not None, "the system is finite"
    initial_motion = relative(initial_step)
    slope = g[:, :6] + (H[:, :6, :6] @ initial_motion[..., None])[..., 0]
    first, second = np.empty((len(H), kernels.ERRORS)), np.empty((len(H), kernels.ERRORS))
    motion = np.empty((kernels.ERRORS, n, 6))
    for k in range(kernels.ERRORS):
        mixed = H[:, :6, 6 + k]
        column = system.gradient(np.concatenate([mixed, np.zeros((prior_count, 6))]), T_i_j)
        follow = factor.solve(column)
        assert follow is not None, "the system is finite"
        motion[k] = follow
        relative_motion = relative(motion[k])
        first[:, k] = (
            g[:, 6 + k] + (mixed * initial_motion).sum(1) + (slope * relative_motion).sum(1)
        )
        second[:, k] = H[:, 6 + k, 6 + k] + 2 * (mixed * relative_motion).sum(1)
        second[:, k] += np.einsum("mi,mij,mj->m", relative_motion, H[:, :6, :6], relative_motion)
    # Reweighted least squares holds the weights constant, and their curvature exceeds that of the
    # cost. A single step with it falls short, and a sandwich estimate by it is too small (Huber
    # 1981, Robust Statistics, section 3.2: the mean of psi').
    second *= tukey.consistency(options.robust)
    half = len(pairs)
    return Response(first[:half] + first[half:], second[:half] + second[half:], motion)
