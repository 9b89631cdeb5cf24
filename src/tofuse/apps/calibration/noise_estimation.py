"""Estimation of a camera's noise model from a static recording."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import nnls
from scipy.stats import chi2

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.errors import InputError
from tofuse.engine.frames import SATURATED_AMPLITUDE, RangeFrame, Recording
from tofuse.engine.noise import (
    AmplitudeLaw,
    ConfidenceLaw,
    Law,
    NoiseModel,
    RangeLaw,
    noise_model_for,
)
from tofuse.engine.normal import robust_sigma
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
    rms_log_error_before
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
    rms_log_error_before: float
    bins: tuple[NoiseBin, ...] = field(repr=False)
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        bins = [vars(item) for item in self.bins]
        return {**vars(self), "model": self.model.to_dict(), "bins": bins}


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

    @cached_property
    def median_unbiased(self) -> Float64:
        """Variances scaled so that their median instead of their mean is unbiased."""
        values, index = np.unique(self.freedom, return_inverse=True)
        return np.asarray(self.variance / (chi2.median(values) / values)[index], np.float64)


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
    if not recording.images(1):
        raise InputError("has no readable frame", where=recording.path)
    prior = noise_model_for(recording)
    stretches = [
        (a, b) for a, b in still.stationary_intervals(recording, prior) if b - a >= MIN_FRAMES
    ]
    if not stretches:
        raise InputError(
            f"has {quantities.count(len(recording), 'frame')}, and no {MIN_FRAMES} "
            f"consecutive static frames",
            where=recording.path,
            remedy="record ten frames or more with the camera on a stand, nothing moving",
        )
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


def _segment_samples(recording: Recording, start: int, stop: int, prior: NoiseModel) -> _Samples:
    first: RangeFrame | None = None
    for frame in recording.select(start, stop):
        assert isinstance(frame, RangeFrame)
        if first is None:
            first, count = frame, 0
            slant = ray_lengths(frame.camera).astype(float)
            valid = np.isfinite(slant)
            sums, squares = np.zeros((4, *slant.shape)), np.zeros(slant.shape)
        # Intermittently valid pixels are at the detection limit or at edges, and are excluded.
        valid &= frame.valid
        count += 1
        step = frame.radial_range.astype(float) - first.radial_range
        level = frame.confidence_image
        sums += [
            step,
            _raw_counts(frame),
            np.full(step.shape, np.nan) if level is None else level,
            prior.sigma(frame).astype(float) ** 2,
        ]
        squares += step**2
    assert first is not None
    mean_step, counts, levels, before = sums[:, valid] / count
    variance = (squares[valid] - count * mean_step**2) / (count - 1)
    return _Samples(
        np.maximum(variance, 0.0),
        np.full(len(variance), count - 1.0),
        first.radial_range[valid] + mean_step,
        counts,
        np.rint(levels),
        slant[valid],
        before,
    )


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


# Columns of a table of bins: the limits of a bin, medians of its pixels, and their number.
_LOW, _HIGH, _CENTRE, _PIXELS, _VARIANCE, _BEFORE = range(6)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A fitted law: the variance that it predicts for each pixel (NaN: none) and for each bin."""

    kind: Law
    law: AmplitudeLaw | ConfidenceLaw | RangeLaw
    variance: Float64
    bins: Float64
    predicted: Float64


def _bin(key: Float64, samples: _Samples, edges: Float64) -> Float64:
    """Return the table (K, 6) of the pixels whose key lies between consecutive edges."""
    variances = samples.median_unbiased
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
    return np.array(rows, float).reshape(-1, 6)


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
        limit = 1.5 * max(robust_sigma(errors), 1e-3)
        weights = limit / np.maximum(errors, limit)
    return x


def _amplitude_candidates(
    samples: _Samples, falloffs: Sequence[float], ceiling: float
) -> Iterator[_Candidate]:
    """Yield a law for each falloff; none without amplitude."""
    for falloff in falloffs:
        key = samples.counts * samples.slant**-falloff
        valid = np.isfinite(key) & (key > 0)
        if valid.sum() < 10 * _MIN_PIXELS:
            continue
        bins = _bin(np.where(valid, key, -1), samples, _quantile_edges(key[valid], log=True))
        bins = bins[bins[:, _VARIANCE] < (_MAX_LINEAR * ceiling) ** 2]
        if len(bins) < 3:
            continue
        columns = bins[:, [_CENTRE]] ** [0, -1, -2]
        floor2, shot2, dark2 = _nonnegative_fit(columns, bins[:, _VARIANCE], bins[:, _PIXELS])
        if shot2 == 0 and dark2 == 0:
            continue
        law = AmplitudeLaw(math.sqrt(shot2), math.sqrt(dark2), math.sqrt(floor2), falloff)
        counts = np.where(valid, key, np.nan)
        variance = floor2 + shot2 / counts + dark2 / counts**2
        yield _Candidate("amplitude", law, variance, bins, columns @ [floor2, shot2, dark2])


