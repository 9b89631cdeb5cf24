"""Self-calibration check: whether all views together indicate an error of the camera.

A wrong focal length or principal point, neglected lens distortion or a depth offset bends the
trajectory, and no single registration reveals it. But where views overlap, and above all where a
path closes a loop, their residuals can't all be small. So each error is estimated separately, with
all poses free. An error that makes the views more consistent is a proposal. It is an alarm if it
exceeds the calibration error of usual cameras, sections of the images agree on it, and the gap of a
loop by pairwise alignments of neighbours does not grow with it, or, for focal length and offset,
confirms it.

The focal length stands for other errors too: a constant offset of the depth has much the same
effect. A camera whose range changes has no single calibration: see `range_change`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.quantities import length, percent
from tofuse.engine.refinement.camera_response import (
    SECTIONS,
    SIGNIFICANT,
    Linearised,
    significance_of,
)
from tofuse.engine.refinement.joint_alignment import (
    AlignedViews,
    Priors,
    RefinedViews,
    align_views,
    mean_support,
)
from tofuse.engine.refinement.loop_drift import COARSE_TO_FINE, Gap, Loop, loop_gap, thinned
from tofuse.engine.refinement.range_change import (
    LikelyChange,
    RangeChange,
    likely_change,
    range_change,
)
from tofuse.engine.refinement.split_half import rms_motion
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.stored_views import pair_equations

# Multipath and mixed pixels look like an error of the focal length of up to a percent; cameras are
# calibrated to better than that. Makers specify depth offsets of up to a centimetre.
TOLERANCES = {
    "focal": 0.01,
    "offset": 0.01,
    "center_x": 0.01,
    "center_y": 0.01,
    "distortion": 0.01,
}
# What they are errors of.
QUANTITIES = {
    "focal": "focal length",
    "offset": "depth offset",
    "center_x": "principal point",
    "center_y": "principal point",
    "distortion": "distortion",
}
# Errors that the drift over a loop can reveal; that by the others resembles any drift.
_REVEALED_BY_LOOP = ("focal", "offset")
# Significance of an error in standard deviations that makes a full estimate worth its time, and
# the fraction of the tolerance that one Newton step must reach.
_LIKELY, _MIN_FIRST_STEP = 2.5, 0.2
# Errors with a larger standard deviation, as a fraction of the tolerance, are not reported.
_MAX_SIGMA = 0.8
# Change of the views' support that the sampling of points alone explains.
_SUPPORT_NOISE = 0.003
# An error that only the drift over the loop reveals must exceed the tolerance by this factor, with
# which the search also begins; and the fraction of it that the views must confirm, as they may
# measure another one.
_LOOP_FACTOR, _MIN_CONFIRMED = 2.0, 0.5
# Minimum number of views from which their spread is estimated; of fewer, no error is known.
_MIN_VIEWS = 8
_DELTA = 1e-3  # error of the camera for numerical differentiation
_INDEX = {
    "focal": kernels.FOCAL,
    "offset": kernels.OFFSET,
    "center_x": kernels.CENTER_X,
    "center_y": kernels.CENTER_Y,
    "distortion": kernels.DISTORTION,
}
# Iterations that realign the views without errors.
_REALIGNMENT = (pair_equations.Round(6, 0.0, 0.0),)
# Larger first estimates, as multiples of the tolerance, are sought from coarse to fine.
_MAX_DIRECT = 3.0


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
    estimates
        First estimate of each error alone, by one Newton step, and its standard deviation from the
        spread between views, significant or not.
    motion
        Rms motion (m, rad) of the poses, after alignment, that a unit of each error causes.
    moved
        Largest rms motion (m, rad) of the poses, after alignment, if one of the likely errors is
        corrected, or by the first estimate of one that the views determine or that is significant.
    changed, change_confirmed
        Rms motion (m, rad) of the poses by a change of the range, if that is significant, and
        whether it can't be multipath, see `RangeChange`.
    significance
        Number of standard deviations that an estimate must exceed to be significant, see
        `significance_of`.
    range_change
        Change of the range over the views, if there is one; then no error is estimated.
    contradicted
        Whether verified odometry contradicts the error `best`.
    """

    alarm: bool = False
    errors: dict[str, float] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    support: tuple[float, float] | None = None
    gap: Gap | None = None
    best: str = ""
    focal_sigma: float | None = None
    estimates: dict[str, tuple[float, float]] = field(default_factory=dict)
    motion: dict[str, tuple[float, float]] = field(default_factory=dict)
    moved: tuple[float, float] = (0.0, 0.0)
    changed: tuple[float, float] = (0.0, 0.0)
    change_confirmed: bool = True
    significance: float = SIGNIFICANT
    range_change: RangeChange | None = None
    contradicted: bool = False

    @property
    def undetermined(self) -> dict[str, tuple[float, float]]:
        """Errors that would not show in this recording, and the motion (m, rad) by a usual one."""
        return {
            name: (TOLERANCES[name] * m, TOLERANCES[name] * rad)
            for name, (m, rad) in self.motion.items()
            if not self.determines(name)
        }

    def determines(self, name: str) -> bool:
        """Whether the views determine an error of the camera."""
        return name in self.estimates and _determined(name, self.estimates[name][1])

    @property
    def unconfirmed(self) -> dict[str, float]:
        """Significant errors without an alarm that may be true.

        Either one of them is large, and neither a loop nor odometry confirms or contradicts it, or
        the views agree better with the smaller ones.
        """
        if self.alarm or self.contradicted or (self.gap is not None and self.gap.contradicts):
            return {}
        if not self.large and not self.improves:
            return {}
        return {n: e for n, e in self.errors.items() if abs(e) > self.limit(n)}

    @property
    def is_likely(self) -> bool:
        """Whether the estimated errors may well be true."""
        return bool(self.unconfirmed or (self.improves and self.large and not self.contradicted))

    @property
    def improves(self) -> bool:
        """Whether the views agree better with the error `best`, not by chance."""
        return self.support is not None and self.support[1] - self.support[0] > _SUPPORT_NOISE

    @property
    def large(self) -> dict[str, float]:
        """Significant errors that exceed the calibration error of usual cameras."""
        return {n: e for n, e in self.errors.items() if _large(n, e, self.limit(n))}

    @property
    def confirmed_by_loop(self) -> bool:
        """Whether the gap of a loop confirms the error `best`, or allows for it.

        Multipath looks like a smaller focal length or offset, with which views agree better: a loop
        must confirm that. The others hardly change it, as their drift resembles any other.
        """
        if self.gap is None:
            return False
        return self.gap.confirms if self.best in _REVEALED_BY_LOOP else not self.gap.grows

    def limit(self, name: str) -> float:
        """Return the size of an error from which it is significant."""
        return self.significance * self.sigmas.get(name, np.inf)

    def with_errors(self, errors: Mapping[str, float], first: _FirstEstimates) -> CalibrationCheck:
        """Return the check with these errors, and the deviations of their first estimates."""
        names = [name for name in _INDEX if name in errors]
        sigmas = {name: first.sigmas[name] for name in names}
        return replace(self, errors={name: errors[name] for name in names}, sigmas=sigmas)


