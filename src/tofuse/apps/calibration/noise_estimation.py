"""Estimation of a camera's noise model from a static recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from scipy.optimize import nnls
from scipy.stats import chi2

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.errors import InputError
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame, Recording
from tofuse.engine.noise import (
    AmplitudeLaw,
    ConfidenceLaw,
    Law,
    NoiseModel,
    RangeLaw,
    noise_model_for,
)
from tofuse.engine.normal import MEDIAN_OF_NORMAL
from tofuse.formats.recordings import still

MIN_FRAMES = 3
_MIN_PIXELS = 40  # in a bin
_BINS = 30
_MAX_LINEAR = 0.25  # fraction of the ceiling up to which the law is valid without phase wrapping
_MAX_RANGE_M = 200.0
_MAX_NOISE_M = 5.0
_EQUIVALENT_RATIO = 1.03  # ratio to the best law's misfit up to which a law is equivalent
_MAX_LOG_ERROR = 0.2
_RANGE_QUANTILES = (0.02, 0.98)


@dataclass(frozen=True)
class NoiseBin:
    """A bin of pixels with similar amplitude, confidence or range.

    Attributes
    ----------
    low, high
        Raw amplitude in counts, level of confidence, or range in m.
    pixels
        Number of pixels.
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
    """A fitted noise model and its goodness of fit.

    Attributes
    ----------
    model
        Contains only laws that describe the camera as well as the best one.
    law
        The law that applies to frames of this recording.
    frames, stretches, pixels
        Numbers of frames in static segments, of segments, and of pixels in all segments.
    rms_log_error
        Rms, over the bins, of the log ratio of predicted to measured sigma: 0.1 is about 10 %.
    before
        The same of the model that is used without a fit.
    bins
        Of the law that applies.
    warnings
        For the user, one line each.
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
    """Pixels that are valid in every frame of a static segment; (N,) each.

    Attributes
    ----------
    variance
        Of the radial range over time, in m^2, unbiased.
    freedom
        Its degrees of freedom.
    range_m
        Mean over the segment.
    counts
        Mean raw amplitude, before division by the falloff; NaN where there is none.
    level
        Mean confidence, rounded; NaN where there is none.
    slant
        Ratio of the ray's length to its z.
    before
        Variance predicted by the model without a fit, in m^2.
    """

    variance: Float64
    freedom: Float64
    range_m: Float64
    counts: Float64
    level: Float64
    slant: Float64
    before: Float64

    def median_unbiased(self) -> Float64:
        """Return variances scaled so that their median instead of their mean is unbiased."""
        values, index = np.unique(self.freedom, return_inverse=True)
        return self.variance / (chi2.median(values) / values)[index]


def estimate_noise(recording: Recording, name: str | None = None) -> NoiseFit:
    """Fit a noise model to the static segments of a recording.

    In each segment of at least three frames the variance over time of each pixel's range is
    computed, and the medians of these over bins of raw amplitude, confidence and range, which are
    robust to flickering edges. The laws are fitted to the bins by robust least squares of relative
    errors.

    Parameters
    ----------
    recording
        Images; at least three frames of a static camera, better ten or more at several distances.
    name
        Name of the model; by default that of the camera's family.

    Raises
    ------
    InputError
        If no three frames are static, the frames are copies, or the depths are implausible.
    """
    if not isinstance(_first_frame(recording), RangeFrame):
        raise InputError(
            "contains clouds", where=recording.path, remedy="pass a recording of depth images"
        )
    prior = noise_model_for(recording)
    stretches = [
        (a, b) for a, b in still.stationary_intervals(recording, prior) if b - a >= MIN_FRAMES
    ]
    if not stretches:
        raise _not_static_error(recording)
    samples = _concatenate([_segment_samples(recording, a, b, prior) for a, b in stretches])
    if len(samples.variance) < 10 * _MIN_PIXELS:
        raise InputError(
            f"has {len(samples.variance)} pixels that are valid throughout a static stretch",
            where=recording.path,
            remedy="record a scene within the camera's range",
        )
    if not (samples.variance > 0).mean() > 0.05:
        raise InputError(
            "repeats the same image, or its depth unit is coarser than the noise",
            where=recording.path,
            remedy="record with a live camera, in a finer unit",
        )
    if not np.median(samples.range_m) < _MAX_RANGE_M:
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


def _not_static_error(recording: Recording) -> InputError:
    if len(recording) < MIN_FRAMES:
        return InputError(
            f"has {len(recording)} frames; at least {MIN_FRAMES} are needed",
            where=recording.path,
            remedy="record ten frames or more with the camera on a stand",
        )
    return InputError(
        f"has no {MIN_FRAMES} consecutive static frames",
        where=recording.path,
        remedy="record ten frames or more with the camera on a stand, nothing moving",
    )


class _Moments:
    """Incremental mean and variance of each pixel over the frames of a segment (Welford 1962)."""

    def __init__(self, first: RangeFrame) -> None:
        shape = first.depth.shape
        self.slant = ray_lengths(first.camera).astype(float)
        self.frames = 0
        self.mean, self.moment, self.before = (np.zeros(shape) for _ in range(3))
        self.counts, self.level = np.zeros(shape), np.zeros(shape)
        # Intermittently valid pixels are at the detection limit or at edges, and are excluded.
        self.valid = np.isfinite(self.slant)

    def add(self, frame: RangeFrame, prior: NoiseModel) -> None:
        """Add the next frame."""
        self.frames += 1
        self.valid &= frame.valid
        distance = frame.radial_range.astype(float)
        step = distance - self.mean
        self.mean += step / self.frames
        self.moment += step * (distance - self.mean)
        self.before += prior.sigma(frame).astype(float) ** 2
        self.counts += _raw_counts(frame)
        level = frame.confidence_image
        self.level += np.nan if level is None else level

    def samples(self) -> _Samples:
        """Return the pixels that were valid in all frames."""
        n, valid = self.frames, self.valid
        return _Samples(
            self.moment[valid] / (n - 1),
            np.full(int(valid.sum()), n - 1.0),
            self.mean[valid],
            self.counts[valid] / n,
            np.rint(self.level[valid] / n),
            self.slant[valid],
            self.before[valid] / n,
        )


def _segment_samples(recording: Recording, start: int, stop: int, prior: NoiseModel) -> _Samples:
    moments: _Moments | None = None
    for frame in recording.select(start, stop):
        assert isinstance(frame, RangeFrame)
        moments = moments or _Moments(frame)
        moments.add(frame, prior)
    assert moments is not None
    return moments.samples()


def _concatenate(parts: Sequence[_Samples]) -> _Samples:
    names = [f.name for f in fields(_Samples)]
    return _Samples(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def _raw_counts(frame: RangeFrame) -> Float64:
    """Return the amplitude (H, W) in raw counts, up to the falloff; NaN if missing or saturated."""
    if frame.amplitude_image is None:
        return np.full(frame.depth.shape, np.nan)
    counts = frame.amplitude_image.astype(float)
    valid = (counts > 0) & (counts < SATURATED_AMPLITUDE) & frame.valid
    if frame.amplitude_kind == "range_compensated":
        counts = counts / np.where(valid, frame.radial_range.astype(float) ** 2, 1)
    return np.where(valid, counts, np.nan)


@dataclass(frozen=True, eq=False)
class _Binned:
    """Medians over bins; (K,) each, `edges` (K, 2)."""

    edges: Float64
    centre: Float64
    pixels: Float64
    variance: Float64
    before: Float64


def _bin(key: Float64, samples: _Samples, edges: Float64) -> _Binned:
    """Return the medians of the pixels whose key lies between consecutive edges."""
    variances = samples.median_unbiased()
    bin_of = np.searchsorted(edges, key, side="right") - 1
    rows = []
    for k in range(len(edges) - 1):
        inside = bin_of == k
        if inside.sum() < _MIN_PIXELS:
            continue
        variance = float(np.median(variances[inside]))
        if (variances[inside] > 0).mean() < 0.9:  # quantisation: many pixels never change
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


def _nonnegative_fit(columns: Float64, target: Float64, pixels: Float64) -> Float64:
    """Fit ``columns @ x`` to `target` (K,) with non-negative x, minimising relative errors.

    Least squares with Huber weights on the log ratio; bins are weighted by their pixels, up to
    twenty times the smallest permitted number.
    """
    base = np.sqrt(np.minimum(pixels, 20 * _MIN_PIXELS))
    scale = np.maximum(np.abs(columns).max(0), 1e-300)
    weights = np.ones(len(target))
    x = np.zeros(columns.shape[1])
    for _ in range(12):
        w = base * np.sqrt(weights) / target
        x = nnls(columns / scale * w[:, None], target * w)[0] / scale
        errors = np.abs(np.log(np.maximum(columns @ x, 1e-30) / target))
        limit = 1.5 * max(float(np.median(errors)) / MEDIAN_OF_NORMAL, 1e-3)
        weights = limit / np.maximum(errors, limit)
    return x


def _fit_amplitude(
    samples: _Samples, falloff: float, ceiling: float
) -> tuple[AmplitudeLaw, _Binned] | None:
    """Return the law and the bins it was fitted to; None without amplitude."""
    with np.errstate(invalid="ignore"):
        key = samples.counts * samples.slant**-falloff
    valid = np.isfinite(key) & (key > 0)
    if valid.sum() < 10 * _MIN_PIXELS:
        return None
    bins = _bin(np.where(valid, key, -1), samples, _quantile_edges(key[valid], log=True))
    bins = _select(bins, bins.variance < (_MAX_LINEAR * ceiling) ** 2)
    if len(bins.centre) < 3:
        return None
    amplitude = bins.centre
    columns = np.stack([np.ones_like(amplitude), 1 / amplitude, 1 / amplitude**2], 1)
    floor2, shot2, dark2 = _nonnegative_fit(columns, bins.variance, bins.pixels)
    if shot2 == 0 and dark2 == 0:
        return None
    law = AmplitudeLaw(math.sqrt(shot2), math.sqrt(dark2), math.sqrt(floor2), falloff)
    return law, bins


def _fit_confidence(samples: _Samples) -> tuple[ConfidenceLaw, _Binned] | None:
    valid = np.isfinite(samples.level)
    if valid.sum() < 10 * _MIN_PIXELS:
        return None
    max_level = int(samples.level[valid].max())
    edges: Float64 = np.arange(max_level + 2, dtype=float) - 0.5
    key = np.where(valid, samples.level, -1)
    best: tuple[float, ConfidenceLaw] | None = None
    bins = _bin(key, samples, edges)
    if len(bins.centre) < 2:
        return None
    for power in (0.0, 1.0, 2.0):
        at_1_m = replace(samples, variance=samples.variance / samples.range_m ** (2 * power))
        bins_at_1_m = _bin(key, at_1_m, edges)
        table = np.interp(
            np.arange(max_level + 1), bins_at_1_m.centre, np.sqrt(bins_at_1_m.variance)
        )
        # Enforce monotony: higher levels have less noise.
        table = np.minimum(np.minimum.accumulate(table), _MAX_NOISE_M)
        law = ConfidenceLaw(tuple(float(f"{v:.4g}") for v in table), power)
        sigma = table[np.clip(np.nan_to_num(samples.level), 0, max_level).astype(int)]
        score = _log_misfit(samples, (sigma * samples.range_m**power) ** 2, valid)
        if best is None or score < 0.99 * best[0]:
            best = score, law
    assert best is not None
    return best[1], bins


def _fit_range(samples: _Samples) -> tuple[RangeLaw, _Binned]:
    bins = _bin(samples.range_m, samples, _quantile_edges(samples.range_m, log=False))
    if len(bins.centre) == 0:
        edges = np.array([samples.range_m.min(), np.nextafter(samples.range_m.max(), np.inf)])
        bins = _bin(samples.range_m, samples, edges)
    columns = np.stack([np.ones_like(bins.centre), bins.centre**2], 1)
    if not _has_range_variation(samples):
        # a and b are not separable; the quadratic law is conservative for farther surfaces.
        columns[:, 0] = 0
    a, b = _nonnegative_fit(columns, np.sqrt(bins.variance), bins.pixels)
    return RangeLaw(min(float(a), _MAX_NOISE_M), min(float(b), 1.0)), bins


def _select(bins: _Binned, mask: Bool) -> _Binned:
    return _Binned(**{f.name: getattr(bins, f.name)[mask] for f in fields(_Binned)})


def _log_misfit(samples: _Samples, predicted: Float64, mask: Bool) -> float:
    """Return the median absolute difference between pixels' log variances and the prediction.

    It is above 0 even for a perfect law, due to the small number of frames.
    """
    valid = mask & (samples.variance > 0) & (predicted > 0)
    if not valid.any():
        return math.inf
    return float(np.median(np.abs(np.log(samples.median_unbiased()[valid] / predicted[valid]))))


def _fit(
    recording: Recording,
    samples: _Samples,
    prior: NoiseModel,
    name: str,
    stretches: Sequence[tuple[int, int]],
) -> NoiseFit:
    ceiling = prior.ceiling_m
    ambiguity = recording.metadata.get("ambiguity_m")
    if isinstance(ambiguity, int | float) and 0 < ambiguity <= _MAX_RANGE_M:
        ceiling = float(ambiguity) / math.sqrt(12)
    range_law, range_bins = _fit_range(samples)
    all_pixels = np.ones(len(samples.variance), bool)
    variance = (range_law.a + range_law.b * samples.range_m**2) ** 2
    best_misfit = _log_misfit(samples, variance, all_pixels)
    law: Law = "range"
    bins, predicted = range_bins, (range_law.a + range_law.b * range_bins.centre**2) ** 2

    confidence = None
    table = _fit_confidence(samples)
    if table is not None:
        confidence, levels = table
        sigma = np.array(confidence.sigma_m)
        pixel_sigma = sigma[np.clip(np.nan_to_num(samples.level), 0, len(sigma) - 1).astype(int)]
        valid_level = np.isfinite(samples.level)
        score = _log_misfit(
            samples, (pixel_sigma * samples.range_m**confidence.power) ** 2, valid_level
        )
        if score > _EQUIVALENT_RATIO * best_misfit:
            confidence = None
        else:
            best_misfit, law, bins = min(best_misfit, score), "confidence", levels
            mean_range = [
                float(np.median(samples.range_m[samples.level == k])) for k in levels.centre
            ]
            bin_sigma = sigma[levels.centre.astype(int)] * np.array(mean_range) ** confidence.power
            predicted = bin_sigma**2

    amplitude = None
    for falloff in _falloffs(recording, prior):
        fitted = _fit_amplitude(samples, falloff, ceiling)
        if fitted is None:
            continue
        counts = samples.counts * samples.slant**-falloff
        valid = np.isfinite(counts) & (counts > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            score = _log_misfit(samples, _amplitude_variance(fitted[0], counts), valid)
        if score <= (_EQUIVALENT_RATIO if amplitude is None else 0.99) * best_misfit:
            best_misfit, law, bins = min(best_misfit, score), "amplitude", fitted[1]
            amplitude = fitted[0]
            predicted = _amplitude_variance(amplitude, bins.centre)

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
    """Return candidate exponents of the falloff compensated in range-compensated amplitude."""
    if recording.metadata.get("amplitude_kind") != "range_compensated":
        return [0.0]
    return [4.0 if prior.amplitude is None else prior.amplitude.falloff, 0.0]


def _amplitude_variance(law: AmplitudeLaw, counts: Float64) -> Float64:
    return law.floor**2 + law.shot**2 / counts + (law.dark / counts) ** 2


def _has_range_variation(samples: _Samples) -> bool:
    """Whether the pixels' ranges vary enough to determine how noise grows with range."""
    low, high = np.quantile(samples.range_m, _RANGE_QUANTILES)
    return bool(high >= 1.5 * low)


def _log_error(predicted: Float64, bins: _Binned) -> float:
    return float(np.sqrt((np.log(predicted / bins.variance) ** 2).mean()) / 2)


def _warnings(recording: Recording, samples: _Samples, frames: int, error: float) -> list[str]:
    out = []
    if frames < len(recording):
        out.append(f"{frames} of {len(recording)} frames are in static segments")
    if not _has_range_variation(samples):
        low, high = np.quantile(samples.range_m, _RANGE_QUANTILES)
        out.append(f"ranges of {low:.2f} to {high:.2f} m only: the noise at others is extrapolated")
    if error > _MAX_LOG_ERROR:
        out.append(f"the law describes the noise to {100 * (math.exp(error) - 1):.0f} % only")
    return out
