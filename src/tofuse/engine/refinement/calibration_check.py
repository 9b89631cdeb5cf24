"""Self-calibration check: whether all views together indicate an error of the camera.

A wrong focal length or principal point, neglected lens distortion or a depth offset bends the
trajectory, and no single registration reveals it. But where views overlap, and above all where a
path closes a loop, their residuals can't all be small. So all errors are estimated together, with
all poses free: they resemble each other, and alone each would take the effect of the others, as an
offset of several centimetres that of a focal length 0.3 % off. All are of the size that is usual,
or one of them is not (Bayesian model comparison). An unusual error is a proposal. It is an alarm if
the views agree better with it, and the gap of a loop by pairwise alignments of neighbours does not
grow with it, or, for focal length and offset, confirms it.

A camera whose range changes has no single calibration: see `range_change`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.special import chdtri

from tofuse.engine.arrays import Float64
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.quantities import length, percent
from tofuse.engine.refinement.camera_response import (
    SECTIONS,
    SIGNIFICANT,
    Linearised,
    Posterior,
    SharedErrors,
    significance_of,
)
from tofuse.engine.refinement.joint_alignment import (
    AlignedViews,
    Priors,
    RefinedViews,
    align_views,
    mean_support,
    overlapping,
)
from tofuse.engine.refinement.loop_drift import COARSE_TO_FINE, Gap, Loop, loop_gap, thinned
from tofuse.engine.refinement.range_change import (
    RangeChange,
    drifts_of,
    likely_change,
    range_change,
    recording_of,
)
from tofuse.engine.refinement.split_half import rms_motion
from tofuse.engine.stored_views import SampledView, pair_equations
from tofuse.engine.stored_views import pair_equation_kernels as kernels

# Multipath and mixed pixels look like an error of the focal length of up to a percent; cameras are
# calibrated to better than that. Makers specify depth offsets of up to a centimetre.
TOLERANCES = {"focal": 0.01, "offset": 0.01, "center_x": 0.01, "center_y": 0.01, "distortion": 0.01}
# What they are errors of.
QUANTITIES = {
    "focal": "focal length",
    "offset": "depth offset",
    "center_x": "principal point",
    "center_y": "principal point",
    "distortion": "distortion",
}
# Standard deviation of the errors of usual cameras, uniform up to the tolerance, which is the same
# for all; and of one that is not usual.
USUAL, _UNUSUAL = 0.01 / 3**0.5, 0.1
# The scale of a usual camera does not drift: its clock is stable.
_NONE = 1e-6
# Logarithm of the factor by which views are likelier with an error: strong evidence (Jeffreys).
_STRONG = float(np.log(10))
# Standard deviations by which a certain error exceeds the tolerance; and of a usual one that may
# improve the views: worth a full estimate from this fraction of the tolerance.
_CERTAIN, _PROMISING, _MIN_FIRST_STEP = 3.0, 4.0, 0.2
# Sum of the squares of four usual errors that chance exceeds once in a thousand, relative to their
# variance.
_MAX_OTHERS = float(chdtri(len(TOLERANCES) - 1, 0.001))
# Multipath or mixed pixels may shift all sections of the images as much as these differ: multiple
# of the standard deviation of an estimate, which is their mean.
HIDDEN = SECTIONS**0.5
# Views determine an error if they reduce the variance of usual ones to this fraction.
_DETERMINED = 2 / 3
# Errors that the drift over a loop can reveal; that by the others resembles any drift.
_REVEALED_BY_LOOP = ("focal", "offset")
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
    errors
        The error that is not usual, by its name, as in `Refinement.errors`; empty if there is none.
        It is a proposal and changes nothing.
    support
        Mean support of the views without and with all errors as estimated in full, see
        `joint_alignment.Support`; None if they were not, or it falls.
    gap
        Closure error of the longest loop; None if there is none, or the views don't support the
        estimates.
    estimates
        Joint estimate of all errors and their standard deviations by name: by one Newton step, or
        in full if one is not usual. Empty if there are too few views.
    motion
        Rms motion (m, rad) of the poses, after alignment, that a unit of each error causes.
    moved, spread
        Rms motion (m, rad) of the poses, after alignment, by the estimated errors, and rms errors
        of the poses by the uncertainty of these.
    changed, change_confirmed
        Rms motion (m, rad) of the poses by a change of the range, if that is significant, and
        whether it can't be multipath, see `RangeChange`.
    range_change
        Change of the range over the views, if there is one; then no error is estimated.
    contradicted
        Whether verified odometry contradicts the estimates.
    """

    alarm: bool = False
    errors: dict[str, float] = field(default_factory=dict)
    support: tuple[float, float] | None = None
    gap: Gap | None = None
    estimates: dict[str, tuple[float, float]] = field(default_factory=dict)
    motion: dict[str, tuple[float, float]] = field(default_factory=dict)
    moved: tuple[float, float] = (0.0, 0.0)
    spread: tuple[float, float] = (0.0, 0.0)
    changed: tuple[float, float] = (0.0, 0.0)
    change_confirmed: bool = True
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
        return name in self.estimates and self.sigma(name) ** 2 < _DETERMINED * USUAL**2

    def sigma(self, name: str) -> float:
        """Return the standard deviation of an estimate; that of usual errors without one."""
        return self.estimates[name][1] if name in self.estimates else USUAL

    @property
    def certain(self) -> bool:
        """Whether one error is beyond the tolerance for certain, and it alone.

        If others are not usual either, the views show something else, such as another lens model.
        """
        others = [e for name, (e, _) in self.estimates.items() if name not in self.errors]
        return float(np.sum(np.square(others))) < _MAX_OTHERS * USUAL**2 and any(
            abs(error) > TOLERANCES[name] + _CERTAIN * self.sigma(name)
            for name, error in self.errors.items()
        )

    @property
    def unconfirmed(self) -> dict[str, float]:
        """A certain error without an alarm that may well be true."""
        return self.errors if self.certain and self.is_likely and not self.alarm else {}

    @property
    def is_likely(self) -> bool:
        """Whether the estimates may well be true, and nothing contradicts them."""
        contradicted = self.contradicted or (self.gap is not None and self.gap.contradicts)
        return self.alarm or (self.is_supported and not contradicted)

    @property
    def is_supported(self) -> bool:
        """Whether the views agree better with the estimates, or show an unusual error."""
        return self.improves or bool(self.errors)

    @property
    def improves(self) -> bool:
        """Whether the views agree better with the estimated errors, not by chance."""
        return self.support is not None and self.support[1] - self.support[0] > _SUPPORT_NOISE

    @property
    def confirmed_by_loop(self) -> bool:
        """Whether the gap of a loop confirms the error, or allows for it.

        Multipath looks like a smaller focal length or offset, with which views agree better: a loop
        must confirm that. The others hardly change it, as their drift resembles any other.
        """
        if self.gap is None:
            return False
        revealed = any(name in _REVEALED_BY_LOOP for name in self.errors)
        return self.gap.confirms if revealed else not self.gap.grows


