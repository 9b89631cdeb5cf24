"""Loops of consecutive views: the drift over them, without and with errors of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.refinement.joint_alignment import (
    AlignedViews,
    RefinedViews,
    align_pairs,
    align_views,
    spread_evenly,
)
from tofuse.engine.stored_views import SampledView, pair_equations
from tofuse.engine.stored_views import pair_equation_kernels as kernels

# Iterations of an estimate of camera errors, which may be far from the initial poses.
COARSE_TO_FINE = (
    pair_equations.Round(2, 0.02, 0.1),
    pair_equations.Round(2, 0.005, 0.03),
    pair_equations.Round(12, 0.0, 0.0),
)
# This many points of pairs determine errors that all views share: of more, up to every n-th point
# is used, and then fewer pairs.
_MAX_POINTS, _MAX_STRIDE = 250_000, 3
# Change of an error, in units of 1 % and 1 cm, below which its estimate has converged.
_CONVERGED = 0.05
# A loop is closed if its error is below this, m and rad.
_MAX_CLOSURE_ERROR = (0.01, np.radians(0.5))
# Secant steps to the error that closes a loop: their maximum number; and the change at convergence,
# and an implausible error, relative to the first one.
_MAX_SECANT_STEPS, _CONVERGENCE, _IMPLAUSIBLE = 4, 0.05, 10.0


def thinned(
    views: Sequence[SampledView], pairs: Intp, options: pair_equations.RefineOptions
) -> tuple[list[SampledView], Intp, pair_equations.RefineOptions]:
    """Return as many points and pairs (M, 2) as estimates of shared errors need, and options.

    The errors of patches are not modelled, and `rounds` are coarse to fine.
    """
    count = len(pairs) * options.points
    stride = min(max(-(-count // _MAX_POINTS), 1), _MAX_STRIDE)
    if count > stride * _MAX_POINTS:
        pairs = spread_evenly(pairs, -(-options.neighbours * stride * _MAX_POINTS // count))
    thinned_options = replace(
        options, rounds=COARSE_TO_FINE, shared=0.0, error_convergence=_CONVERGED
    )
    return [v.with_points(np.s_[::stride]) for v in views], pairs, thinned_options


@dataclass(frozen=True)
class Gap:
    """A loop of views of which consecutive ones overlap, and the two ends too.

    `before` and `after` are its closure errors (m, rad) by pairwise alignments, without and with
    the estimated errors of the camera, and `change` is the motion from one to the other. `depth` is
    that of the views, m.
    """

    i: int
    j: int
    before: tuple[float, float]
    after: tuple[float, float]
    depth: float = 0.0
    change: tuple[float, float] = (0.0, 0.0)

    @property
    def remaining_m(self) -> float:
        """Distance by which `after` moves points at the views' depth, m."""
        return self._apparent_m(*self.after)

    def _apparent_m(self, m: float, rad: float) -> float:
        return m + self.depth * rad

    @property
    def closes(self) -> bool:
        """Whether the estimated errors explain it: one part is halved, the other is not larger.

        Or points at the views' depth move by less than half the distance. A gap of less than a
        centimetre and half a degree is not significant, as not every error bends every path.
        """
        apparent = self._apparent_m(*self.before)
        limit = self._apparent_m(*_MAX_CLOSURE_ERROR)
        if self.depth and self.remaining_m < 0.5 * apparent and apparent > limit:
            return True
        parts = list(zip(self.before, self.after, _MAX_CLOSURE_ERROR, strict=True))
        if any(b > max(a, limit) for a, b, limit in parts):
            return False
        return all(a < limit for a, _, limit in parts) or any(b < 0.5 * a for a, b, _ in parts)

    @property
    def significant(self) -> bool:
        """Whether it is more than noise."""
        return any(a >= limit for a, limit in zip(self.before, _MAX_CLOSURE_ERROR, strict=True))

    @property
    def confirms(self) -> bool:
        """Whether it closes, or shrinks as by the removal of a true error, but for noise.

        Noise leaves a gap beside true errors: their removal makes the square of the gap smaller by
        that of the change, in the mean. Errors that are not there make it larger by as much.
        """
        before, change = self._apparent_m(*self.before), self._apparent_m(*self.change)
        shrinks = before**2 - self.remaining_m**2 > 0.5 * change**2
        return self.closes or (shrinks and self._is_changed)

    @property
    def contradicts(self) -> bool:
        """Whether the estimated errors change it much without confirming them, or widen it.

        Errors of the camera hardly change the gap of a short loop, which does not reveal them.
        """
        is_against = (self._is_changed and not self.confirms) or self.widens
        return self.significant and not self.closes and is_against

    @property
    def grows(self) -> bool:
        """Whether the estimated errors make it larger at all."""
        return self.remaining_m > self._apparent_m(*self.before)

    @property
    def _is_changed(self) -> bool:
        return self._apparent_m(*self.change) > 0.5 * self._apparent_m(*self.before)

    @property
    def widens(self) -> bool:
        """Whether the estimated errors make it larger, by more than noise."""
        limit = self._apparent_m(*_MAX_CLOSURE_ERROR)
        return self.remaining_m > self._apparent_m(*self.before) + limit


