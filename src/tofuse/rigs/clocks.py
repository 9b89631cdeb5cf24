"""What cameras' clocks differ by, from what all of them see change.

Two signals over time that mean the same, such as how fast a rig turns or how much of a scene moves,
are compared at every lag. The best lag counts where no other comes near it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64

# Signals must overlap for this share of the shorter one, and at least for so many samples.
_OVERLAP, _LEAST_SAMPLES = 0.5, 12
# Samples of the lag for each of the faster signal's.
_FINE = 4
# A peak counts if another one, further away than its width, reaches at most this share of it.
_RIVAL, _LEAST_CORRELATION = 0.8, 0.7
_MOST_LAGS = 200_000


@dataclass(frozen=True)
class Lag:
    """By how much a second clock must be put on, s, and how well the signals then agree, up to 1.

    `certain` says whether no other lag comes near.
    """

    seconds: float
    correlation: float
    certain: bool


def lag_between(
    times: Float64, values: Float64, other_times: Float64, other_values: Float64
) -> Lag | None:
    """Find what to add to `other_times` so that both signals say the same.

    Parameters
    ----------
    times, values, other_times, other_values
        (N,) and (M,), in s and in any unit; times ascend. The clocks may start at any time.

    Returns
    -------
    Lag or None
        None where a signal is too short or does not change.
    """
    if min(len(times), len(other_times)) < _LEAST_SAMPLES:
        return None
    interval = min(float(np.median(np.diff(times))), float(np.median(np.diff(other_times))))
    step = interval / _FINE
    if not step > 0 or values.std() == 0 or other_values.std() == 0:
        return None
    first = _sampled(times, values, step)
    second = _sampled(other_times, other_values, step)
    least = max(round(_OVERLAP * min(len(first), len(second))), 2)
    if len(first) + len(second) > _MOST_LAGS:
        return None
    correlation = _correlations(first, second, least)
    if not np.isfinite(correlation).any():
        return None
    best = int(np.nanargmax(correlation))
    peak = float(correlation[best])
    fine = 0.0
    if 0 < best < len(correlation) - 1:
        left, right = correlation[best - 1], correlation[best + 1]
        bend = left - 2 * peak + right
        fine = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend < 0 else 0.0
        fine = fine if np.isfinite(fine) else 0.0
    # The peak itself reaches as far as correlation falls.
    low = high = best
    while low > 0 and correlation[low - 1] <= correlation[low]:
        low -= 1
    while high < len(correlation) - 1 and correlation[high + 1] <= correlation[high]:
        high += 1
    elsewhere = np.concatenate([correlation[:low], correlation[high + 1 :]])
    elsewhere = elsewhere[np.isfinite(elsewhere)]
    rival = float(elsewhere.max()) if len(elsewhere) else 0.0
    shift = (best + fine - (len(second) - 1)) * step
    seconds = float(times[0] + shift - other_times[0])
    certain = peak >= _LEAST_CORRELATION and rival <= _RIVAL * peak
    return Lag(seconds, peak, certain)


def _sampled(times: Float64, values: Float64, step: float) -> Float64:
    """A signal at even times from the first one on, without its mean."""
    at = times[0] + step * np.arange(int((times[-1] - times[0]) / step) + 1)
    return np.interp(at, times, values)


def _correlations(a: Float64, b: Float64, least: int) -> Float64:
    """Pearson correlations over the overlap at shifts 1 - len(b) to len(a) - 1 of b.

    NaN where fewer than `least` samples overlap.
    """
    from scipy.signal import fftconvolve

    ones_a, ones_b = np.ones_like(a), np.ones_like(b)
    a, b = a - a.mean(), b - b.mean()

    def summed(x: Float64, y: Float64) -> Float64:
        return np.asarray(fftconvolve(x, y[::-1]), np.float64)

    n = np.round(summed(ones_a, ones_b))
    sa, sb = summed(a, ones_b), summed(ones_a, b)
    saa, sbb, sab = summed(a * a, ones_b), summed(ones_a, b * b), summed(a, b)
    enough = n >= least
    n = np.where(enough, n, 1)
    va, vb = saa - sa * sa / n, sbb - sb * sb / n
    floor_a, floor_b = 1e-6 * (a * a).mean(), 1e-6 * (b * b).mean()
    good = enough & (va > floor_a * n) & (vb > floor_b * n)
    product = np.sqrt(np.where(good, va * vb, 1.0))
    return np.where(good, (sab - sa * sb / n) / product, np.nan)