def _confidence_candidates(samples: _Samples) -> Iterator[_Candidate]:
    """Yield laws with several powers of the range; none without confidence."""
    valid = np.isfinite(samples.level)
    if valid.sum() < 10 * _MIN_PIXELS:
        return
    key = np.where(valid, samples.level, -1).astype(int)
    edges: Float64 = np.arange(key.max() + 2, dtype=float) - 0.5
    bins = _bin(key, samples, edges)
    if len(bins) < 2:
        return
    levels = bins[:, _CENTRE].astype(int)
    ranges = np.array([np.median(samples.range_m[key == level]) for level in levels])
    for power in (0.0, 1.0, 2.0):
        at_1_m = replace(samples, variance=samples.variance / samples.range_m ** (2 * power))
        known = _bin(key, at_1_m, edges)
        table = np.interp(np.arange(key.max() + 1), known[:, _CENTRE], known[:, _VARIANCE] ** 0.5)
        # Enforce monotony: higher levels have less noise.
        table = np.minimum(np.minimum.accumulate(table), _MAX_NOISE_M)
        law = ConfidenceLaw(tuple(float(f"{v:.4g}") for v in table), power)
        variance = np.where(valid, (table[key] * samples.range_m**power) ** 2, np.nan)
        yield _Candidate("confidence", law, variance, bins, (table[levels] * ranges**power) ** 2)


def _range_candidate(samples: _Samples) -> _Candidate:
    bins = _bin(samples.range_m, samples, _quantile_edges(samples.range_m, log=False))
    if len(bins) == 0:
        edges = np.array([samples.range_m.min(), np.nextafter(samples.range_m.max(), np.inf)])
        bins = _bin(samples.range_m, samples, edges)
    columns = bins[:, [_CENTRE]] ** [0, 2]
    if not _has_range_variation(samples):
        # a and b are not separable; the quadratic law is conservative for farther surfaces.
        columns[:, 0] = 0
    a, b = _nonnegative_fit(columns, np.sqrt(bins[:, _VARIANCE]), bins[:, _PIXELS])
    law = RangeLaw(min(float(a), _MAX_NOISE_M), min(float(b), 1.0))
    variance = (law.a + law.b * samples.range_m**2) ** 2
    return _Candidate("range", law, variance, bins, (law.a + law.b * bins[:, _CENTRE] ** 2) ** 2)


def _log_misfit(samples: _Samples, predicted: Float64) -> float:
    """Return the median absolute difference between pixels' log variances and the prediction.

    It is above 0 even for a perfect law, due to the small number of frames.
    """
    valid = (samples.variance > 0) & (predicted > 0)
    if not valid.any():
        return math.inf
    return float(np.median(np.abs(np.log(samples.median_unbiased[valid] / predicted[valid]))))


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
    best_misfit = math.inf
    laws: dict[str, Any] = {}
    best = by_range = _range_candidate(samples)
    for candidate in (
        by_range,
        *_confidence_candidates(samples),
        *_amplitude_candidates(samples, _falloffs(recording, prior), ceiling),
    ):
        misfit = _log_misfit(samples, candidate.variance)
        if misfit <= (0.99 if candidate.kind in laws else _EQUIVALENT_RATIO) * best_misfit:
            best_misfit, best = min(best_misfit, misfit), candidate
            laws[candidate.kind] = candidate.law
    model = NoiseModel(name, **laws, ceiling_m=ceiling, footprint=prior.footprint)
    error = _log_error(best.predicted, best.bins)
    frames = sum(b - a for a, b in stretches)
    return NoiseFit(
        model,
        best.kind,
        frames,
        len(stretches),
        len(samples.variance),
        error,
        _log_error(best.bins[:, _BEFORE], best.bins),
        tuple(
            NoiseBin(low, high, int(pixels), math.sqrt(variance), math.sqrt(predicted))
            for (low, high, _, pixels, variance, _), predicted in zip(
                best.bins.tolist(), best.predicted.tolist(), strict=True
            )
        ),
        tuple(_warnings(recording, samples, frames, error)),
    )


def _falloffs(recording: Recording, prior: NoiseModel) -> list[float]:
    """Return candidate exponents of the falloff compensated in range-compensated amplitude."""
    if recording.metadata.get("amplitude_kind") != "range_compensated":
        return [0.0]
    return [4.0 if prior.amplitude is None else prior.amplitude.falloff, 0.0]


def _has_range_variation(samples: _Samples) -> bool:
    """Whether the pixels' ranges vary enough to determine how noise grows with range."""
    low, high = np.quantile(samples.range_m, _RANGE_QUANTILES)
    return bool(high >= 1.5 * low)


def _log_error(predicted: Float64, bins: Float64) -> float:
    return float(np.sqrt((np.log(predicted / bins[:, _VARIANCE]) ** 2).mean()) / 2)


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
