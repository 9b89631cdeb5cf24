"""Numbers and reasons as text: lengths, ranges of frames, the verdict in a sentence."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np

from tofuse.engine.frames import frame_ranges
from tofuse.engine.quantities import length
from tofuse.engine.results import Reason, verdicts

STATUSES = ("tracked", "predicted", "lost", "skipped")


def rounded_length(metres: float, spread: float) -> str:
    """Return a length as text, without the digits of a metre that a `spread` leaves open."""
    if metres < 0.1 or not spread > 0:
        return length(metres)
    return f"{metres:.{min(max(round(-np.log10(spread)), 0), 2)}f} m"


def signed_length(metres: float) -> str:
    """Return a difference of lengths as text, with its sign."""
    return ("+" if metres >= 0 else "−") + length(abs(metres))


def coordinates(values: Iterable[float], digits: int) -> str:
    """Return the coordinates of a point as text."""
    return ", ".join(f"{value:.{digits}f}" for value in values).replace("-", "−")


def seconds(value: float) -> str:
    """Return a duration as text."""
    if value < 1:
        return f"{1000 * value:.0f} ms"
    return f"{value:.1f} s" if value < 120 else f"{int(value) // 60} min {int(value) % 60:02d} s"


def thinned(shown: int, total: int, noun: str) -> str:
    """Return how many of a number of things are shown; empty if that is all."""
    return "" if shown == total else f"{shown:,} of {total:,} {noun} are shown."


def more(number: int) -> str:
    """Return how many further rows a table doesn't show; empty if none."""
    return f"{number:,} more are not shown." if number > 0 else ""


def frame_range(first: int, last: int) -> str:
    """Return "frame 3" or "frames 3–17"."""
    return f"frame {first}" if first == last else f"frames {first}–{last}"


def runs(items: Iterable[tuple[int, str, str]]) -> list[tuple[int, int, int, str, str]]:
    """Merge consecutive (index, status, reason) with the same status and reason.

    Returns (first index, last index, count, status, reason). Items that follow each other count as
    consecutive even if their indices have gaps, as in a recording read with a stride.
    """
    groups = (list(group) for _, group in groupby(items, itemgetter(1, 2)))
    return [(group[0][0], group[-1][0], len(group), *group[0][1:]) for group in groups]


def findings(reasons: Sequence[Reason], total: int) -> list[dict[str, Any]]:
    """Return the reasons as findings of the report, the most severe first.

    Each has its level ("failed", "degraded" or "note"), text, frame ranges, advice, and the frames
    as text; empty if they are all frames.

    Parameters
    ----------
    reasons
        The reasons.
    total
        Number of frames: reasons that concern the majority don't list them.
    """
    listed = []
    for reason in verdicts.ranked(reasons):
        level, meaning = verdicts.REASONS[reason.code]
        is_subset = 0 < frame_ranges.size(reason.ranges) < total
        listed.append(
            {
                "level": level,
                "text": _with_frames(reason, total) if reason.text.strip() else meaning,
                "ranges": reason.ranges,
                "advice": reason.remedy,
                "where": frame_ranges.in_words(reason.ranges).replace("-", "–") * is_subset,
            }
        )
    return listed


def _with_frames(reason: Reason, total: int) -> str:
    """Add a reason's frames to its text, unless it names them or they are the majority."""
    text = sentence(reason.text)
    first, last = reason.frames
    named = {str(first), str(last)} <= set(re.findall(r"\d+", text))
    if (
        named
        or frame_ranges.in_words(reason.ranges) in text
        or 2 * frame_ranges.size(reason.ranges) > total
    ):
        return text
    return f"{text.rstrip('.')} ({frame_ranges.in_words(reason.ranges)})."


def sentence(text: str) -> str:
    """Return a text with a capital at its beginning and a full stop at its end."""
    text = text.strip()
    first = text.split(maxsplit=1)[:1]
    if first and first[0].isalpha():  # a path or a number stays as it is
        text = text[0].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) or not text else text + "."
