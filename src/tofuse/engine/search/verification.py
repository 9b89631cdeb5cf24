"""Verification of alignments against the fit statistics of the camera.

The quality of fit at the right pose depends on the camera: 92 % of the compared pixels are inliers
for a smoothing phone, two thirds for a stereo camera. Instead of a fixed limit, `FitStatistics`
estimates the distribution of a few statistics from accepted alignments, starting with a wide prior.
Unusual alignments are not rejected, but have to be compared with rival poses.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64
from tofuse.engine.normal import robust_sigma
from tofuse.engine.quantities import percent
from tofuse.engine.search.pair_agreement import AgreementOptions

# Statistics of an alignment, all logarithms: odds of an outlier, odds of a point in free space, the
# noise scale, and the standard deviation of the log albedo.
_NOISE = 2
_NAMES = ("outliers", "free-space violations", "noise", "albedo differences")
# Fractions below these are never evidence: mixed pixels at edges, and quantisation.
_ODDS_FLOOR = np.array([0.02, 0.01])
# Prior for an unknown camera: mean and standard deviation of the statistics (15 % outliers, 2 % in
# free space, four times the stated sigmas, 5 % of the albedo), and its weight in alignments; number
# of alignments required for a known camera.
_PRIOR_MEAN = np.array([np.log(0.17 / 0.87), np.log(0.03 / 0.98), np.log(4.0), np.log(0.05)])
_PRIOR_SIGMA = np.array([0.6, 0.9, 1.5, 0.45])
_PRIOR_COUNT, _MIN_KNOWN = 2.0, 10
# Differences within this many usual standard deviations of the camera are no conflict.
_TOLERATED_SIGMAS = 2.0
# Lower limit of the spread, as the next view may differ from all so far.
_MIN_SIGMA = np.array([0.3, 0.45, 0.3, 0.35])
_WINDOW = 200
# Limit of the usual range above the median, in standard deviations.
_USUAL_SIGMAS = 3.0
# Once a camera is known, the distribution is updated every n-th alignment.
_RELEARN_EVERY = 10
# Views hardly overlap beyond this distance: the sum of a fraction of the depth and rad.
MAX_OVERLAP_DISTANCE = 1.2
# For six unknowns, with noise that is correlated between neighbouring pixels.
_MIN_INLIERS = 40
# Registrations without a prediction need more iterations than tracking.
PATIENT = (
    projective.Level(4, 15, 0.03, 0.1),
    projective.Level(2, 8, 0.005, 0.02),
    projective.Level(1, 6, 0.0, 0.0),
)
# A guess may be less accurate than a prediction in tracking: start with more noise inflation.
COARSE = (
    projective.Level(4, 25, 0.15, 0.3),
    projective.Level(4, 10, 0.03, 0.1),
    projective.Level(2, 6, 0.005, 0.02),
)


FitKind = Literal["usual", "noisy", "conflicting"]


@dataclass(frozen=True, eq=False)
class FitQuality:
    """Comparison of an alignment with those of this camera.

    Attributes
    ----------
    kind
        "usual" if all statistics are within the usual range; "noisy" if only the noise exceeds it;
        "conflicting" if the views conflict.
    excess
        Sum of the logarithms by which statistics exceed their usual value; 0 for a usual fit.
    reason
        Statistic that is out of range, with its usual value; empty for a usual fit.
    """

    kind: FitKind
    excess: float = 0.0
    reason: str = ""

    @property
    def is_usual(self) -> bool:
        """Whether all statistics are within the usual range."""
        return self.kind == "usual"


class FitStatistics:
    """Distribution of the fit statistics of correct alignments of this camera.

    Location and spread of each statistic are the median and the scaled median absolute deviation
    over the last alignments, shrunk to the prior while there are few.
    """

    def __init__(self) -> None:
        self._history: deque[Float64] = deque(maxlen=_WINDOW)
        self._mean, self._sigma = _PRIOR_MEAN, _PRIOR_SIGMA
        self._rms: deque[float] = deque(maxlen=_WINDOW)
        self._count = 0

    @property
    def noise_scale(self) -> float:
        """Usual noise scale relative to the views' stated sigmas; 0 while it is unknown."""
        return float(np.exp(self._mean[_NOISE])) if self.is_known else 0.0

    @property
    def is_known(self) -> bool:
        """Whether there were enough alignments to estimate the distribution."""
        return len(self._history) >= _MIN_KNOWN

    @property
    def albedo(self) -> float:
        """Usual standard deviation of the difference in log albedo."""
        return float(np.exp(self._mean[3]))

    @property
    def rms_fraction(self) -> float:
        """Usual rms distance of inliers from the surface, as a fraction of the depth."""
        return float(np.median(self._rms)) if self._rms else 0.0

    def learn(self, aligned: projective.Aligned, depth: float) -> None:
        """Add an accepted alignment of a view with this median depth in m."""
        self._history.append(_statistics(aligned))
        if np.isfinite(aligned.rms_m) and depth > 0:
            self._rms.append(aligned.rms_m / depth)
        self._count += 1
        if self._count <= 2 * _MIN_KNOWN or self._count % _RELEARN_EVERY == 0:
            self._update()

    def _update(self) -> None:
        history = np.stack(self._history)
        mean, sigma = _PRIOR_MEAN.copy(), _PRIOR_SIGMA.copy()
        for k in range(len(_NAMES)):
            values = history[np.isfinite(history[:, k]), k]
            n = len(values)
            if n:
                location = float(np.median(values))
                spread = robust_sigma(values - location)
                weight = n / (n + _PRIOR_COUNT)
                mean[k] += weight * (location - mean[k])
                sigma[k] = np.hypot(np.sqrt(weight) * spread, np.sqrt(1 - weight) * sigma[k])
        self._mean, self._sigma = mean, np.maximum(sigma, _MIN_SIGMA)

    def assess(self, aligned: projective.Aligned) -> FitQuality:
        """Compare an alignment with the distribution."""
        if aligned.inliers < _MIN_INLIERS:
            reason = f"{aligned.inliers} inliers are too few to determine a pose"
            return FitQuality("conflicting", np.inf, reason)
        statistics = _statistics(aligned)
        deviation = np.where(np.isfinite(statistics), statistics - self._mean, 0.0)
        worst = int(np.argmax(deviation / self._sigma))
        if deviation[worst] <= _USUAL_SIGMAS * self._sigma[worst]:
            return FitQuality("usual")
        excess = float(np.maximum(deviation, 0).sum())
        reason = _describe(worst, float(statistics[worst]), float(self._mean[worst]))
        conflict = np.delete(deviation > _USUAL_SIGMAS * self._sigma, _NOISE).any()
        return FitQuality("conflicting" if conflict else "noisy", excess, reason)


