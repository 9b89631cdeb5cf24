"""Checks of timestamps (order, repetition, gaps) and of repeated images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tofuse.apps.inspection.finding import Finding
from tofuse.apps.inspection.sample import Sample, part_starts
from tofuse.engine.arrays import Float64

# Relative tolerance of regular intervals; with a smaller fraction of regular ones the camera was
# triggered manually, and gaps are meaningless.
_REGULAR_TOLERANCE, _MIN_REGULAR_FRACTION = 0.25, 0.75
_MIN_GAP = 1.75
_MIN_STEP_S = 1e-6
_MIN_STEPS = 4
# Plausible median interval of frames, s, and units of timestamps that are mistaken for seconds.
_MIN_INTERVAL_S, _MAX_INTERVAL_S = 1e-4, 300.0
_MAX_REGULAR_INTERVAL_S = 5.0  # a camera triggered manually has longer, but irregular ones
_UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9}
# Interval of frames of a typical camera, s.
_TYPICAL_INTERVAL_S = 0.05
# Maximum tolerated fraction of missing frames.
_MAX_MISSING_FRACTION = 0.01


def check_times(sample: Sample) -> Iterator[Finding]:
    """Check all timestamps, separately for each of several joined recordings."""
    times = sample.recording.timestamps
    if not sample.recording.has_timestamps:
        return
    starts = part_starts(sample.recording)
    steps, skipped = (
        np.concatenate([np.diff(part) for part in np.split(values, starts)])
        for values in (times, sample.recording.indices)
    )
    if len(steps) == 0:
        return
    yield from _check_interval(steps / skipped)
    steps = np.where(np.abs(steps) < _MIN_STEP_S, 0.0, steps)
    n_backward = int(np.count_nonzero(steps < 0))
    if n_backward:
        yield Finding(
            "time_unsorted",
            f"{n_backward} of {len(steps)} timestamps are earlier than the previous one, by up to "
            f"{-steps.min():.3g} s.",
            "Sort the frames by time, or correct timestamps.txt: they are used to predict motion.",
            {"backward_steps": n_backward, "largest_s": float(-steps.min())},
        )
    n_equal = int(np.count_nonzero(steps == 0))
    if n_equal:
        yield Finding(
            "time_repeated",
            f"{n_equal} of {len(steps)} timestamps are equal to the previous one.",
            "Correct timestamps.txt, or remove frames that were stored twice.",
            {"repeated": n_equal},
        )
    forward = steps[steps > 0]
    if n_backward or len(forward) < _MIN_STEPS:
        return
    interval = float(np.median(forward))
    gaps = forward[forward > _MIN_GAP * interval]
    missing = int(np.round(gaps / interval).sum()) - len(gaps)
    if _is_regular(forward, interval) and missing > _MAX_MISSING_FRACTION * len(times):
        are = " is" if missing == 1 else "s are"
        begin = f"About {missing} frame{are} missing: the"
        remedy = "Record to a faster disk, or at a lower rate; tracking may fail at the gaps."
        if missing > len(times):  # recorders rarely lose as many
            begin = "The"
            remedy = "Correct the times if a clock was set there; tracking may fail at the gaps."
        yield Finding(
            "frames_missing",
            f"{begin} timestamps have {len(gaps)} gap{'s' if len(gaps) > 1 else ''} of up to "
            f"{gaps.max():.3g} s; the median interval is {interval:.3g} s.",
            remedy,
            {"missing": missing, "gaps": len(gaps), "largest_s": float(gaps.max())},
        )


def _check_interval(steps: Float64) -> Iterator[Finding]:
    """Check that the median interval is that of a camera, if it is in seconds."""
    forward = steps[steps > 0]
    interval = float(np.median(forward)) if len(forward) else 1.0
    longest = _MAX_REGULAR_INTERVAL_S if _is_regular(forward, interval) else _MAX_INTERVAL_S
    if _MIN_INTERVAL_S <= interval <= longest:
        return
    # The unit in which the interval is nearest to that of a typical camera.
    unit = min(_UNITS, key=lambda name: abs(np.log(interval / _UNITS[name] / _TYPICAL_INTERVAL_S)))
    in_unit = interval / _UNITS[unit]
    likely = _MIN_INTERVAL_S <= in_unit <= _MAX_INTERVAL_S and interval > 1
    yield Finding(
        "time_unit",
        f"The median interval of frames is {interval:.3g} s, which is implausible"
        + (f"; if timestamps are in {unit}, it is {in_unit:.3g} s." if likely else "."),
        f"Divide the timestamps by {_UNITS[unit]:.0e}: they must be in seconds."
        if likely
        else "Write the timestamps in seconds.",
        {"median_interval_s": interval, "factor": _UNITS[unit] if likely else 1.0},
    )


def _is_regular(forward: Float64, interval: float) -> bool:
    """Whether most of the positive steps are those of a camera that is not triggered manually."""
    regular = np.abs(forward / interval - 1) < _REGULAR_TOLERANCE
    return len(forward) >= _MIN_STEPS and float(np.mean(regular)) >= _MIN_REGULAR_FRACTION


def check_repeats(sample: Sample) -> Iterator[Finding]:
    """Check for consecutive images that are identical."""
    pairs = sample.consecutive_images
    compared = len(pairs)
    repeated = sum(bool(a.valid.any()) and np.array_equal(a.depth, b.depth) for a, b in pairs)
    if repeated:
        yield Finding(
            "frames_repeated",
            f"{repeated} of {compared} sampled images are identical to the previous one.",
            "Skip them (--every), or find out why the camera or its driver froze.",
            {"repeated": repeated, "compared": compared},
        )
