"""A camera whose range changes: from some frame on, or gradually.

Another mode or modulation frequency, or warming up, scales the range of later views, and poses
follow it. A scale that all views share is invisible in them, but views of the same surfaces before
and after a change disagree. Refined views give the change by a step at each view, and by a constant
drift, with all poses free: one Newton step for each. A likely change is estimated in full: the
views are scaled by it and aligned again. Joined recordings have no order in time: each may drift or
change on its own, and as a whole differ from the first one. A drift by a distance resembles errors
of the calibration and is estimated with these (`calibration_check`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.quantities import length
from tofuse.engine.refinement.camera_response import SECTIONS, Linearised, significance_of
from tofuse.engine.refinement.joint_alignment import RefinedViews, align_views
from tofuse.engine.refinement.loop_drift import COARSE_TO_FINE, thinned
from tofuse.engine.stored_views import SampledView, pair_equations

# Makers specify range errors of up to a percent. Those that depend on the distance, or multipath,
# look like smaller changes, as later views see other distances.
TOLERANCE = 0.01
# Number of standard deviations that makes a full estimate worth its time.
_LIKELY = 2.5
# Minimum number of views on either side of a step.
_MIN_VIEWS = 3
# A full estimate is made above these fractions of the tolerance and of the limit of significance,
# in at most this many steps, until one is below the last fraction of the tolerance.
_MIN_FIRST_STEP, _PROMISING, _MAX_STEPS, _CONVERGED = 0.5, 0.5, 5, 0.1
# Iterations of the poses before each step, which updates them as well: a few at the end.
_ROUNDS = (*COARSE_TO_FINE[:-1], pair_equations.Round(3, 0.0, 0.0))


@dataclass(frozen=True)
class RangeChange:
    """A change of the measured range.

    Attributes
    ----------
    change, sigma
        Relative change of the range of later views, and its standard deviation; of the last view,
        if the range drifts.
    frame
        Index of the first view after the change; None if the range drifts.
    limit
        Number of standard deviations that a significant change exceeds.
    confirmed
        Whether the change is significant, too, if the errors of successive views resemble each
        other. If not, it may be multipath, which differs from room to room.
    in_all_sections
        Whether sections of the images agree on it. If not, it is another error of the camera, by
        which steady motion looks like a drift.
    recording
        Indices of the first and the last view of the recording that changes, if several are joined.
    in_metres
        Whether the range changes by a distance, in m, and not relatively.
    """

    change: float
    sigma: float
    frame: int | None
    limit: float
    confirmed: bool = True
    in_all_sections: bool = True
    recording: tuple[int, int] | None = None
    in_metres: bool = False

    @property
    def is_significant(self) -> bool:
        """Whether the change is no chance."""
        return abs(self.change) > self.limit * self.sigma

    @property
    def is_large(self) -> bool:
        """Whether it is confirmed, and beyond the tolerance of usual cameras."""
        certain = self.is_significant and self.confirmed and self.in_all_sections
        return certain and abs(self.change) > TOLERANCE

    def in_words(self) -> str:
        """Describe the change."""
        amount = f"about {length(self.change)}" if self.in_metres else f"{100 * self.change:+.1f} %"
        by, where = f"by {amount}", "the recording"
        if self.recording is not None:
            where = "frames {} to {}".format(*self.recording)
            if self.frame == self.recording[0]:
                return f"differs {by} in {where} from that of the first recording"
        if self.frame is None:
            return f"drifts {by} over {where}"
        return f"changes {by} at about frame {self.frame}"


@dataclass(frozen=True, eq=False)
class LikelyChange:
    """First estimate of a change.

    Attributes
    ----------
    scale, sigma
        Scale of the depth of the views, per unit of the profile, that corrects the change, and its
        standard deviation.
    profile
        (N,) of the scale over the views.
    follow
        (N, 6) twists by which the poses follow, per unit of the scale.
    frame, recording
        As in `RangeChange`.
    limit
        Number of standard deviations that a significant estimate exceeds; that of a large change
        may only do so in full.
    """

    scale: float
    sigma: float
    profile: Float64
    follow: Float64
    frame: int | None
    recording: tuple[int, int] | None
    limit: float

    @property
    def is_significant(self) -> bool:
        """Whether this estimate is no chance."""
        return abs(self.scale) > self.limit * self.sigma


def likely_change(linearised: Linearised) -> LikelyChange | None:
    """Return the best step or drift over the views; None if it is no more than noise.

    The views are linearised at their refined poses.
    """
    views, pairs = linearised.state.views, linearised.state.pairs
    count = len(views)
    steps = _steps(views)
    if not len(steps):
        return None
    drifts = drifts_of(views)
    best = int(np.argmax(linearised.scale_scores(steps)))
    profiles = np.concatenate([drifts, steps[best, None]])
    found = linearised.response_to_scales(profiles)
    scales, sigmas = found.estimate(), found.sigma(pairs, count)
    ratios = np.abs(scales) / np.maximum(sigmas, 1e-12)
    k = int(np.argmax(ratios))
    if ratios[k] <= _LIKELY:
        return None
    # The views that determine a step are few, and it is the best of many (Bonferroni).
    limit = significance_of(float(found.informative_views(pairs, count)[k]), tests=count)
    first = views[int(profiles[k].argmax())]
    frame = None if k < len(drifts) else first.index
    recording = recording_of(first, views)
    return LikelyChange(
        float(scales[k]), float(sigmas[k]), profiles[k], found.motion[k], frame, recording, limit
    )


def recording_of(view: SampledView, views: Sequence[SampledView]) -> tuple[int, int] | None:
    """Indices of the first and the last view of a view's recording; None if that is of all."""
    of = [other.index for other in views if other.recording == view.recording]
    return None if len(of) == len(views) else (of[0], of[-1])