def _determined(name: str, sigma: float) -> bool:
    return sigma < _MAX_SIGMA * TOLERANCES[name]


def _large(name: str, error: float, limit: float, factor: float = 1.0) -> bool:
    """Whether an error exceeds its tolerance, and the limit of significance."""
    return abs(error) > max(factor * TOLERANCES[name], limit)


def check_calibration(aligned: RefinedViews) -> CalibrationCheck:
    """Estimate the errors of the camera from views that were refined without such errors."""
    if not len(aligned.refined.pairs):
        return CalibrationCheck()
    first = _FirstEstimates.of(aligned)
    without_error = _by_first_estimates(aligned, first)
    if len(aligned.views) < _MIN_VIEWS or without_error.range_change is not None:
        return without_error
    likely = [name for name in first.determined if first.is_likely(name)]
    if not likely:
        return _check_by_loop(aligned, first, without_error)
    return _check_likely(aligned, first, without_error, likely)


def _by_first_estimates(aligned: RefinedViews, first: _FirstEstimates) -> CalibrationCheck:
    """Return what is known of the camera before any error is estimated in full."""
    significance = significance_of(len(aligned.views))
    if len(aligned.views) < _MIN_VIEWS:
        return CalibrationCheck(motion=first.motion, significance=significance)
    check = CalibrationCheck(
        focal_sigma=first.sigmas["focal"],
        estimates={name: (first.errors[name], first.sigmas[name]) for name in _INDEX},
        motion=first.motion,
        moved=first.largest_motion(significance),
        significance=significance,
    )
    if first.change is None:
        return check
    changed = range_change(first.change, aligned)
    if changed is not None and changed.is_large:
        return replace(check, range_change=changed)
    if not (changed or first.change).is_significant:
        return check
    ratio = abs(changed.change / first.change.scale) if changed else 1.0
    m, rad = first.change_motion
    confirmed = changed is None or changed.confirmed
    return replace(check, changed=(ratio * m, ratio * rad), change_confirmed=confirmed)


