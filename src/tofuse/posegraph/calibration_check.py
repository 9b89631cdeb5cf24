"""Self-calibration check: whether all views together indicate an error of the camera.

A wrong focal length or principal point, neglected lens distortion or a depth offset bends the
trajectory, and no single registration reveals it.
But where views overlap, and above all where a path closes a loop, their residuals can't all be
small. So each error is estimated separately, with all poses free. An error that makes the views
more consistent is a proposal. It is an alarm if it exceeds the calibration error of usual
cameras, and if it closes a loop that pairwise alignments of neighbours leave open.

The focal length stands for other errors too: a constant offset of the depth has much the same
effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.geometry import se3
from tofuse.kernels import pair_equations as kernels
from tofuse.posegraph.camera_response import response
from tofuse.posegraph.joint_alignment import (
    AlignedViews,
    Refined,
    align_pairs,
    align_views,
    refine,
    spread_evenly,
)
from tofuse.posegraph.pair_equations import RefineOptions, Round
from tofuse.posegraph.pose_priors import Priors
from tofuse.posegraph.split_half import aligned_motion
from tofuse.posegraph.view_store import SampledView

# Multipath and mixed pixels look like an error of the focal length of up to a percent; cameras are
# calibrated to better than that. Makers specify depth offsets of up to a centimetre.
TOLERANCES = {
    "focal": 0.01,
    "offset": 0.01,
    "center_x": 0.01,
    "center_y": 0.01,
    "distortion": 0.01,
}
# Errors that the drift over a loop can reveal; that by the others resembles any drift.
_REVEALED_BY_LOOP = ("focal", "offset")
# Significance of an error in standard deviations, for an alarm and for a full estimate; and the
# fraction of the tolerance that one Newton step must reach for the latter.
_SIGNIFICANT, _LIKELY, _MIN_FIRST_STEP = 4.0, 2.5, 0.2
# A loop is closed if its error is below this, m and rad.
_MAX_CLOSURE_ERROR = (0.01, np.radians(0.5))
# Errors with a larger standard deviation, as a fraction of the tolerance, are not reported.
_MAX_SIGMA = 0.8
# Change of the views' support that the sampling of points alone explains.
_SUPPORT_NOISE = 0.003
# Secant steps to the error that closes a loop: their maximum number; the first one, relative to the
# tolerance; and the change at convergence, and an implausible error, relative to the first one.
_MAX_SECANT_STEPS, _FIRST_STEP, _CONVERGENCE, _IMPLAUSIBLE = 4, 2.0, 0.05, 10.0
# An error that only the drift over the loop reveals must exceed the tolerance by this factor; and
# the fraction of it that the views must confirm, as they may measure another one.
_LOOP_FACTOR, _MIN_CONFIRMED = 2.0, 0.5
# Minimum number of views from which their spread is estimated.
_MIN_VIEWS = 8
_DELTA = 1e-3  # error of the camera for numerical differentiation
_INDEX = {
    "focal": kernels.FOCAL,
    "offset": kernels.OFFSET,
    "center_x": kernels.CENTER_X,
    "center_y": kernels.CENTER_Y,
    "distortion": kernels.DISTORTION,
}
# The solution may be far from the initial poses.
_ROUNDS = (Round(2, 0.02, 0.1), Round(2, 0.005, 0.03), Round(4, 0.0, 0.0))
# This many pairs determine errors that all views share; larger sets are subsampled to about as
# many, with every n-th point.
_MAX_PAIRS, _POINT_STRIDE = 500, 3


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
    def contradicts(self) -> bool:
        """Whether the estimated errors change it much without closing it, or widen it.

        Errors of the camera hardly change the gap of a short loop, which does not reveal them.
        """
        before = self._apparent_m(*self.before)
        changes = self._apparent_m(*self.change) > 0.5 * before
        widens = self.remaining_m > before + self._apparent_m(*_MAX_CLOSURE_ERROR)
        return self.significant and not self.closes and (changes or widens)


@dataclass(frozen=True)
class CalibrationCheck:
    """Evidence of the views for errors of the camera that all of them share.

    Attributes
    ----------
    alarm
        Whether the camera's calibration should be checked.
    errors, sigmas
        Separate estimates of each error, as in `Refinement.errors`, and their standard deviations
        from the spread between views. They are proposals and change nothing. Only significant
        ones; in case of an alarm, all that the views determine.
    support
        Mean support of the views without and with the error `best`, see `joint_alignment.Support`.
    gap
        Closure error of the longest loop; None if there is none, or no error is significant.
    best
        Name of the largest error when all significant ones are estimated together, relative to
        its tolerance; empty if no error is significant.
    focal_sigma
        Standard deviation of the focal length estimated from the views, as a fraction; None if
        there are too few views.
    motion
        Rms motion (m, rad) of the poses, after alignment, that a unit of each error causes.
    moved
        Rms motion (m, rad) of the poses, after alignment, if the likely errors are corrected
        together; if none is likely, the largest motion by the estimate of one that the views
        determine.
    """

    alarm: bool = False
    errors: dict[str, float] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    support: tuple[float, float] | None = None
    gap: Gap | None = None
    best: str = ""
    focal_sigma: float | None = None
    motion: dict[str, tuple[float, float]] = field(default_factory=dict)
    moved: tuple[float, float] = (0.0, 0.0)

    @property
    def undetermined(self) -> bool:
        """Whether a wrong focal length would not show in this recording."""
        return self.focal_sigma is not None and not _determined("focal", self.focal_sigma)

    @property
    def unconfirmed(self) -> dict[str, float]:
        """Significant errors without an alarm that may be true.

        Either one of them is large, and no loop confirms or contradicts it, or the views agree
        better with the smaller ones.
        """
        if self.alarm or (self.gap is not None and self.gap.contradicts):
            return {}
        if not self.large and not self.improves:
            return {}
        return {n: e for n, e in self.errors.items() if abs(e) > _SIGNIFICANT * self._sigma(n)}

    @property
    def improves(self) -> bool:
        """Whether the views agree better with the error `best`, not by chance."""
        return self.support is not None and self.support[1] - self.support[0] > _SUPPORT_NOISE

    @property
    def large(self) -> dict[str, float]:
        """Significant errors that exceed the calibration error of usual cameras."""
        return {n: e for n, e in self.errors.items() if _large(n, e, self._sigma(n))}

    def _sigma(self, name: str) -> float:
        return self.sigmas.get(name, np.inf)


def _determined(name: str, sigma: float) -> bool:
    return sigma < _MAX_SIGMA * TOLERANCES[name]


def _large(name: str, error: float, sigma: float, factor: float = 1.0) -> bool:
    return abs(error) > max(factor * TOLERANCES[name], _SIGNIFICANT * sigma)


def check_calibration(
    views: Sequence[SampledView], refined: Refined, options: RefineOptions, priors: Priors
) -> CalibrationCheck:
    """Estimate the errors of the camera from refined views.

    Parameters
    ----------
    views, refined, options, priors
        Of the joint alignment without errors of the camera, see `refine`.
    """
    pairs, poses = refined.pairs, refined.poses
    if not len(pairs) or len(views) < _MIN_VIEWS:
        return CalibrationCheck()
    sensitivity = response(views, poses, pairs, options, priors=priors)
    estimate, sigma = sensitivity.estimate(), sensitivity.sigma(pairs, len(views))
    determined = [name for name, k in _INDEX.items() if _determined(name, sigma[k])]
    motion = {name: _motion(poses, sensitivity.motion[k]) for name, k in _INDEX.items()}
    motions = [np.array(motion[n]) * abs(float(estimate[_INDEX[n]])) for n in determined]
    without_error = CalibrationCheck(
        focal_sigma=float(sigma[kernels.FOCAL]),
        motion=motion,
        moved=tuple(max(motions, key=lambda m: m[0], default=np.zeros(2)).tolist()),
    )
    likely = [
        name
        for name in determined
        if abs(estimate[_INDEX[name]])
        > max(_LIKELY * sigma[_INDEX[name]], _MIN_FIRST_STEP * TOLERANCES[name])
    ]
    sigmas = {name: float(sigma[_INDEX[name]]) for name in determined}
    by_loop = partial(_check_by_loop, views, refined, sigmas, without_error, options)
    if not likely:
        return by_loop()
    sampled_views, sampled_pairs = list(views), pairs
    if len(pairs) > _MAX_PAIRS:
        sampled_views = [v.with_points(np.s_[::_POINT_STRIDE]) for v in views]
        sampled_pairs = spread_evenly(pairs, -(-options.neighbours * _MAX_PAIRS // len(pairs)))
    coarse_to_fine = replace(options, rounds=_ROUNDS)

    def refine_with(name: str) -> Refined:
        # The overlaps are fixed; the poses are re-estimated.
        error_index = [_INDEX[name]]
        return refine(
            sampled_views,
            poses,
            coarse_to_fine,
            calibrate=error_index,
            priors=priors,
            pairs=sampled_pairs,
        )

    estimates = {name: refine_with(name) for name in likely}
    joint: Refined | AlignedViews = estimates[likely[0]]
    if len(likely) > 1:  # errors are correlated: in a joint estimate, the true one remains
        joint = align_views(
            sampled_views,
            poses,
            coarse_to_fine,
            calibrate=[_INDEX[name] for name in likely],
            priors=priors,
            pairs=sampled_pairs,
        )
    best_name = max(likely, key=lambda name: abs(joint.errors[_INDEX[name]]) / TOLERANCES[name])
    best = estimates[best_name]
    large = any(
        _large(name, result.errors[_INDEX[name]], sigma[_INDEX[name]])
        for name, result in estimates.items()
    )
    best_index = _INDEX[best_name]
    certain = abs(best.errors[best_index]) > _SIGNIFICANT * sigma[best_index]
    improves = certain and _support_gain(best, views) > _SUPPORT_NOISE
    gap = None
    if large or improves:
        gap = loop_gap(views, refined, best.poses, best.errors, options)
    # Multipath has the same effect as a smaller error: views agree better, and a loop closes.
    alarm = large and improves and gap is not None and gap.closes
    if alarm:  # alternative explanations
        estimates |= {name: refine_with(name) for name in determined if name not in estimates}
    elif (loop_check := by_loop()).alarm:
        return loop_check
    support = float(best.before.of_views(len(views)).mean())
    position, rotation = aligned_motion(poses, joint.poses)
    return replace(
        without_error,
        alarm=alarm,
        errors={
            name: float(estimates[name].errors[k])
            for name, k in _INDEX.items()
            if name in estimates
        },
        sigmas={name: sigmas[name] for name in _INDEX if name in estimates},
        support=(support, support + _support_gain(best, views)),
        gap=gap,
        best=best_name,
        moved=(_rms(position), _rms(rotation)),
    )


def combine_checks(checks: Sequence[CalibrationCheck]) -> CalibrationCheck:
    """Combine the checks of the submaps of one recording.

    They share the camera, so a true error is detected in most of them. Of the alarms, that with the
    median error is returned.
    """
    alarms = sorted((s for s in checks if s.alarm), key=lambda s: s.errors.get(s.best, 0.0))
    if 2 * len(alarms) > len(checks):
        return alarms[len(alarms) // 2]
    without_alarm = [s for s in checks if not s.alarm]
    # One submap that determines the camera represents all of them.
    without_alarm.sort(key=lambda s: (s.gap is None, s.undetermined))
    return without_alarm[0] if without_alarm else CalibrationCheck()


def _rms(vectors: Float64) -> float:
    return float(np.sqrt((vectors**2).sum(1).mean()))


def _motion(poses: Float64, twists: Float64) -> tuple[float, float]:
    """Return the rms motion (m, rad) per unit, given small twists (N, 6) per unit."""
    position, rotation = aligned_motion(poses, poses @ se3.exp(_DELTA * twists))
    return _rms(position) / _DELTA, _rms(rotation) / _DELTA


def _support_gain(refined: Refined, views: Sequence[SampledView]) -> float:
    n = len(views)
    return float(refined.after.of_views(n).mean() - refined.before.of_views(n).mean())


def loop_gap(
    views: Sequence[SampledView],
    refined: Refined,
    poses: Float64,
    errors: Float64,
    options: RefineOptions,
) -> Gap | None:
    """Closure errors of the longest loop, without and with errors of the camera; None without one.

    Parameters
    ----------
    views, options
        As for `refine`.
    refined
        Result without errors of the camera.
    poses, errors
        (N, 4, 4) and (ERRORS,) result with them.
    """
    loop = _Loop.longest(views, refined, options)
    if loop is None:
        return None
    without = loop.closure_error(refined.poses, np.zeros(kernels.ERRORS))
    return loop.gap(without, loop.closure_error(poses, errors))


@dataclass(frozen=True, eq=False)
class _Loop:
    """A chain of overlapping consecutive views i to j, of which the ends overlap too."""

    views: Sequence[SampledView]
    i: int
    j: int
    options: RefineOptions

    @classmethod
    def longest(
        cls, views: Sequence[SampledView], refined: Refined, options: RefineOptions
    ) -> _Loop | None:
        """Return the longest loop of refined views; None if there is none."""
        ends = longest_loop(refined.pairs)
        return None if ends is None else cls(views, *ends, options)

    @property
    def depth(self) -> float:
        """Median depth of the two ends, m."""
        return 0.5 * (self.views[self.i].depth + self.views[self.j].depth)

    def closure_error(self, poses: Float64, errors: Float64) -> Float64:
        """Return the motion (4, 4) by which chained pairwise alignments fail to close the loop.

        Parameters
        ----------
        poses
            (N, 4, 4) T_world_camera, where the alignments start.
        errors
            (ERRORS,) assumed errors of the camera.
        """
        return self.align_chain(poses, errors)[0]

    def align_chain(self, poses: Float64, errors: Float64) -> tuple[Float64, Float64]:
        """Return `closure_error`, and the chain's poses (j - i + 1, 4, 4) relative to its first."""
        i, j = self.i, self.j
        chain = np.stack([np.arange(i, j), np.arange(i + 1, j + 1)], 1)
        pairs = np.concatenate([chain, [[i, j]]])
        T = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
        T = align_pairs(self.views, pairs, T, self.options, errors)
        chained = [np.eye(4)]
        for step in T[:-1]:
            chained.append(chained[-1] @ step)
        return np.asarray(se3.inverse(T[-1]) @ chained[-1], np.float64), np.array(chained)

    def error_by_views(self, poses: Float64, error_index: int, error: float) -> float:
        """Return an error of the camera as all views of the loop estimate it, starting from one.

        A true error is confirmed, even if residuals at a wrong one are small. An error that only
        closes the gap differs from the one that the views measure.

        Parameters
        ----------
        poses
            As for `closure_error`.
        error_index, error
            Index of the error, and its initial value.
        """
        errors = np.zeros(kernels.ERRORS)
        errors[error_index] = error
        chain = self.align_chain(poses, errors)[1]
        options = replace(self.options, rounds=_ROUNDS)
        views = self.views[self.i : self.j + 1]
        aligned = align_views(views, chain, options, calibrate=[error_index], errors=errors)
        return float(aligned.errors[error_index])

    def gap(self, before: Float64, after: Float64) -> Gap:
        """Return the gap, given `closure_error` without and with errors of the camera."""
        first, last = (self.views[k].index for k in (self.i, self.j))
        change = se3.inverse(before) @ after
        return Gap(first, last, _norms(before), _norms(after), self.depth, _norms(change))

    def closing_error(
        self, poses: Float64, uncorrected: Float64, error_index: int, step: float
    ) -> tuple[float, Float64]:
        """Return the error of the camera that closes the loop best, and `closure_error` with it.

        Gauss-Newton on the gap at the views' depth, with derivatives by secants.

        Parameters
        ----------
        poses
            As for `closure_error`.
        uncorrected
            (4, 4) `closure_error` without errors of the camera.
        error_index
            Index of the error.
        step
            First secant step.
        """
        scale = np.r_[np.full(3, 1 / self.depth), np.ones(3)]
        errors = np.zeros(kernels.ERRORS)
        previous_error, residual = 0.0, se3.log(uncorrected) * scale
        error = step
        for _ in range(_MAX_SECANT_STEPS):
            errors[error_index] = error
            closure = self.closure_error(poses, errors)
            previous_residual, residual = residual, se3.log(closure) * scale
            slope = (residual - previous_residual) / (error - previous_error)
            previous_error = error
            error -= float(slope @ residual) / max(float(slope @ slope), 1e-12)
            if (
                abs(error - previous_error) < _CONVERGENCE * step
                or abs(error) > _IMPLAUSIBLE * step
            ):
                break
        return previous_error, closure