def _statistics(aligned: projective.Aligned) -> Float64:
    compared = max(aligned.compared, 1)
    fractions = np.array([1 - aligned.inliers / compared, aligned.in_front / compared])
    odds = np.log((fractions + _ODDS_FLOOR) / (1 - fractions + _ODDS_FLOOR))
    noise = np.log(aligned.noise_scale) if 0 < aligned.noise_scale < np.inf else np.nan
    albedo = (
        np.log(aligned.photo_scale) if aligned.photometric and aligned.photo_scale > 0 else np.nan
    )
    return np.array([*odds, noise, albedo])


def _describe(index: int, value: float, usual: float) -> str:
    if index < 2:
        floor = _ODDS_FLOOR[index]
        odds = np.exp([value, usual])
        fractions = np.clip((odds * (1 + floor) - floor) / (1 + odds), 0, 1)
        return f"{percent(fractions[0])} {_NAMES[index]}, usually {percent(fractions[1])}"
    return f"{_NAMES[index]} {np.exp(value - usual):.1f} times as large as usual"


def usual_tolerances(fit_statistics: FitStatistics) -> AgreementOptions:
    """Return options that tolerate the usual errors of this camera."""
    default = AgreementOptions()
    return replace(
        default,
        floor_fraction=max(default.floor_fraction, _TOLERATED_SIGMAS * fit_statistics.rms_fraction),
        albedo=max(default.albedo, _TOLERATED_SIGMAS * fit_statistics.albedo),
    )


def fine_tolerances(fit_statistics: FitStatistics) -> AgreementOptions:
    """Return options that distinguish rival poses of one image by errors beyond the usual ones."""
    coarse = usual_tolerances(fit_statistics)
    if not fit_statistics.is_known:
        return coarse
    return replace(
        coarse,
        floor_m=0.0,
        floor_fraction=_TOLERATED_SIGMAS * fit_statistics.rms_fraction,
        # An albedo difference counts against a pose beyond twice the usual one.
        albedo=2 * _TOLERATED_SIGMAS * fit_statistics.albedo,
    )


# Maximum ratio of the median depths of two views from nearby viewpoints.
_MAX_DEPTH_RATIO = 4.0


def comparable(depth: float, other: float) -> bool:
    """Whether views of these median depths can show the same scene from nearby viewpoints."""
    return 1 / _MAX_DEPTH_RATIO < depth / other < _MAX_DEPTH_RATIO