def _check_likely(
    aligned: RefinedViews,
    first: _FirstEstimates,
    without_error: CalibrationCheck,
    likely: Sequence[str],
) -> CalibrationCheck:
    """Estimate likely errors in full, and check whether views, loops and odometry confirm them."""
    estimator = _Estimator(aligned, first)
    # Errors are correlated: in a joint estimate, the true one remains.
    subsets = [[name] for name in likely] + ([list(likely)] if len(likely) > 1 else [])
    # In parallel, as solving for the poses is serial.
    found = run_all([partial(estimator.estimate, names) for names in subsets])
    estimates, joint = dict(zip(likely, found, strict=False)), found[-1]
    best_name = max(likely, key=lambda name: abs(joint.errors[_INDEX[name]]) / TOLERANCES[name])
    best = estimates[best_name]
    # Estimated together, correlated errors may be large and opposite.
    largest = max(rms_motion(aligned.refined.poses, e.poses) for e in estimates.values())
    check = replace(
        without_error,
        support=estimator.support_of(best),
        best=best_name,
        moved=max(largest, without_error.moved),
    ).with_errors({name: float(e.errors[_INDEX[name]]) for name, e in estimates.items()}, first)
    certain = abs(check.errors[best_name]) > check.limit(best_name)
    improves = certain and check.improves
    if check.large or improves:
        doubted = estimator.is_contradicted(best)
        contradicted = doubted and aligned.priors.verified
        gap = loop_gap(aligned, best.poses, best.errors)
        check = replace(check, gap=gap, contradicted=contradicted)
        if doubted:  # odometry of unknown errors only prevents an alarm
            return check
    confirmed = best_name in check.large and improves and check.confirmed_by_loop
    if confirmed and _in_all_sections(best, best_name, aligned.priors):  # alternative explanations
        others = [name for name in first.determined if name not in check.errors]
        more = {name: float(estimator.estimate([name]).errors[_INDEX[name]]) for name in others}
        return replace(check.with_errors(check.errors | more, first), alarm=True)
    of_loop = _check_by_loop(aligned, first, without_error)
    return of_loop if of_loop.alarm else check


@dataclass(frozen=True, eq=False)
class _FirstEstimates:
    """Estimates of each error alone by one Newton step, by name.

    Attributes
    ----------
    errors, sigmas
        Estimates and standard deviations.
    follow
        (N, 6) twists by which the poses follow, per unit of each error.
    motion
        As in `CalibrationCheck`.
    change
        Change of the range over the views, if likely.
    change_motion
        Rms motion (m, rad) of the poses that it causes.
    """

    errors: dict[str, float]
    sigmas: dict[str, float]
    follow: dict[str, Float64]
    motion: dict[str, tuple[float, float]]
    change: LikelyChange | None
    change_motion: tuple[float, float]

    @classmethod
    def of(cls, aligned: RefinedViews) -> _FirstEstimates:
        """Estimate all errors."""
        views, poses, pairs = aligned.views, aligned.refined.poses, aligned.refined.pairs
        linearised = Linearised.of(views, poses, pairs, aligned.options, aligned.priors)
        sensitivity = linearised.response_to_errors()
        change = likely_change(linearised, views, pairs) if len(views) >= _MIN_VIEWS else None
        change_motion = 0.0, 0.0
        if change is not None and change.is_significant:
            change_motion = _motion(poses, change.scale * change.follow)
        errors, sigmas = sensitivity.estimate(), sensitivity.sigma(pairs, len(views))
        return cls(
            {name: float(errors[k]) for name, k in _INDEX.items()},
            {name: float(sigmas[k]) for name, k in _INDEX.items()},
            {name: sensitivity.motion[k] for name, k in _INDEX.items()},
            {name: _motion(poses, sensitivity.motion[k]) for name, k in _INDEX.items()},
            change,
            change_motion,
        )

    @property
    def determined(self) -> list[str]:
        """Errors that the views determine."""
        return [name for name in _INDEX if _determined(name, self.sigmas[name])]

    def is_likely(self, name: str) -> bool:
        """Whether a full estimate may be significant."""
        limit = max(_LIKELY * self.sigmas[name], _MIN_FIRST_STEP * TOLERANCES[name])
        return abs(self.errors[name]) > limit

    def largest_motion(self, significance: float) -> tuple[float, float]:
        """Largest rms motion (m, rad) of the poses by an error that the views determine.

        Or by one whose estimate exceeds a number of standard deviations, however large they are.
        """
        sizes = {name: abs(error) for name, error in self.errors.items()}
        motions = [
            (sizes[name] * m, sizes[name] * rad)
            for name, (m, rad) in self.motion.items()
            if name in self.determined or sizes[name] > significance * self.sigmas[name]
        ]
        return max(motions, default=(0.0, 0.0))


