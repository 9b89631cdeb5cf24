"""Timestamps: whether they are in seconds, and which of different sensors belong together."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.bounds import Bounds
from tofuse.engine.errors import InputError
from tofuse.engine.parts import check_number

MAX_GAP_S = 0.02  # between a frame and its pose
# Longest median interval of frames, s; also for a camera that runs freely: most intervals, up to
# these percentiles, differ by less than this factor. And units that are mistaken for seconds.
_MAX_INTERVAL_S, _MAX_REGULAR_INTERVAL_S = 1000.0, 5.0
_MOST, _REGULAR_RATIO, _MIN_INTERVALS = (12.5, 50.0, 87.5), 1.5, 4
# Indices are stored as int64; intervals of longer times, of any unit, would overflow.
_INDICES, _TIMES_S = Bounds(-(2**53), 2**53), Bounds(-1e20, 1e20)
_UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9}


def nearest(times: ArrayLike, queries: ArrayLike, limit: float = np.inf) -> Intp:
    """Return for each of (N,) queries the position of the nearest of (M,) times, or -1.

    Both are in s, in any order; of equally near times it is the earlier one. They are at most
    `limit` seconds (and a nanosecond) apart.
    """
    queries, order = np.asarray(queries, float), np.argsort(times, kind="stable")
    if not len(order):
        return np.full(len(queries), -1, np.intp)
    ordered: Float64 = np.asarray(times, float)[order]
    after = np.searchsorted(ordered, queries).clip(max=len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    gap_before, gap_after = (np.abs(ordered[k] - queries) for k in (before, after))
    best = order[np.where(gap_before <= gap_after, before, after)]
    return np.where(np.minimum(gap_before, gap_after) <= limit + 1e-9, best, -1)


def partners(times: ArrayLike, others: ArrayLike, limit: float = MAX_GAP_S) -> Intp:
    """Return for each of (N,) times the position of its associate among (M,) others, or -1.

    One to one: an image that served two frames would say that nothing moved between them.
    """
    pairs = associate(times, others, limit)
    out = np.full(np.size(times), -1, np.intp)
    out[pairs[:, 0]] = pairs[:, 1]
    return out


def associate(times_a: ArrayLike, times_b: ArrayLike, limit: float = MAX_GAP_S) -> Intp:
    """Associate times one to one, less than `limit` seconds apart, closest first.

    Parameters
    ----------
    times_a, times_b
        (N,) and (M,) s; NaN is never associated.

    Returns
    -------
    (A, 2) rows in a and b, in order of a's time.
    """
    a, b = np.asarray(times_a, float), np.asarray(times_b, float)
    i, j = np.flatnonzero(np.isfinite(a)), np.flatnonzero(np.isfinite(b))
    found = [np.zeros((0, 2), np.intp)]
    # Times that are each other's nearest are those that come first, as nothing is closer to either.
    while len(i) and len(j):
        partner = nearest(b[j], a[i])
        mutual = nearest(a[i], b[j])[partner] == np.arange(len(i))
        mutual &= np.abs(a[i] - b[j[partner]]) < limit
        if not mutual.any():
            break
        found.append(np.stack([i[mutual], j[partner[mutual]]], 1))
        i, j = i[~mutual], np.delete(j, partner[mutual])
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 0], a[pairs[:, 0]]))]


def check_frame_time(index: int, timestamp: float) -> tuple[int, float]:
    """Return the index and the time of a frame as int and float; InputError if no frame has them.

    Differences of NumPy's numbers of few bits overflow.
    """
    number = check_number(index, _INDICES, "index of a frame", whole=True)
    return number, check_number(timestamp, _TIMES_S, f"frame {index}: timestamp")


def check_seconds(times: Float64) -> None:
    """Raise InputError if the intervals of times (N,), N > 1, are a camera's in another unit."""
    steps = np.diff(times)
    low, interval, high = np.percentile(steps, _MOST)
    is_regular = len(steps) >= _MIN_INTERVALS and high < _REGULAR_RATIO * low
    if interval > (_MAX_REGULAR_INTERVAL_S if is_regular else _MAX_INTERVAL_S):
        unit = next((name for name, factor in _UNITS.items() if interval < factor), "ns")
        raise InputError(
            f"have a median interval of {interval:.4g}, which is that of a camera in {unit}",
            where="timestamps",
            remedy=f"divide them by {_UNITS[unit]:.0e}, or use timedelta64, which states its unit",
        )
