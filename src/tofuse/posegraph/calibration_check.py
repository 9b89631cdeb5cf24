"""Self-calibration check: whether all views together indicate an error of the camera.

A wrong focal length or a depth offset bends the trajectory, and no single registration shows it.
But where views overlap, and most of all where a path closes a loop, their residuals can't all be
small. So each error is estimated by itself, with all poses free to follow. An error that lets the
views agree better is a proposal. It is an alarm if it exceeds the calibration error of usual
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
TOLERANCES = {"focal": 0.01, "offset": 0.01}
# Significance of an error in standard deviations, for an alarm and for a closer look; and the
# fraction of the tolerance that one Newton step must show for the latter.
_SIGNIFICANT, _LIKELY, _MIN_FIRST_STEP = 4.0, 2.5, 0.2
# A loop is closed if its error is below this, m and rad.
_CLOSED = (0.01, np.radians(0.5))
# Errors with a larger standard deviation, as a fraction of the tolerance, are not reported.
_MAX_SIGMA = 0.8
# Change of the views' support that the choice of points alone explains.
_CHANCE = 0.003
# Secant steps to the error that closes a loop: their maximum number; the first one, relative to the
# tolerance; and the change at convergence, and an implausible error, relative to the first one.
_SECANTS, _FIRST_STEP, _CONVERGED, _IMPLAUSIBLE = 4, 2.0, 0.05, 10.0
# An error that only the drift over the loop shows must exceed the tolerance by this factor; and the
# fraction of it that the views must confirm: they may measure another one.
_BY_LOOP, _KEPT = 2.0, 0.5
# The spread between views is not known from fewer.
_MIN_VIEWS = 8
_SMALL = 1e-3  # error of the camera, to differentiate by
_NUMBERS = {"focal": kernels.FOCAL, "offset": kernels.OFFSET}
# The solution may be far from the start.
_ROUNDS = (Round(2, 0.02, 0.1), Round(2, 0.005, 0.03), Round(4, 0.0, 0.0))
# This many pairs determine errors that all views share; of more, about as many, with every n-th
# point, are used.
_ENOUGH_PAIRS, _EVERY = 500, 3


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
        centimetre and half a degree has no significance, as not every error bends every path.
        """
        seen = self._apparent_m(*self.before)
        least = self._apparent_m(*_CLOSED)
        if self.depth and self.remaining_m < 0.5 * seen and seen > least:
            return True
        parts = list(zip(self.before, self.after, _CLOSED, strict=True))
        if any(b > max(a, least) for a, b, least in parts):
            return False
        return all(a < least for a, _, least in parts) or any(b < 0.5 * a for a, b, _ in parts)

    @property
    def significant(self) -> bool:
        """Whether it is more than noise."""
        return any(a >= least for a, least in zip(self.before, _CLOSED, strict=True))

    @property
    def contradicts(self) -> bool:
        """Whether the estimated errors change it much without closing it, or widen it.

        Errors of the camera hardly change the gap of a short loop, which shows nothing of them.
        """
        before = self._apparent_m(*self.before)
        changes = self._apparent_m(*self.change) > 0.5 * before
        widens = self.remaining_m > before + self._apparent_m(*_CLOSED)
        return self.significant and not self.closes and (changes or widens)