class _Estimator:
    """Estimates errors from refined views: the overlaps are fixed, the poses are free.

    Of many pairs, a part is used. Estimates start from the first ones, unless these are so large
    that the overlaps of the views may be wrong.
    """

    def __init__(self, aligned: RefinedViews, first: _FirstEstimates) -> None:
        refined, priors = aligned.refined, aligned.priors
        views, pairs, thinned_options = thinned(aligned.views, refined.pairs, aligned.options)
        # An estimate of camera errors does not model errors that patches share, so it can't be
        # compared with the refined poses.
        self._views, self._first = views, first
        self._options = replace(thinned_options, rounds=COARSE_TO_FINE[-1:])
        self._align = partial(align_views, views, priors=priors, pairs=pairs, scales=refined.scales)
        self._witness = priors.witness
        self._poses = self._align(refined.poses, replace(self._options, rounds=_REALIGNMENT)).poses

    def estimate(self, names: Sequence[str]) -> AlignedViews:
        """Estimate one error, or several together."""
        first, options, poses = self._first, self._options, self._poses
        errors = np.zeros(kernels.ERRORS)
        if any(abs(first.errors[name]) > _MAX_DIRECT * TOLERANCES[name] for name in names):
            options = replace(options, rounds=COARSE_TO_FINE)
        elif len(names) == 1:
            (name,) = names
            errors[_INDEX[name]] = first.errors[name]
            poses = poses @ se3.exp(first.errors[name] * first.follow[name])
        calibrate = [_INDEX[name] for name in names]
        return self._align(poses, options, calibrate=calibrate, errors=errors)

    def is_contradicted(self, estimate: AlignedViews) -> bool:
        """Whether poses with the errors of an estimate differ more from odometry, if there is any.

        As of the gap of a loop, only a difference beyond noise counts.
        """
        if not self._witness:
            return False
        depth = float(np.median([view.depth for view in self._views]))
        before, after = map(self._from_witness, (self._poses, estimate.poses))
        return Gap(0, len(self._poses) - 1, before, after, depth).widens

    def _from_witness(self, poses: Float64) -> tuple[float, float]:
        """Return the rms motion (m, rad) from odometry to poses, of each run of it on its own."""
        squares = np.zeros(2)
        for rows, witnessed in self._witness:
            first = se3.inverse(poses[rows[0]])
            squares += len(rows) * np.square(rms_motion(witnessed, first @ poses[rows]))
        m, rad = np.sqrt(squares / sum(len(rows) for rows, _ in self._witness)).tolist()
        return m, rad

    def support_of(self, estimate: AlignedViews) -> tuple[float, float]:
        """Mean support of the views without and with the errors of an estimate."""
        return mean_support(estimate, self._poses)


def _in_all_sections(estimate: AlignedViews, name: str, priors: Priors) -> bool:
    """Whether sections of the images agree on an estimated error of the camera.

    Multipath, mixed pixels and periodic errors of the range look like one in some of them.
    """
    state, k = estimate.state, _INDEX[name]
    linearised = Linearised.of(
        state.views, estimate.poses, estimate.pairs, state.options, priors, estimate.errors
    )
    sigma = linearised.response_of_sections().sigma_by_rows()[k]
    return bool(abs(estimate.errors[k]) > significance_of(SECTIONS) * sigma)