def _norms(T: Float64) -> tuple[float, float]:
    return float(np.linalg.norm(T[:3, 3])), float(se3.angle(T))


def _check_by_loop(
    views: Sequence[SampledView],
    refined: Refined,
    sigmas: Mapping[str, float],
    without_error: CalibrationCheck,
    options: RefineOptions,
) -> CalibrationCheck:
    """Estimate the errors of the camera from the drift over the longest loop alone.

    A large error leaves a gap that a refinement may close by matching wrong surfaces. Then its
    residuals reveal nothing. Pairwise alignments from the poses before it don't depend on it. But
    any drift leaves a gap that some error of the camera nearly closes: the views must confirm the
    error.

    Parameters
    ----------
    views, refined, options
        As for `check_calibration`.
    sigmas
        Standard deviations of the errors that the views determine.
    without_error
        The result if there is no error.
    """
    loop = _Loop.longest(views, refined, options)
    if loop is None:
        return without_error
    poses = refined.start
    uncorrected = loop.closure_error(poses, np.zeros(kernels.ERRORS))
    if not loop.gap(uncorrected, uncorrected).significant:
        return without_error
    candidates: dict[str, tuple[float, Gap]] = {}
    for name in (name for name in _REVEALED_BY_LOOP if name in sigmas):
        step = _FIRST_STEP * TOLERANCES[name]
        error, corrected = loop.closing_error(poses, uncorrected, _INDEX[name], step)
        gap = loop.gap(uncorrected, corrected)
        if not (gap.closes and _large(name, error, sigmas[name], _LOOP_FACTOR)):
            continue
        confirmed = loop.error_by_views(poses, _INDEX[name], error)
        if (
            _large(name, confirmed, sigmas[name], _LOOP_FACTOR)
            and confirmed / error > _MIN_CONFIRMED
        ):
            candidates[name] = error, gap
    if not candidates:
        return without_error
    best = min(candidates, key=lambda name: candidates[name][1].remaining_m)
    return replace(
        without_error,
        alarm=True,
        errors={name: error for name, (error, _) in candidates.items()},
        sigmas={name: sigmas[name] for name in candidates},
        gap=candidates[best][1],
        best=best,
    )


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


def in_words(errors: Mapping[str, float]) -> list[str]:
    """Describe the correction of each error of the camera, as in `CalibrationCheck`, in words."""
    words = []
    if "focal" in errors:
        change = 1 / (1 + errors["focal"]) - 1
        more = "larger" if change > 0 else "smaller"
        words.append(f"a focal length {abs(change):.1%} {more}")
    if "offset" in errors:
        more = "longer" if errors["offset"] > 0 else "shorter"
        words.append(f"ranges {abs(errors['offset']) * 1e3:.0f} mm {more}")
    for name, (less, more) in {"center_x": ("left", "right"), "center_y": ("up", "down")}.items():
        if name in errors:
            # A larger ray coordinate of a pixel is a principal point further left or up.
            where = less if errors[name] > 0 else more
            words.append(
                f"a principal point {abs(errors[name]):.1%} of the focal length further {where}"
            )
    if "distortion" in errors:
        kind = "barrel" if errors["distortion"] > 0 else "pincushion"
        words.append(f"{abs(errors['distortion']):.1%} more {kind} distortion at 45 degrees")
    return words