def check_calibration(aligned: RefinedViews) -> CalibrationCheck:
    """Estimate the errors of the camera from views that were refined without such errors."""
    if not len(aligned.refined.pairs):
        return CalibrationCheck()
    refined = aligned.refined
    views, pairs, options = thinned(aligned.views, refined.pairs, aligned.options)
    linearised = Linearised.of(views, refined.poses, pairs, options, aligned.priors)
    first = _Estimate.of(linearised)
    usual = replace(first, unusual="")
    without_error = _by_first_estimate(aligned, linearised, usual)
    if len(views) < _MIN_VIEWS or without_error.range_change is not None:
        return without_error
    if not first.is_promising:
        return _check_by_loop(aligned, without_error)
    return _check_promising(aligned, _Estimator(aligned, linearised, first), without_error)


def is_wrong(
    views: Sequence[SampledView],
    poses: Float64,
    options: pair_equations.RefineOptions,
    priors: Priors,
) -> bool:
    """Whether views show at poses (N, 4, 4), before any refinement, that the calibration is wrong.

    That is by one error for certain. The parameters are those of `refine`.
    """
    views, pairs, options = thinned(views, overlapping(views, poses, options), options)
    if len(views) < _MIN_VIEWS or not len(pairs):
        return False
    estimate = _Estimate.of(Linearised.of(views, poses, pairs, options, priors))
    estimates = estimate.by_name
    errors = {name: estimates[name][0] for name in estimates if name == estimate.unusual}
    return CalibrationCheck(errors=errors, estimates=estimates).certain


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Joint estimate of all errors, in the order of `_INDEX`, by linearised views.

    After them follow drifts of the range, by a distance, as while a camera warms up, then by a
    factor: one of the other errors may explain the mean of a drift.

    Attributes
    ----------
    poses
        (N, 4, 4) of the views.
    models
        The errors, K in all, by the name of the one that is not usual; empty if all are.
    follow
        (K, N, 6) twists by which the poses follow, per unit of each error.
    prior_weight
        Factor of the priors of the errors in reweighted least squares.
    unusual
        Name of the likeliest model, "" without strong evidence for another.
    drift
        A drift by a distance that is not usual, and its position among the errors, if one is far
        likelier, beside that error.
    """

    poses: Float64
    models: dict[str, Posterior]
    follow: Float64
    prior_weight: float
    unusual: str
    drift: tuple[int, RangeChange] | None

    @classmethod
    def of(cls, linearised: Linearised, preferred: str = "") -> _Estimate:
        """Estimate all errors, by the preferred model unless another one is far likelier."""
        views = linearised.state.views
        drifts = drifts_of(views)
        shared = linearised.shared_errors(list(_INDEX.values()), drifts)
        usual_drifts = np.repeat([USUAL, _NONE], len(drifts))
        usual = {name: np.append(_sigmas(name), usual_drifts) for name in ("", *_INDEX)}
        models = {name: shared.posterior(sigmas) for name, sigmas in usual.items()}
        best = max(models, key=lambda name: models[name].evidence)
        drift = _likely_drift(shared, usual.values(), models[best].evidence, drifts, linearised)
        weight = shared.dispersion / linearised.curvature
        found = cls(linearised.poses, models, shared.motion, weight, best, drift)
        likely = found.likely
        return replace(found, unusual=preferred if preferred in likely else likely[0])

    @property
    def likely(self) -> list[str]:
        """Names of models that are about as likely as the likeliest, which comes first.

        Without strong evidence for another one, all errors are usual. An error that the views don't
        determine is no explanation.
        """
        evidence = {name: model.evidence for name, model in self.models.items()}
        least = max(evidence.values()) - _STRONG
        if evidence[""] > least:
            return [""]
        best = max(evidence, key=lambda name: evidence[name])
        others = (n for n, e in evidence.items() if e > least and n != best)
        return [best, *filter(self._determines, others)]

    def _determines(self, name: str) -> bool:
        """Whether the views determine an error that is not usual."""
        k = list(_INDEX).index(name)
        return bool(self.models[name].covariance[k, k] < _DETERMINED * _UNUSUAL**2)

    @property
    def found(self) -> Posterior:
        """The errors by the likeliest model."""
        return self.models[self.unusual]

    @property
    def by_name(self) -> dict[str, tuple[float, float]]:
        """Errors and their standard deviations."""
        sigmas = np.sqrt(np.diag(self.found.covariance)).tolist()
        return dict(zip(_INDEX, zip(self.found.errors.tolist(), sigmas, strict=True), strict=False))

    @property
    def is_promising(self) -> bool:
        """Whether an error is not usual, or significant."""
        return self.unusual != "" or any(
            abs(error) > max(_PROMISING * sigma, _MIN_FIRST_STEP * TOLERANCES[name])
            for name, (error, sigma) in self.by_name.items()
        )

    @property
    def motion(self) -> dict[str, tuple[float, float]]:
        """See `CalibrationCheck.motion`."""
        return {name: self.motion_by(np.eye(len(self.follow))[k]) for k, name in enumerate(_INDEX)}

    @property
    def moved(self) -> Float64:
        """The poses (N, 4, 4) as they follow the errors."""
        return self._moved(self.found.errors)

    def _moved(self, errors: Float64) -> Float64:
        return np.asarray(self.poses @ se3.exp(np.tensordot(errors, self.follow, 1)), np.float64)

    @property
    def spread(self) -> tuple[float, float]:
        """See `CalibrationCheck.spread`."""
        variances, axes = np.linalg.eigh(self.found.covariance)
        columns = axes.T * np.sqrt(np.maximum(variances, 0.0))[:, None]
        m, rad = np.linalg.norm([self.motion_by(column) for column in columns], axis=0).tolist()
        return m, rad

    def motion_by(self, errors: Float64) -> tuple[float, float]:
        """Rms motion (m, rad) of the poses by errors (K,), to first order."""
        size = max(float(np.linalg.norm(errors)), 1e-12)
        m, rad = rms_motion(self.poses, self._moved(_DELTA / size * errors))
        return m / _DELTA * size, rad / _DELTA * size


def _likely_drift(
    shared: SharedErrors,
    usual: Iterable[Float64],
    evidence: float,
    drifts: Float64,
    linearised: Linearised,
) -> tuple[int, RangeChange] | None:
    """Return the likeliest of drifts (D, N) that is not usual, and its position among the errors.

    None without strong evidence, and if it is by a factor. `usual` are the standard deviations
    (K,) of models without one, and `evidence` is that of the likeliest of these.
    """
    best: tuple[Posterior, int] | None = None
    for sigmas in usual:
        for k in range(len(_INDEX), len(sigmas)):
            unusual = np.where(np.arange(len(sigmas)) == k, _UNUSUAL, sigmas)
            found = shared.posterior(unusual)
            if found.evidence > (evidence + _STRONG if best is None else best[0].evidence):
                best = found, k
    if best is None or best[1] >= len(_INDEX) + len(drifts):
        return None
    found, k = best
    views = linearised.state.views
    first = views[int(drifts[k - len(_INDEX)].argmax())]
    # What poses have not taken up of a large drift is no noise: the weights stay as they are.
    step = linearised.curvature
    chance = significance_of(shared.independent[k]) * shared.serial_sigma[k]
    section_sigma = linearised.section_sigma(drifts[[k - len(_INDEX)]], in_metres=True)
    change = RangeChange(
        -step * float(found.errors[k]),
        step * float(np.sqrt(found.covariance[k, k])),
        frame=None,
        limit=_CERTAIN,
        confirmed=bool(abs(found.errors[k]) > chance),
        in_all_sections=bool(abs(found.errors[k]) > significance_of(SECTIONS) * section_sigma),
        recording=recording_of(first, views),
        in_metres=True,
    )
    return k, change


def _by_first_estimate(
    aligned: RefinedViews, linearised: Linearised, first: _Estimate
) -> CalibrationCheck:
    """Return what is known of a usual camera before its errors are estimated in full."""
    if len(aligned.views) < _MIN_VIEWS:
        return CalibrationCheck(motion=first.motion)
    check = CalibrationCheck(
        estimates=first.by_name,
        motion=first.motion,
        moved=rms_motion(first.poses, first.moved),
        spread=first.spread,
    )
    if first.drift is not None:
        k, drift = first.drift
        if drift.is_large:
            return replace(check, range_change=drift)
        moved_by = first.motion_by(-drift.change * np.eye(len(first.follow))[k])
        check = replace(check, changed=moved_by, change_confirmed=drift.confirmed)
    change = likely_change(linearised)
    if change is None:
        return check
    changed = range_change(change, aligned)
    if changed is not None and changed.is_large:
        return replace(check, range_change=changed)
    if not (changed or change).is_significant:
        return check
    ratio = abs(changed.change / change.scale) if changed else 1.0
    moved = first.poses @ se3.exp(_DELTA * change.follow)
    m, rad = (abs(change.scale) * x / _DELTA for x in rms_motion(first.poses, moved))
    confirmed = changed is None or changed.confirmed
    return replace(check, changed=(ratio * m, ratio * rad), change_confirmed=confirmed)


def _check_promising(
    aligned: RefinedViews, estimator: _Estimator, without_error: CalibrationCheck
) -> CalibrationCheck:
    """Estimate the errors in full, and check whether views, loops and odometry confirm them."""
    # Linearised, models that resemble each other may be about equally likely.
    fits = {name: estimator.estimate(name) for name in estimator.likely}
    supports = {name: estimator.support_of(fit) for name, fit in fits.items()}
    best = max(supports, key=lambda name: supports[name][1])
    fit, support = fits[best], supports[best]
    if support[1] < support[0]:  # the first estimates led astray
        return _check_by_loop(aligned, without_error)
    estimate = _Estimate.of(_linearised(fit, aligned.priors), best)
    name, estimates = estimate.unusual, estimate.by_name
    is_large = name != "" and abs(estimates[name][0]) > TOLERANCES[name]
    check = replace(
        without_error,
        errors={name: estimates[name][0]} if is_large else {},
        support=support,
        estimates=estimates,
        moved=rms_motion(aligned.refined.poses, fit.poses),
        spread=estimate.spread,
    )
    if check.is_supported:
        doubted = _is_contradicted(aligned, estimator.poses, fit.poses)
        gap = loop_gap(aligned, fit.poses, fit.errors)
        check = replace(check, gap=gap, contradicted=doubted and aligned.priors.verified)
        if doubted:  # odometry of unknown errors only prevents an alarm
            return check
        if check.improves and check.certain and check.confirmed_by_loop:
            return replace(check, alarm=True)
    of_loop = _check_by_loop(aligned, without_error)
    return of_loop if of_loop.alarm else check


class _Estimator:
    """Estimates all errors from refined views: the overlaps are fixed, the poses are free.

    Estimates start from the first ones, unless these are so large that the overlaps of the views
    may be wrong.
    """

    def __init__(self, aligned: RefinedViews, linearised: Linearised, first: _Estimate) -> None:
        refined, state = aligned.refined, linearised.state
        self._first, self.likely = first, first.likely
        self._options = replace(state.options, rounds=COARSE_TO_FINE[-1:])
        self._align = partial(
            align_views,
            state.views,
            priors=aligned.priors,
            pairs=state.pairs,
            scales=refined.scales,
        )
        # An estimate of camera errors does not model errors that patches share, so it can't be
        # compared with the refined poses.
        self.poses = self._align(refined.poses, replace(self._options, rounds=_REALIGNMENT)).poses

    def estimate(self, unusual: str) -> AlignedViews:
        """Estimate the errors in full by one model, see `_Estimate.models`."""
        first, options, poses = replace(self._first, unusual=unusual), self._options, self.poses
        calibrate, errors = list(_INDEX.values()), np.zeros(kernels.ERRORS)
        usual = np.full(kernels.ERRORS, np.inf)
        usual[calibrate] = _sigmas(unusual) / np.sqrt(first.prior_weight)
        if np.abs(first.found.errors).max() > _MAX_DIRECT * max(TOLERANCES.values()):
            options = replace(options, rounds=COARSE_TO_FINE)
        else:
            errors[calibrate], poses = first.found.errors[: len(calibrate)], first.moved
        return self._align(poses, options, calibrate=calibrate, errors=errors, usual=usual)

    def support_of(self, estimate: AlignedViews) -> tuple[float, float]:
        """Mean support of the views without and with the errors of an estimate."""
        return mean_support(estimate, self.poses)


def _is_contradicted(
    aligned: RefinedViews, before: Float64, after: Float64, first: int = 0
) -> bool:
    """Whether poses (K, 4, 4) differ more from odometry with errors of the camera than without.

    They are of successive views from the `first` on. As of the gap of a loop, only a difference
    beyond noise counts.
    """
    squares, count = np.zeros((2, 2)), 0
    for positions, witnessed in aligned.priors.witness:
        inside = (positions >= first) & (positions < first + len(before))
        if inside.any():
            rows, of = positions[inside] - first, witnessed[inside]
            count += len(rows)
            for k, poses in enumerate((before, after)):
                motion = rms_motion(
                    se3.inverse(of[0]) @ of, se3.inverse(poses[rows[0]]) @ poses[rows]
                )
                squares[k] += len(rows) * np.square(motion)
    if not count:
        return False
    depth = float(np.median([view.depth for view in aligned.views]))
    (m, rad), (m_after, rad_after) = np.sqrt(squares / count).tolist()
    return Gap(first, first + len(before) - 1, (m, rad), (m_after, rad_after), depth).widens


def _sigmas(unusual: str) -> Float64:
    """Return the standard deviations (K,) of errors, one of which is not usual, if any."""
    return np.array([_UNUSUAL if name == unusual else USUAL for name in _INDEX])


def _linearised(fit: AlignedViews, priors: Priors) -> Linearised:
    """Linearise views at their poses and errors of the camera."""
    state = fit.state
    return Linearised.of(state.views, fit.poses, fit.pairs, state.options, priors, fit.errors)


def combine_checks(checks: Sequence[CalibrationCheck]) -> CalibrationCheck:
    """Combine the checks of the submaps of one recording.

    They share the camera, so a true error is detected in most of them. Of the alarms, that with the
    median error is returned. A change of the range shows only in a submap with views before and
    after it.
    """
    changes = [(abs(s.range_change.change), k) for k, s in enumerate(checks) if s.range_change]
    if changes:
        return checks[max(changes)[1]]
    alarms = sorted((s for s in checks if s.alarm), key=lambda s: [*s.errors.items()])
    if 2 * len(alarms) > len(checks):
        return alarms[len(alarms) // 2]
    without_alarm = [s for s in checks if not s.alarm]
    # One submap that determines the camera represents all of them.
    without_alarm.sort(key=lambda s: (s.gap is None, "focal" in s.undetermined))
    return without_alarm[0] if without_alarm else CalibrationCheck()


def _check_by_loop(aligned: RefinedViews, without_error: CalibrationCheck) -> CalibrationCheck:
    """Estimate the errors of the camera from the drift over the longest loop alone.

    A large error leaves a gap that a refinement may close by matching wrong surfaces. Then its
    residuals reveal nothing. Pairwise alignments from the poses before it don't depend on it. But
    any drift leaves a gap that some error of the camera nearly closes: the views must confirm the
    error, odometry must not contradict it, and no smaller one, as usual cameras have it, may close
    the gap better.

    Parameters
    ----------
    aligned
        The views, refined without errors.
    without_error
        The result if there is no error.
    """
    loop = Loop.longest(aligned)
    if loop is None:
        return without_error
    uncorrected = loop.aligned(loop.steps(aligned.refined.start), np.zeros(kernels.ERRORS))
    if not loop.gap(uncorrected, uncorrected).significant:
        return without_error

    def explained(name: str) -> tuple[float, float, Gap, bool] | None:
        limit = _LOOP_FACTOR * TOLERANCES[name]
        error, corrected = loop.closing_error(uncorrected, _INDEX[name], limit)
        gap = loop.gap(uncorrected, corrected)
        if not gap.closes:
            return None
        by_views = loop.estimate_by_views(corrected, _INDEX[name], error)
        confirmed = float(by_views.errors[_INDEX[name]])
        if confirmed * error < _MIN_CONFIRMED * error**2:
            return None
        without = aligned.refined.poses[loop.i : loop.j + 1]
        if _is_contradicted(aligned, without, by_views.poses, loop.i):
            return None
        shared = _linearised(by_views, Priors.none()).shared_errors([_INDEX[name]])
        sigma = float(np.sqrt(shared.posterior(np.array([_UNUSUAL])).covariance[0, 0]))
        large = min(abs(error), abs(confirmed)) > max(limit, SIGNIFICANT * sigma)
        return error, sigma, gap, large

    names = [name for name in _REVEALED_BY_LOOP if without_error.determines(name)]
    found = run_all([partial(explained, name) for name in names])
    explanations = {name: of for name, of in zip(names, found, strict=True) if of is not None}
    if not explanations:
        return without_error
    best = min(explanations, key=lambda name: explanations[name][2].remaining_m)
    error, sigma, gap, is_large = explanations[best]
    if not is_large:
        return without_error
    m, rad = np.maximum(without_error.moved, gap.before).tolist()
    return replace(
        without_error,
        alarm=True,
        errors={best: error},
        estimates={**without_error.estimates, best: (error, sigma)},
        moved=(m, rad),
        gap=gap,
    )


def in_words(errors: Mapping[str, float]) -> str:
    """Describe the correction of errors of the camera: "a focal length 4.5 % smaller"."""
    words = []
    for name, error in errors.items():
        if name == "focal":
            change = 1 / (1 + error) - 1
            more = "larger" if change > 0 else "smaller"
            words.append(f"a focal length {percent(abs(change))} {more}")
        elif name == "offset":
            more = "longer" if error > 0 else "shorter"
            words.append(f"ranges {abs(error) * 1e3:.0f} mm {more}")
        elif name == "distortion":
            kind = "barrel" if error > 0 else "pincushion"
            words.append(f"{percent(abs(error))} more {kind} distortion at 45 degrees")
        else:
            # A larger ray coordinate of a pixel is a principal point further left or up.
            where = {"center_x": ("left", "right"), "center_y": ("up", "down")}[name][error < 0]
            size = percent(abs(error))
            words.append(f"a principal point {size} of the focal length further {where}")
    return " and ".join(words)


def usual_error(name: str) -> str:
    """Describe the tolerance of an error in words."""
    if name == "offset":
        return length(TOLERANCES[name])
    return percent(TOLERANCES[name]) + " of the focal length" * name.startswith("center")