def drifts_of(views: Sequence[SampledView]) -> Float64:
    """Return the profiles (D, N) of drifts from 0 to 1, each of one recording."""
    index = np.array([view.index for view in views], float)
    recording = np.array([view.recording for view in views])
    drifts = [np.zeros((0, len(views)))]
    for number in np.unique(recording):
        own = recording == number
        if own.sum() >= 2 * _MIN_VIEWS:
            since = np.where(own, index - index[own][0], 0.0)
            drifts.append(since[None] / max(float(since.max()), 1.0))
    return np.concatenate(drifts)


def _steps(views: Sequence[SampledView]) -> Float64:
    """Return the profiles (S, N) of steps from 0 to 1, each of one recording."""
    recording = np.array([view.recording for view in views])
    steps = [np.zeros((0, len(views)))]
    for number in np.unique(recording):
        own = recording == number
        position = np.where(own, np.cumsum(own), 0)[None]  # 1, 2, ... in the recording
        first_after = np.arange(_MIN_VIEWS, own.sum() - _MIN_VIEWS + 1)[:, None] + 1
        steps.append((position >= first_after).astype(float))
        if number != recording[0] and own.sum() >= _MIN_VIEWS:
            steps.append((position >= 1).astype(float))
    return np.concatenate(steps)


def range_change(likely: LikelyChange, aligned: RefinedViews) -> RangeChange | None:
    """Estimate a likely change in full; None if it is too small or uncertain for that."""
    refined, priors = aligned.refined, aligned.priors
    promising = _PROMISING * likely.limit * likely.sigma
    if abs(likely.scale) < max(_MIN_FIRST_STEP * TOLERANCE, promising):
        return None
    views, pairs, options = thinned(aligned.views, refined.pairs, aligned.options)
    options = replace(options, rounds=_ROUNDS)
    poses = refined.poses @ se3.exp(likely.scale * likely.follow)
    scale, sigma, section_sigma = likely.scale, likely.sigma, np.inf
    for left in reversed(range(_MAX_STEPS)):
        factors = 1 + scale * likely.profile
        scaled = [view.scaled(factor) for view, factor in zip(views, factors, strict=True)]
        poses = align_views(scaled, poses, options, priors=priors, pairs=pairs).poses
        profile = (likely.profile / factors)[None]
        linearised = Linearised.of(scaled, poses, pairs, options, priors)
        found = linearised.response_to_scales(profile)
        step, sigma = float(found.estimate()[-1]), float(found.sigma(pairs, len(views))[-1])
        serial_sigma, independent = (float(v[-1]) for v in found.serial(pairs, len(views)))
        is_last = not left or abs(step) < _CONVERGED * TOLERANCE
        if is_last:
            section_sigma = linearised.section_sigma(profile)
        scale += step
        poses = poses @ se3.exp(step * found.motion[-1])
        del scaled, linearised, found  # before the views are copied again
        if is_last:
            break
    change = 1 / (1 + scale) - 1
    confirmed = abs(change) > significance_of(independent, tests=len(views)) * serial_sigma
    in_all_sections = abs(change) > significance_of(SECTIONS) * section_sigma
    return RangeChange(
        change, sigma, likely.frame, likely.limit, confirmed, in_all_sections, likely.recording
    )