def combine_checks(checks: Sequence[CalibrationCheck]) -> CalibrationCheck:
    """Combine the checks of the submaps of one recording.

    They share the camera, so a true error is detected in most of them. Of the alarms, that with the
    median error is returned. A change of the range shows only in a submap with views before and
    after it.
    """
    changes = [(abs(s.range_change.change), k) for k, s in enumerate(checks) if s.range_change]
    if changes:
        return checks[max(changes)[1]]
    alarms = sorted((s for s in checks if s.alarm), key=lambda s: s.errors.get(s.best, 0.0))
    if 2 * len(alarms) > len(checks):
        return alarms[len(alarms) // 2]
    without_alarm = [s for s in checks if not s.alarm]
    # One submap that determines the camera represents all of them.
    without_alarm.sort(key=lambda s: (s.gap is None, "focal" in s.undetermined))
    return without_alarm[0] if without_alarm else CalibrationCheck()


def _motion(poses: Float64, twists: Float64) -> tuple[float, float]:
    """Return the rms motion (m, rad) per unit, given small twists (N, 6) per unit."""
    m, rad = rms_motion(poses, poses @ se3.exp(_DELTA * twists))
    return m / _DELTA, rad / _DELTA


def _check_by_loop(
    aligned: RefinedViews, first: _FirstEstimates, without_error: CalibrationCheck
) -> CalibrationCheck:
    """Estimate the errors of the camera from the drift over the longest loop alone.

    A large error leaves a gap that a refinement may close by matching wrong surfaces. Then its
    residuals reveal nothing. Pairwise alignments from the poses before it don't depend on it. But
    any drift leaves a gap that some error of the camera nearly closes: the views must confirm the
    error, and no smaller one, as usual cameras have it, may close the gap better.

    Parameters
    ----------
    aligned
        The views, refined without errors.
    first
        The first estimates.
    without_error
        The result if there is no error.
    """
    loop = Loop.longest(aligned)
    if loop is None:
        return without_error
    uncorrected = loop.aligned(loop.steps(aligned.refined.start), np.zeros(kernels.ERRORS))
    if not loop.gap(uncorrected, uncorrected).significant:
        return without_error

    def explained(name: str) -> tuple[float, Gap, bool] | None:
        step = _LOOP_FACTOR * TOLERANCES[name]
        error, corrected = loop.closing_error(uncorrected, _INDEX[name], step)
        gap = loop.gap(uncorrected, corrected)
        if not gap.closes:
            return None
        by_views = loop.estimate_by_views(corrected, _INDEX[name], error)
        confirmed = float(by_views.errors[_INDEX[name]])
        limit = without_error.significance * first.sigmas[name]
        large = all(_large(name, e, limit, _LOOP_FACTOR) for e in (error, confirmed))
        large = large and _in_all_sections(by_views, name, Priors.none())
        return (error, gap, large) if confirmed * error > _MIN_CONFIRMED * error**2 else None

    names = [name for name in _REVEALED_BY_LOOP if name in first.determined]
    found = run_all([partial(explained, name) for name in names])
    explanations = {name: of for name, of in zip(names, found, strict=True) if of is not None}
    if not explanations:
        return without_error
    best = min(explanations, key=lambda name: explanations[name][1].remaining_m)
    large = {name: error for name, (error, _, is_large) in explanations.items() if is_large}
    if best not in large:
        return without_error
    return replace(
        without_error,
        alarm=True,
        errors=large,
        sigmas={name: first.sigmas[name] for name in large},
        gap=explanations[best][1],
        best=best,
    )


def in_words(errors: Mapping[str, float]) -> list[str]:
    """Describe the correction of each error of the camera, as in `CalibrationCheck`, in words."""
    words = []
    if "focal" in errors:
        change = 1 / (1 + errors["focal"]) - 1
        more = "larger" if change > 0 else "smaller"
        words.append(f"a focal length {percent(abs(change))} {more}")
    if "offset" in errors:
        more = "longer" if errors["offset"] > 0 else "shorter"
        words.append(f"ranges {abs(errors['offset']) * 1e3:.0f} mm {more}")
    for name, (less, more) in {"center_x": ("left", "right"), "center_y": ("up", "down")}.items():
        if name in errors:
            # A larger ray coordinate of a pixel is a principal point further left or up.
            where = less if errors[name] > 0 else more
            words.append(
                f"a principal point {percent(abs(errors[name]))} of the focal length further "
                f"{where}"
            )
    if "distortion" in errors:
        kind = "barrel" if errors["distortion"] > 0 else "pincushion"
        words.append(f"{percent(abs(errors['distortion']))} more {kind} distortion at 45 degrees")
    return words


def usual_error(name: str) -> str:
    """Describe the tolerance of an error in words."""
    if name == "offset":
        return length(TOLERANCES[name])
    return percent(TOLERANCES[name]) + " of the focal length" * name.startswith("center")


def proposal(errors: Mapping[str, float], best: str) -> str:
    """Describe the corrections of `errors` as alternatives; of more than two, only `best`."""
    alternatives = in_words(errors)
    if len(alternatives) < 3 or best not in errors:
        return " or ".join(alternatives)
    (text,) = in_words({best: errors[best]})
    return f"{text} (or other calibration errors with a similar effect)"
