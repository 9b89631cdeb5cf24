"""Multi-frequency phase unwrapping: the range at which all frequencies agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofuse.engine.arrays import Float32, Float64

SPEED_OF_LIGHT = 299_792_458.0  # m/s
# Largest rms disagreement of the frequencies, as a fraction of the shortest period.
DISAGREEMENT = 0.1


def combined(ranges: Sequence[Float32], periods_m: Sequence[float]) -> tuple[Float32, Float32]:
    """Return the range on which measurements at several frequencies agree, and the disagreement.

    It is at most the joint ambiguity range, and 40 m. The weights in means are those of equal
    phase noise, 1 / period^2.

    Parameters
    ----------
    ranges
        Radial ranges (H, W) in m, each in [0, its period), 0 where invalid.
    periods_m
        Ambiguity range of each frequency.

    Returns
    -------
    combined
        (H, W) in m, 0 where a measurement is missing.
    disagreement
        (H, W) weighted rms of the measurements about it, m.
    """  # fmt: skip
    P = np.asarray(periods_m, float)
    w = 1 / P**2
    w = w / w.sum()
    stack = np.stack([np.asarray(r, float) for r in ranges])
    valid = (stack > 0).all(0)
    first = int(np.argmin(P))  # the candidates are the wraps of the highest frequency
    limit = min(_beat(P), 40.0)
    best = np.full(stack.shape[1:], np.inf)
    out = np.zeros(stack.shape[1:])
    for k in range(int(np.ceil(limit / P[first]))):
        candidate = stack[first] + k * P[first]
        unwrapped = np.stack(
            [r + np.rint((candidate - r) / p) * p for r, p in zip(stack, P, strict=True)]
        )
        mean = np.tensordot(w, unwrapped, 1)
        error = np.sqrt(np.tensordot(w, (unwrapped - mean) ** 2, 1))
        better = valid & (error < best) & (unwrapped >= 0).all(0) & (mean < limit)
        best[better], out[better] = error[better], mean[better]
    solved = np.isfinite(best)
    return (
        np.where(solved, out, 0).astype(np.float32),
        np.where(solved, best, 0).astype(np.float32),
    )


def _beat(periods: Float64) -> float:
    """Return the joint ambiguity range of two or more periods, to 1 % of the shortest."""
    shortest = periods.min()
    for k in range(1, 1000):
        beat = k * shortest
        if (np.abs(beat / periods - np.rint(beat / periods)) * periods < 0.01 * shortest).all():
            return float(beat)
    return float(1000 * shortest)