def loop_gap(without_errors: RefinedViews, poses: Float64, errors: Float64) -> Gap | None:
    """Closure errors of the longest loop, without and with errors of the camera; None without one.

    Parameters
    ----------
    without_errors
        Result without errors of the camera.
    poses, errors
        (N, 4, 4) and (ERRORS,) result with them.
    """
    loop = Loop.longest(without_errors)
    if loop is None:
        return None
    without = loop.aligned(loop.steps(without_errors.refined.poses), np.zeros(kernels.ERRORS))
    return loop.gap(without, loop.aligned(loop.steps(poses), errors))


@dataclass(frozen=True, eq=False)
class Loop:
    """A chain of overlapping consecutive views i to j, of which the ends overlap too."""

    of: RefinedViews
    i: int
    j: int

    @classmethod
    def longest(cls, of: RefinedViews) -> Loop | None:
        """Return the longest loop of refined views; None if there is none."""
        ends = longest_loop(of.refined.pairs)
        return None if ends is None else cls(of, *ends)

    @property
    def depth(self) -> float:
        """Median depth of the two ends, m."""
        return 0.5 * (self.of.views[self.i].depth + self.of.views[self.j].depth)

    def steps(self, poses: Float64) -> Float64:
        """Return the relative poses (M, 4, 4) of consecutive views, and last that of the ends."""
        first, second = self._pairs.T
        return np.asarray(se3.inverse(poses[first]) @ poses[second], np.float64)

    def aligned(self, steps: Float64, errors: Float64) -> Float64:
        """Return the `steps`, each aligned separately with assumed (ERRORS,) of the camera."""
        of = self.of
        return align_pairs(of.views, self._pairs, steps, of.options, errors, of.refined.scales)

    @property
    def _pairs(self) -> Intp:
        i, j = self.i, self.j
        chain = np.stack([np.arange(i, j), np.arange(i + 1, j + 1)], 1)
        return np.concatenate([chain, [[i, j]]])

    def estimate_by_views(self, steps: Float64, error_index: int, error: float) -> AlignedViews:
        """Estimate an error of the camera by all views of the loop, starting from one.

        A true error is confirmed, even if residuals at a wrong one are small. An error that only
        closes the gap differs from the one that the views measure.

        Parameters
        ----------
        steps
            Aligned with the error.
        error_index, error
            Index of the error, and its initial value.
        """
        errors = np.zeros(kernels.ERRORS)
        errors[error_index] = error
        of, pairs = self.of, self.of.refined.pairs
        inside = ((pairs >= self.i) & (pairs <= self.j)).all(1)
        views, pairs, options = thinned(
            of.views[self.i : self.j + 1], pairs[inside] - self.i, of.options
        )
        chain = np.array(_chained(steps))
        return align_views(
            views, chain, options, calibrate=[error_index], errors=errors, pairs=pairs
        )

    def gap(self, before: Float64, after: Float64) -> Gap:
        """Return the gap, given steps aligned without and with errors of the camera."""
        first, last = (self.of.views[k].index for k in (self.i, self.j))
        without, corrected = _closure_error(before), _closure_error(after)
        change = _norms(se3.inverse(without) @ corrected)
        return Gap(first, last, _norms(without), _norms(corrected), self.depth, change)

    def closing_error(
        self, uncorrected: Float64, error_index: int, step: float
    ) -> tuple[float, Float64]:
        """Return the error of the camera that closes the loop best, and steps aligned with it.

        Gauss-Newton on the gap at the views' depth, with derivatives by secants.

        Parameters
        ----------
        uncorrected
            Steps aligned without errors of the camera.
        error_index
            Index of the error.
        step
            First secant step.
        """
        scale = np.r_[np.full(3, 1 / self.depth), np.ones(3)]
        errors = np.zeros(kernels.ERRORS)
        previous_error, residual = 0.0, se3.log(_closure_error(uncorrected)) * scale
        error, steps = step, uncorrected
        for _ in range(_MAX_SECANT_STEPS):
            errors[error_index] = error
            steps = self.aligned(steps, errors)
            previous_residual, residual = residual, se3.log(_closure_error(steps)) * scale
            slope = (residual - previous_residual) / (error - previous_error)
            previous_error = error
            error -= float(slope @ residual) / max(float(slope @ slope), 1e-12)
            if (
                abs(error - previous_error) < _CONVERGENCE * step
                or abs(error) > _IMPLAUSIBLE * step
            ):
                break
        return previous_error, steps


def _chained(steps: Float64) -> list[Float64]:
    """Return the poses (4, 4) of the chain's views, relative to its first."""
    return list(accumulate(steps[:-1], np.matmul, initial=np.eye(4)))


def _closure_error(steps: Float64) -> Float64:
    """Return the motion (4, 4) by which the chain fails to reach its end."""
    return np.asarray(se3.inverse(steps[-1]) @ _chained(steps)[-1], np.float64)


def _norms(T: Float64) -> tuple[float, float]:
    length, angle = se3.lengths(T).tolist()
    return length, angle


def longest_loop(pairs: Intp) -> tuple[int, int] | None:
    """The pair (i, j) furthest apart in time between which all consecutive views overlap."""
    if not len(pairs):
        return None
    overlapping = np.zeros(int(pairs.max()) + 1, bool)
    overlapping[pairs[pairs[:, 1] == pairs[:, 0] + 1, 0]] = True
    breaks = np.concatenate([[0], np.cumsum(~overlapping)])
    i, j = pairs.T
    unbroken = (breaks[j] == breaks[i]) & (j > i + 1)
    if not unbroken.any():
        return None
    k = int(np.argmax(np.where(unbroken, j - i, -1)))
    return int(i[k]), int(j[k])
