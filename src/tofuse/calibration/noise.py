"""A camera's noise, estimated from a recording in which nothing moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from scipy.optimize import nnls
from scipy.stats import chi2

from tofuse.arrays import Bool, Float64
from tofuse.errors import InputError
from tofuse.geometry.cameras import ray_lengths
from tofuse.recordings.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.recording import Recording
from tofuse.recordings.still import stationary_intervals
from tofuse.sensor.noise import AmplitudeLaw, ConfidenceLaw, Law, NoiseModel, RangeLaw

LEAST_FRAMES = 3
_LEAST_PIXELS = 40  # in a bin
_BINS = 30
_LINEAR = 0.25  # of the ceiling: beyond it the phase wraps and the law bends
_FARTHEST_M = 200.0
_LARGEST_M = 5.0
_WORSE = 1.03  # than the best law: still as good
_GOOD = 0.2
_MOST = (0.02, 0.98)


@dataclass(frozen=True)
class NoiseBin:
    """Pixels alike in what a law looks at.

    Attributes
    ----------
    low, high
        Raw amplitude in counts, level of confidence, or range in m.
    pixels
        How many.
    measured_m, predicted_m
        Standard deviation of the radial range.
    """

    low: float
    high: float
    pixels: int
    measured_m: float
    predicted_m: float


@dataclass(frozen=True)
class NoiseFit:
    """A noise model and how well it describes what it was fitted to.

    Attributes
    ----------
    model
        Holds only laws that describe the camera as well as any other.
    law
        The one that decides for frames like these.
    frames, stretches, pixels
        What was used: frames in still stretches, stretches, pixels of all stretches.
    rms_log_error
        Root mean square, over the bins, of the log ratio of predicted to measured deviation: 0.1
        is about 10 %.
    before
        The same of the model that would have been chosen without a fit.
    bins
        Of the deciding law.
    warnings
        What a person should know, one line each.
    """

    model: NoiseModel
    law: Law
    frames: int
    stretches: int
    pixels: int
    rms_log_error: float
    before: float
    bins: tuple[NoiseBin, ...] = field(repr=False)
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "model": self.model.to_dict(),
            "law": self.law,
            "frames": self.frames,
            "stretches": self.stretches,
            "pixels": self.pixels,
            "rms_log_error": self.rms_log_error,
            "rms_log_error_before": self.before,
            "bins": [vars(item) for item in self.bins],
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, eq=False)
class _Samples:
    """Pixels that were measured in every frame of a still stretch; (N,) each.

    Attributes
    ----------
    variance
        Of the radial range over time, in m^2, unbiased.
    freedom
        Its degrees of freedom.
    range_m
        Mean over the stretch.
    counts
        Mean raw amplitude, but for the falloff; NaN where there is none.
    level
        Mean confidence, rounded; NaN where there is none.
    slant
        Length of the ray over its z.
    before
        Variance that the model so far predicts, in m^2.
    """

    variance: Float64
    freedom: Float64
    range_m: Float64
    counts: Float64
    level: Float64
    slant: Float64
    before: Float64

    def typical(self) -> Float64:
        """Variances of which the median over alike pixels, not the mean, is unbiased."""
        values, where = np.unique(self.freedom, return_inverse=True)
        return self.variance / (chi2.median(values) / values)[where]


def estimate_noise(recording: Recording, name: str | None = None) -> NoiseFit:
    """Fit a noise model to the still stretches of a recording.

    In each stretch of at least three frames the variance over time of each pixel's range is taken,
    and their medians in bins of raw amplitude, confidence and range, which no flickering edge
    disturbs. The laws are fitted to the bins by least squares of relative errors, with weights
    that fall for outliers.

    Parameters
    ----------
    recording
        Images; three frames at one place do, ten or more at several distances are better.
    name
        Of the model; that of the camera's family if not given.

    Raises
    ------
    InputError
        If nothing is still for three frames, the frames are copies, or the depths make no sense.
    """
    if not isinstance(_first_frame(recording), RangeFrame):
        raise InputError(
            "holds clouds", where=recording.path, remedy="give a recording of depth images"
        )
    prior = noise_model_for(recording)
    stretches = [(a, b) for a, b in stationary_intervals(recording, prior) if b - a >= LEAST_FRAMES]
    if not stretches:
        raise _not_still(recording)
    samples = _joined([_pixels(recording, a, b, prior) for a, b in stretches])
    if len(samples.variance) < 10 * _LEAST_PIXELS:
        raise InputError(
            f"has {len(samples.variance)} pixels that are valid throughout a still stretch",
            where=recording.path,
            remedy="record a scene within the camera's range",
        )
    if not (samples.variance > 0).mean() > 0.05:
        raise InputError(
            "repeats the same image, or has no noise to see in its depth unit",
            where=recording.path,
            remedy="record with a live camera, in a finer unit",
        )
    if not np.median(samples.range_m) < _FARTHEST_M:
        raise InputError(
            f"has a median range of {np.median(samples.range_m):.0f} m",
            where=recording.path,
            remedy="check depth_unit_m in its camera.json",
        )
    return _fit(recording, samples, prior, name or prior.name, stretches)


def _first_frame(recording: Recording) -> Frame:
    frame = recording.first_readable()
    if frame is None:
        raise InputError("has no readable frame", where=recording.path)
    return frame


def _not_still(recording: Recording) -> InputError:
    if len(recording) < LEAST_FRAMES:
        return InputError(
            f"has {len(recording)} frames, and noise shows in {LEAST_FRAMES} or more",
            where=recording.path,
            remedy="record ten frames or more with the camera on a stand",
        )
    return InputError(
        f"is nowhere still for {LEAST_FRAMES} frames",
        where=recording.path,
        remedy="record ten frames or more with the camera on a stand, nothing moving",
    )


class _Moments:
    """Mean and variance of each pixel over the frames of a stretch, one by one (Welford 1962)."""

    def __init__(self, first: RangeFrame) -> None:
        shape = first.depth.shape
        self.slant = ray_lengths(first.camera).astype(float)
        self.frames = 0
        self.mean, self.moment, self.before = (np.zeros(shape) for _ in range(3))
        self.counts, self.level = np.zeros(shape), np.zeros(shape)
        # Pixels that come and go are at the limit of what the camera measures, or at edges.
        self.always = np.isfinite(self.slant)

    def add(self, frame: RangeFrame, prior: NoiseModel) -> None:
        """Take in the next frame."""
        self.frames += 1
        self.always &= frame.valid
        distance = frame.radial_range.astype(float)
        step = distance - self.mean
        self.mean += step / self.frames
        self.moment += step * (distance - self.mean)
        self.before += prior.sigma(frame).astype(float) ** 2
        self.counts += _raw_counts(frame)
        level = frame.confidence_image
        self.level += np.nan if level is None else level

    def samples(self) -> _Samples:
        """Return the pixels that were always there."""
        n, ok = self.frames, self.always
        return _Samples(
            self.moment[ok] / (n - 1),
            np.full(int(ok.sum()), n - 1.0),
            self.mean[ok],
            self.counts[ok] / n,
            np.rint(self.level[ok] / n),
            self.slant[ok],
            self.before[ok] / n,
        )


def _pixels(recording: Recording, start: int, stop: int, prior: NoiseModel) -> _Samples:
    moments: _Moments | None = None
    for frame in recording.select(start, stop):
        assert isinstance(frame, RangeFrame)
        moments = moments or _Moments(frame)
        moments.add(frame, prior)
    assert moments is not None
    return moments.samples()


def _joined(parts: Sequence[_Samples]) -> _Samples:
    names = [f.name for f in fields(_Samples)]
    return _Samples(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def _raw_counts(frame: RangeFrame) -> Float64:
    """Amplitude (H, W) in raw counts but for the falloff, NaN where none or saturated."""
    if frame.amplitude_image is None:
        return np.full(frame.depth.shape, np.nan)
    counts = frame.amplitude_image.astype(float)
    good = (counts > 0) & (counts < SATURATED_AMPLITUDE) & frame.valid
    if frame.amplitude_kind == "range_compensated":
        counts = counts / np.where(good, frame.radial_range.astype(float) ** 2, 1)
    return np.where(good, counts, np.nan)


@dataclass(frozen=True, eq=False)
class _Binned:
    """Medians over bins of alike pixels; (K,) each, `edges` (K, 2)."""

    edges: Float64
    centre: Float64
    pixels: Float64
    variance: Float64
    before: Float64


def _binned(key: Float64, samples: _Samples, edges: Float64) -> _Binned:
    """Take medians of the pixels whose key lies between consecutive edges."""
    typical = samples.typical()
    place = np.searchsorted(edges, key, side="right") - 1
    rows = []
    for k in range(len(edges) - 1):
        inside = place == k
        if inside.sum() < _LEAST_PIXELS:
            continue
        variance = float(np.median(typical[inside]))
        if (typical[inside] > 0).mean() < 0.9:  # depth so coarse that many pixels never change
            variance = float(samples.variance[inside].mean())
        if variance > 0:
            centre, before = np.median(key[inside]), np.median(samples.before[inside])
            rows.append((edges[k], edges[k + 1], centre, inside.sum(), variance, before))
    table = np.array(rows, float).reshape(-1, 6)
    return _Binned(table[:, :2], *table[:, 2:].T)


def _quantile_edges(key: Float64, *, log: bool) -> Float64:
    low, high = np.quantile(key, [0.002, 0.998])
    if not high > low * (1 + 1e-6):
        return np.array([low * 0.99, high * 1.01 + 1e-12])
    return np.geomspace(low, high, _BINS + 1) if log else np.linspace(low, high, _BINS + 1)


def _nonnegative(columns: Float64, target: Float64, pixels: Float64) -> Float64:
    """Non-negative x for which ``columns @ x`` is near `target` (K,), in relative terms.

    Least squares with Huber's weights on the log of the ratio; bins count by their pixels, but
    none more than twenty times the smallest that is allowed.
    """
    base = np.sqrt(np.minimum(pixels, 20 * _LEAST_PIXELS))
    scale = np.maximum(np.abs(columns).max(0), 1e-300)
    weights = np.ones(len(target))
    x = np.zeros(columns.shape[1])
    for _ in range(12):
        w = base * np.sqrt(weights) / target
        x = nnls(columns / scale * w[:, None], target * w)[0] / scale
        off = np.abs(np.log(np.maximum(columns @ x, 1e-30) / target))
        limit = 1.5 * max(float(np.median(off)) / 0.6745, 1e-3)
        weights = limit / np.maximum(off, limit)
    return x


def _fit_amplitude(
    samples: _Samples, falloff: float, ceiling: float
) -> tuple[AmplitudeLaw, _Binned] | None:
    """Return the law and the bins it was fitted to; None without amplitude."""
    with np.errstate(invalid="ignore"):
        key = samples.counts * samples.slant**-falloff
    lit = np.isfinite(key) & (key > 0)
    if lit.sum() < 10 * _LEAST_PIXELS:
        return None
    bins = _binned(np.where(lit, key, -1), samples, _quantile_edges(key[lit], log=True))
    bins = _where(bins, bins.variance < (_LINEAR * ceiling) ** 2)
    if len(bins.centre) < 3:
        return None
    light = bins.centre
    columns = np.stack([np.ones_like(light), 1 / light, 1 / light**2], 1)
    floor2, shot2, dark2 = _nonnegative(columns, bins.variance, bins.pixels)
    if shot2 == 0 and dark2 == 0:
        return None
    law = AmplitudeLaw(math.sqrt(shot2), math.sqrt(dark2), math.sqrt(floor2), falloff)
    return law, bins


def _fit_confidence(samples: _Samples) -> tuple[ConfidenceLaw, _Binned] | None:
    known = np.isfinite(samples.level)
    if known.sum() < 10 * _LEAST_PIXELS:
        return None
    top = int(samples.level[known].max())
    edges: Float64 = np.arange(top + 2, dtype=float) - 0.5
    key = np.where(known, samples.level, -1)
    best: tuple[float, ConfidenceLaw] | None = None
    bins = _binned(key, samples, edges)
    if len(bins.centre) < 2:
        return None
    for power in (0.0, 1.0, 2.0):
        at_one = replace(samples, variance=samples.variance / samples.range_m ** (2 * power))
        found = _binned(key, at_one, edges)
        table = np.interp(np.arange(top + 1), found.centre, np.sqrt(found.variance))
        # Better levels are better, whatever a few pixels say.
        table = np.minimum(np.minimum.accumulate(table), _LARGEST_M)
        law = ConfidenceLaw(tuple(float(f"{v:.4g}") for v in table), power)
        sigma = table[np.clip(np.nan_to_num(samples.level), 0, top).astype(int)]
        score = _misfit(samples, (sigma * samples.range_m**power) ** 2, known)
        if best is None or score < 0.99 * best[0]:
            best = score, law
    assert best is not None
    return best[1], bins


def _fit_range(samples: _Samples) -> tuple[RangeLaw, _Binned]:
    bins = _binned(samples.range_m, samples, _quantile_edges(samples.range_m, log=False))
    if len(bins.centre) == 0:
        everything = np.array([samples.range_m.min(), np.nextafter(samples.range_m.max(), np.inf)])
        bins = _binned(samples.range_m, samples, everything)
    columns = np.stack([np.ones_like(bins.centre), bins.centre**2], 1)
    if not _spread(samples):
        # Nothing tells a from b; that of surfaces alike is the more careful for those beyond.
        columns[:, 0] = 0
    a, b = _nonnegative(columns, np.sqrt(bins.variance), bins.pixels)
    return RangeLaw(min(float(a), _LARGEST_M), min(float(b), 1.0)), bins


def _where(bins: _Binned, mask: Bool) -> _Binned:
    return _Binned(**{f.name: getattr(bins, f.name)[mask] for f in fields(_Binned)})


def _misfit(samples: _Samples, predicted: Float64, where: Bool) -> float:
    """Median distance of the log variances of single pixels from those predicted.

    Even a perfect law leaves what so few frames say about a variance; less is better.
    """
    ok = where & (samples.variance > 0) & (predicted > 0)
    if not ok.any():
        return math.inf
    return float(np.median(np.abs(np.log(samples.typical()[ok] / predicted[ok]))))


def _fit(
    recording: Recording,
    samples: _Samples,
    prior: NoiseModel,
    name: str,
    stretches: Sequence[tuple[int, int]],
) -> NoiseFit:
    ceiling = prior.ceiling_m
    period = recording.metadata.get("ambiguity_m")
    if isinstance(period, int | float) and 0 < period <= _FARTHEST_M:
        ceiling = float(period) / math.sqrt(12)
    range_law, range_bins = _fit_range(samples)
    everywhere = np.ones(len(samples.variance), bool)
    far = (range_law.a + range_law.b * samples.range_m**2) ** 2
    least = _misfit(samples, far, everywhere)
    law: Law = "range"
    bins, predicted = range_bins, (range_law.a + range_law.b * range_bins.centre**2) ** 2

    confidence = None
    table = _fit_confidence(samples)
    if table is not None:
        confidence, levels = table
        sigma = np.array(confidence.sigma_m)
        of_pixel = sigma[np.clip(np.nan_to_num(samples.level), 0, len(sigma) - 1).astype(int)]
        known = np.isfinite(samples.level)
        score = _misfit(samples, (of_pixel * samples.range_m**confidence.power) ** 2, known)
        if score > _WORSE * least:
            confidence = None
        else:
            least, law, bins = min(least, score), "confidence", levels
            mean_range = [
                float(np.median(samples.range_m[samples.level == k])) for k in levels.centre
            ]
            of_bin = sigma[levels.centre.astype(int)] * np.array(mean_range) ** confidence.power
            predicted = of_bin**2

    amplitude = None
    for falloff in _falloffs(recording, prior):
        light = _fit_amplitude(samples, falloff, ceiling)
        if light is None:
            continue
        counts = samples.counts * samples.slant**-falloff
        seen = np.isfinite(counts) & (counts > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            score = _misfit(samples, _of_light(light[0], counts), seen)
        if score <= (_WORSE if amplitude is None else 0.99) * least:
            least, law, bins = min(least, score), "amplitude", light[1]
            amplitude = light[0]
            predicted = _of_light(amplitude, bins.centre)

    model = NoiseModel(
        name,
        range_law,
        amplitude,
        confidence,
        ceiling_m=ceiling,
        footprint=prior.footprint,
    )
    error = _log_error(predicted, bins)
    frames = sum(b - a for a, b in stretches)
    return NoiseFit(
        model,
        law,
        frames,
        len(stretches),
        len(samples.variance),
        error,
        _log_error(bins.before, bins),
        tuple(
            NoiseBin(float(low), float(high), int(n), math.sqrt(v), math.sqrt(p))
            for (low, high), n, v, p in zip(
                bins.edges, bins.pixels, bins.variance, predicted, strict=True
            )
        ),
        tuple(_warnings(recording, samples, frames, error)),
    )


def _falloffs(recording: Recording, prior: NoiseModel) -> list[float]:
    """Powers of the cosine that a range-compensated amplitude may have been divided by."""
    if recording.metadata.get("amplitude_kind") != "range_compensated":
        return [0.0]
    return [4.0 if prior.amplitude is None else prior.amplitude.falloff, 0.0]


def _of_light(law: AmplitudeLaw, counts: Float64) -> Float64:
    return law.floor**2 + law.shot**2 / counts + (law.dark / counts) ** 2


def _spread(samples: _Samples) -> bool:
    """Whether the pixels' ranges differ enough to tell how noise grows with range."""
    low, high = np.quantile(samples.range_m, _MOST)
    return bool(high >= 1.5 * low)


def _log_error(predicted: Float64, bins: _Binned) -> float:
    return float(np.sqrt((np.log(predicted / bins.variance) ** 2).mean()) / 2)


def _warnings(recording: Recording, samples: _Samples, frames: int, error: float) -> list[str]:
    out = []
    if frames < len(recording):
        out.append(f"{frames} of {len(recording)} frames are in still stretches")
    if not _spread(samples):
        low, high = np.quantile(samples.range_m, _MOST)
        out.append(
            f"ranges of {low:.2f} to {high:.2f} m only: what is said of others is extrapolated"
        )
    if error > _GOOD:
        out.append(f"the law describes the noise to {100 * (math.exp(error) - 1):.0f} % only")
    return out
