"""Synchronisation of clocks by cross-correlation.

Two signals of the same quantity, for instance the angular speed of a rig or the moving fraction of
a scene, are correlated at every lag. The best lag is certain if no other one correlates similarly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.signal import fftconvolve, find_peaks

from tofuse.engine.arrays import Float64

# Minimum overlap of the signals, as a fraction of the shorter one, and minimum number of samples.
_OVERLAP, _MIN_SAMPLES = 0.5, 12
# Samples of the lag per sample of the faster signal.
_OVERSAMPLING = 4
# Largest ratio of another peak, outside the main one, to the best; minimum correlation.
_MAX_RIVAL, _MIN_CORRELATION = 0.8, 0.7
# Maximum probability that noise correlates as much at some lag: short signals do.
_MAX_CHANCE = 0.01
_MAX_LAGS = 200_000


@dataclass(frozen=True)
class Lag:
    """The offset to add to a second clock, s, and the correlation of the signals, up to 1.

    `certain` is whether no other lag has a similar correlation.
    """

    seconds: float
    correlation: float
    certain: bool


def lag_between(
    times: Float64, values: Float64, other_times: Float64, other_values: Float64
) -> Lag | None:
    """Estimate the offset to add to `other_times` that aligns both signals.

    Parameters
    ----------
    times, values, other_times, other_values
        (N,) and (M,), in s and in any unit; times ascend. The clocks may start at any time.

    Returns
    -------
    Lag or None
        None if a signal is too short or constant.
    """
    if min(len(times), len(other_times)) < _MIN_SAMPLES:
        return None
    interval = min(float(np.median(np.diff(times))), float(np.median(np.diff(other_times))))
    step = interval / _OVERSAMPLING
    if not step > 0 or values.std() == 0 or other_values.std() == 0:
        return None
    first = _resampled(times, values, step)
    second = _resampled(other_times, other_values, step)
    min_overlap = max(round(_OVERLAP * min(len(first), len(second))), 2)
    if len(first) + len(second) > _MAX_LAGS:
        return None
    correlation = _correlations(first, second, min_overlap)
    if not np.isfinite(correlation).any():
        return None
    best = int(np.nanargmax(correlation))
    peak = float(correlation[best])
    window = correlation[max(best - 1, 0) : best + 2]
    subsample = 0.0
    if len(window) == 3 and np.isfinite(window).all():
        curvature = window[0] - 2 * peak + window[2]
        subsample = 0.5 * (window[0] - window[2]) / min(curvature, -1e-12)
    peaks, _ = find_peaks(np.nan_to_num(correlation, nan=-1.0))
    rival = float(correlation[peaks[peaks != best]].max(initial=0.0))
    shift = (best + subsample - (len(second) - 1)) * step
    seconds = float(times[0] + shift - other_times[0])
    certain = peak >= _MIN_CORRELATION and rival <= _MAX_RIVAL * peak
    lag = best - (len(second) - 1)
    overlap = min(len(first), lag + len(second)) - max(lag, 0)
    lags = np.isfinite(correlation).sum() / _OVERSAMPLING
    chance = lags * _chance(peak, overlap / _OVERSAMPLING)
    return Lag(seconds, peak, bool(certain and chance <= _MAX_CHANCE))


def _chance(correlation: float, samples: float) -> float:
    """Return the probability that noise correlates by as much, by Fisher's transformation."""
    z = np.arctanh(min(correlation, 1 - 1e-9)) * np.sqrt(max(samples - 3, 0.0))
    return float(stats.norm.sf(z))


def _resampled(times: Float64, values: Float64, step: float) -> Float64:
    """Return a signal resampled at regular times from the first one on."""
    at = times[0] + step * np.arange(int((times[-1] - times[0]) / step) + 1)
    return np.interp(at, times, values)


def _correlations(a: Float64, b: Float64, min_overlap: int) -> Float64:
    """Return Pearson correlations over the overlap at shifts 1 - len(b) to len(a) - 1 of b.

    NaN where fewer than `min_overlap` samples overlap.
    """
    ones_a, ones_b = np.ones_like(a), np.ones_like(b)
    a, b = a - a.mean(), b - b.mean()

    def summed(x: Float64, y: Float64) -> Float64:
        return np.asarray(fftconvolve(x, y[::-1]), np.float64)

    n = np.round(summed(ones_a, ones_b))
    sa, sb = summed(a, ones_b), summed(ones_a, b)
    saa, sbb, sab = summed(a * a, ones_b), summed(ones_a, b * b), summed(a, b)
    enough = n >= min_overlap
    n = np.where(enough, n, 1)
    va, vb = saa - sa * sa / n, sbb - sb * sb / n
    floor_a, floor_b = 1e-6 * (a * a).mean(), 1e-6 * (b * b).mean()
    valid = enough & (va > floor_a * n) & (vb > floor_b * n)
    product = np.sqrt(np.where(valid, va * vb, 1.0))
    return np.where(valid, (sab - sa * sb / n) / product, np.nan)