@dataclass(frozen=True)
class CalibrationCheck:
    """Evidence of the views for errors of the camera that all of them share.

    Attributes
    ----------
    alarm
        Whether the camera's calibration should be checked.
    errors, sigmas
        Estimates of each error by itself, as in `Refinement.errors`, and their standard deviations
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
        Rms motion (m, rad) of the poses, after alignment, if the estimated error is corrected: that
        of `best`, else the error with the larger effect of those that the views determine.
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
    def contradicted(self) -> bool:
        """Whether a loop shows that the estimated errors are not those of the camera."""
        return not self.alarm and self.gap is not None and self.gap.contradicts

    @property
    def unconfirmed(self) -> dict[str, float]:
        """Significant errors without an alarm that may be true.

        Either one of them is large, and no loop confirms or contradicts it, or the views agree
        better with the smaller ones.
        """
        if self.alarm or self.contradicted:
            return {}
        if not self.large and not self.improves:
            return {}
        return {n: e for n, e in self.errors.items() if abs(e) > _SIGNIFICANT * self._sigma(n)}

    @property
    def improves(self) -> bool:
        """Whether the views agree better with the error `best`, not by chance."""
        return self.support is not None and self.support[1] - self.support[0] > _CHANCE

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
    determined = [name for name, k in _NUMBERS.items() if _determined(name, sigma[k])]
    motion = {name: _motion(poses, sensitivity.motion[k]) for name, k in _NUMBERS.items()}
    small = [np.array(motion[n]) * abs(float(estimate[_NUMBERS[n]])) for n in determined]
    without_error = CalibrationCheck(
        focal_sigma=float(sigma[kernels.FOCAL]),
        motion=motion,
        moved=tuple(max(small, key=lambda m: m[0], default=np.zeros(2)).tolist()),
    )
    likely = [
        name
        for name in determined
        if abs(estimate[_NUMBERS[name]])
        > max(_LIKELY * sigma[_NUMBERS[name]], _MIN_FIRST_STEP * TOLERANCES[name])
    ]
    sigmas = {name: float(sigma[_NUMBERS[name]]) for name in determined}
    by_loop = partial(_check_by_loop, views, refined, sigmas, without_error, options)
    if not likely:
        return by_loop()
    few, some = list(views), pairs
    if len(pairs) > _ENOUGH_PAIRS:
        few = [v.with_points(np.s_[::_EVERY]) for v in views]
        some = spread_evenly(pairs, -(-options.neighbours * _ENOUGH_PAIRS // len(pairs)))
    patient = replace(options, rounds=_ROUNDS)

    def estimated(name: str) -> Refined:
        # The overlaps are known; the poses only follow.
        number = [_NUMBERS[name]]
        return refine(few, poses, patient, calibrate=number, priors=priors, pairs=some)

    found = {name: estimated(name) for name in likely}
    together = found[likely[0]].errors
    if len(likely) > 1:  # one error resembles another: estimated together, the true one remains
        numbers = [_NUMBERS[name] for name in likely]
        together = align_views(
            few, poses, patient, calibrate=numbers, priors=priors, pairs=some
        ).errors
    name_of_best = max(likely, key=lambda name: abs(together[_NUMBERS[name]]) / TOLERANCES[name])
    best = found[name_of_best]
    large = any(
        _large(name, one.errors[_NUMBERS[name]], sigma[_NUMBERS[name]])
        for name, one in found.items()
    )
    number = _NUMBERS[name_of_best]
    certain = abs(best.errors[number]) > _SIGNIFICANT * sigma[number]
    improves = certain and _gain(best, views) > _CHANCE
    gap = None
    if large or improves:
        gap = loop_gap(views, refined, best.poses, best.errors, options)
    # Multipath has the same effect as a smaller error: views agree better, and a loop closes.
    alarm = large and improves and gap is not None and gap.closes
    if alarm:  # alternative explanations
        found |= {name: estimated(name) for name in determined if name not in found}
    elif (closed := by_loop()).alarm:
        return closed
    support = float(best.before.of_views(len(views)).mean())
    position, rotation = aligned_motion(poses, best.poses)
    return replace(
        without_error,
        alarm=alarm,
        errors={
            name: float(found[name].errors[k]) for name, k in _NUMBERS.items() if name in found
        },
        sigmas={name: sigmas[name] for name in _NUMBERS if name in found},
        support=(support, support + _gain(best, views)),
        gap=gap,
        best=name_of_best,
        moved=(_rms(position), _rms(rotation)),
    )


def of_submaps(checks: Sequence[CalibrationCheck]) -> CalibrationCheck:
    """Combine the checks of the submaps of one recording.

    They share the camera, so a true error shows in most of them. Of the alarms, that with the
    median error is returned.
    """
    alarms = sorted((s for s in checks if s.alarm), key=lambda s: s.errors.get(s.best, 0.0))
    if 2 * len(alarms) > len(checks):
        return alarms[len(alarms) // 2]
    quiet = [s for s in checks if not s.alarm]
    # One submap that determines the camera speaks for all of them.
    quiet.sort(key=lambda s: (s.gap is None, s.undetermined))
    return quiet[0] if quiet else CalibrationCheck()


def _rms(vectors: Float64) -> float:
    return float(np.sqrt((vectors**2).sum(1).mean()))


def _motion(poses: Float64, twists: Float64) -> tuple[float, float]:
    """Return the rms motion (m, rad) per unit, given small twists (N, 6) per unit."""
    position, rotation = aligned_motion(poses, poses @ se3.exp(_SMALL * twists))
    return _rms(position) / _SMALL, _rms(rotation) / _SMALL


def _gain(found: Refined, views: Sequence[SampledView]) -> float:
    n = len(views)
    return float(found.after.of_views(n).mean() - found.before.of_views(n).mean())


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
    without = loop.miss(refined.poses, np.zeros(kernels.ERRORS))
    return loop.gap(without, loop.miss(poses, errors))


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

    def miss(self, poses: Float64, errors: Float64) -> Float64:
        """Return the motion (4, 4) by which chained pairwise alignments miss the end of the loop.

        Parameters
        ----------
        poses
            (N, 4, 4) T_world_camera, where the alignments start.
        errors
            (ERRORS,) assumed errors of the camera.
        """
        return self.chained(poses, errors)[0]

    def chained(self, poses: Float64, errors: Float64) -> tuple[Float64, Float64]:
        """Return `miss`, and the poses (j - i + 1, 4, 4) of the chain relative to its first."""
        i, j = self.i, self.j
        chain = np.stack([np.arange(i, j), np.arange(i + 1, j + 1)], 1)
        pairs = np.concatenate([chain, [[i, j]]])
        T = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
        T = align_pairs(self.views, pairs, T, self.options, errors)
        chained = [np.eye(4)]
        for step in T[:-1]:
            chained.append(chained[-1] @ step)
        return np.asarray(se3.inverse(T[-1]) @ chained[-1], np.float64), np.array(chained)

    def kept_by_views(self, poses: Float64, number: int, error: float) -> float:
        """Return an error of the camera as all views of the loop estimate it, starting from one.

        They keep a true error, also if their residuals at a wrong one are small. One that only
        closes the gap is far from what they measure.

        Parameters
        ----------
        poses
            As for `miss`.
        number, error
            Which error, and its initial value.
        """
        errors = np.zeros(kernels.ERRORS)
        errors[number] = error
        start = self.chained(poses, errors)[1]
        options = replace(self.options, rounds=_ROUNDS)
        views = self.views[self.i : self.j + 1]
        kept = align_views(views, start, options, calibrate=[number], errors=errors)
        return float(kept.errors[number])

    def gap(self, before: Float64, after: Float64) -> Gap:
        """Return the gap, given `miss` without and with errors of the camera."""
        first, last = (self.views[k].index for k in (self.i, self.j))
        change = se3.inverse(before) @ after
        return Gap(first, last, _size(before), _size(after), self.depth, _size(change))

    def closing_error(
        self, poses: Float64, uncorrected: Float64, number: int, step: float
    ) -> tuple[float, Float64]:
        """Return the error of the camera that closes the loop best, and `miss` with it.

        Gauss-Newton on the gap at the views' depth, with derivatives by secants.

        Parameters
        ----------
        poses
            As for `miss`.
        uncorrected
            (4, 4) `miss` without errors of the camera.
        number
            Which error.
        step
            First difference.
        """
        unit = np.r_[np.full(3, 1 / self.depth), np.ones(3)]
        errors = np.zeros(kernels.ERRORS)
        before, residual = 0.0, se3.log(uncorrected) * unit
        error = step
        for _ in range(_SECANTS):
            errors[number] = error
            miss = self.miss(poses, errors)
            last, residual = residual, se3.log(miss) * unit
            slope = (residual - last) / (error - before)
            before = error
            error -= float(slope @ residual) / max(float(slope @ slope), 1e-12)
            if abs(error - before) < _CONVERGED * step or abs(error) > _IMPLAUSIBLE * step:
                break
        return before, miss


def _size(T: Float64) -> tuple[float, float]:
    return float(np.linalg.norm(T[:3, 3])), float(se3.angle(T))


def _check_by_loop(
    views: Sequence[SampledView],
    refined: Refined,
    sigmas: Mapping[str, float],
    none: CalibrationCheck,
    options: RefineOptions,
) -> CalibrationCheck:
    """Estimate the errors of the camera from the drift over the longest loop alone.

    A large error leaves a gap that a refinement may close by matching wrong surfaces. Then its
    residuals show nothing. Pairwise alignments from the poses before it don't depend on it. But any
    drift leaves a gap that some error of the camera nearly closes: the views must keep the error,
    and not find another one.

    Parameters
    ----------
    views, refined, options
        As for `check_calibration`.
    sigmas
        Standard deviations of the errors that the views determine.
    none
        The result if there is no error.
    """
    loop = _Loop.longest(views, refined, options)
    if loop is None:
        return none
    poses = refined.start
    uncorrected = loop.miss(poses, np.zeros(kernels.ERRORS))
    if not loop.gap(uncorrected, uncorrected).significant:
        return none
    found: dict[str, tuple[float, Gap]] = {}
    for name in sigmas:
        step = _FIRST_STEP * TOLERANCES[name]
        error, corrected = loop.closing_error(poses, uncorrected, _NUMBERS[name], step)
        gap = loop.gap(uncorrected, corrected)
        if not (gap.closes and _large(name, error, sigmas[name], _BY_LOOP)):
            continue
        kept = loop.kept_by_views(poses, _NUMBERS[name], error)
        if _large(name, kept, sigmas[name], _BY_LOOP) and kept / error > _KEPT:
            found[name] = error, gap
    if not found:
        return none
    best = min(found, key=lambda name: found[name][1].remaining_m)
    return replace(
        none,
        alarm=True,
        errors={name: error for name, (error, _) in found.items()},
        sigmas={name: sigmas[name] for name in found},
        gap=found[best][1],
        best=best,
    )


def longest_loop(pairs: Intp) -> tuple[int, int] | None:
    """The pair (i, j) furthest apart in time between which all consecutive views overlap."""
    if not len(pairs):
        return None
    joined = np.zeros(int(pairs.max()) + 1, bool)
    joined[pairs[pairs[:, 1] == pairs[:, 0] + 1, 0]] = True
    broken = np.concatenate([[0], np.cumsum(~joined)])
    i, j = pairs.T
    whole = (broken[j] == broken[i]) & (j > i + 1)
    if not whole.any():
        return None
    k = int(np.argmax(np.where(whole, j - i, -1)))
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
    return words
