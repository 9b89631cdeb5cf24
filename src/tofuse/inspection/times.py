"""Time stamps: in order, each once, none missing; and images that are really new."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tofuse.inspection.finding import Finding
from tofuse.inspection.sample import Sample, part_starts
from tofuse.recordings.frames import RangeFrame

# Steps within this share of the usual one are regular; with fewer than that many of them regular
# the camera was triggered by hand, and there are no gaps to speak of.
_REGULAR_WITHIN, _REGULAR_SHARE = 0.25, 0.75
_GAP = 1.75
_SAME_S = 1e-6
_FEWEST_STEPS = 4
# A frame lost now and then is usual.
_MISSING_SHARE = 0.01


def check_times(sample: Sample) -> Iterator[Finding]:
    """Look at all time stamps, of several joined recordings at each one's own."""
    times = sample.recording.timestamps
    steps = np.concatenate(
        [np.diff(part) for part in np.split(times, part_starts(sample.recording))] or [np.zeros(0)]
    )
    if len(steps) == 0:
        return
    steps = np.where(np.abs(steps) < _SAME_S, 0.0, steps)
    back = int(np.count_nonzero(steps < 0))
    if back:
        yield Finding(
            "time_unsorted",
            f"{back} of {len(steps)} time stamps are earlier than the one before, by up to "
            f"{-steps.min():.3g} s.",
            "Sort the frames by their time, or correct timestamps.txt; motion is predicted by it.",
            {"backward_steps": back, "largest_s": float(-steps.min())},
        )
    same = int(np.count_nonzero(steps == 0))
    if same:
        yield Finding(
            "time_repeated",
            f"{same} of {len(steps)} time stamps are the same as the one before.",
            "Correct timestamps.txt, or leave frames out that were stored twice.",
            {"repeated": same},
        )
    forward = steps[steps > 0]
    if back or len(forward) < _FEWEST_STEPS:
        return
    usual = float(np.median(forward))
    regular = float(np.mean(np.abs(forward / usual - 1) < _REGULAR_WITHIN))
    gaps = forward[forward > _GAP * usual]
    missing = int(np.round(gaps / usual).sum()) - len(gaps)
    if regular >= _REGULAR_SHARE and missing > _MISSING_SHARE * len(times):
        yield Finding(
            "frames_missing",
            f"About {missing} frames are missing: the time stamps have {len(gaps)} "
            f"gap{'s' if len(gaps) > 1 else ''} of up to {gaps.max():.3g} s, where {usual:.3g} s "
            "are usual.",
            "Record to a faster disk, or at a lower rate; the camera may be lost at the gaps.",
            {"missing": missing, "gaps": len(gaps), "largest_s": float(gaps.max())},
        )


def check_repeats(sample: Sample) -> Iterator[Finding]:
    """Compare the images of neighbours to the last pixel."""
    same = compared = 0
    for i, j in sample.steps:
        a, b = sample.frames[i], sample.frames[j]
        if isinstance(a, RangeFrame) and isinstance(b, RangeFrame):
            compared += 1
            same += bool(a.valid.any()) and np.array_equal(a.depth, b.depth)
    if same:
        yield Finding(
            "frames_repeated",
            f"{same} of {compared} images looked at are the same as the one before, to the last "
            "pixel.",
            "Leave them out (--every), or find out why the camera or its driver froze.",
            {"repeated": same, "compared": compared},
        )
