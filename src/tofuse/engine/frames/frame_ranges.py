"""Ranges of frame indices, both ends included: creation, union, and text."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import pairwise

import numpy as np

from tofuse.engine.quantities import count

Range = tuple[int, int]

# Maximum number of ranges in a line of text; `run.json` has them all.
_LISTED = 6


def runs(frames: Sequence[int], marked: Sequence[bool]) -> tuple[Range, ...]:
    """Return (first, last) index of each uninterrupted run of marked frames.

    Frames that follow each other in the list count as consecutive, whatever their indices: a
    recording read with a stride has gaps in them.

    Parameters
    ----------
    frames
        Ascending frame indices.
    marked
        One for each of them.
    """
    padded = np.array([False, *marked, False], bool)
    edges = np.flatnonzero([a != b for a, b in pairwise(padded)])
    return tuple(
        (int(frames[a]), int(frames[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)
    )


def runs_of(frames: Sequence[int], selected: Collection[int]) -> tuple[Range, ...]:
    """Return the runs (see `runs`) of those `frames` whose index is in `selected`."""
    selected_set = set(selected)
    return runs(frames, [k in selected_set for k in frames])


def union(ranges: Iterable[Range]) -> tuple[Range, ...]:
    """Return ranges in ascending order, with overlapping and adjacent ones merged."""
    out: list[Range] = []
    for first, last in sorted(ranges):
        if out and first <= out[-1][1] + 1:
            out[-1] = (out[-1][0], max(out[-1][1], last))
        else:
            out.append((first, last))
    return tuple(out)


def size(ranges: Iterable[Range]) -> int:
    """Return the number of indices in ranges that do not overlap."""
    return sum(last - first + 1 for first, last in ranges)


def numbers(ranges: Sequence[Range]) -> str:
    """Return "3-9, 20, 31-34"; of many ranges the first ones and the number of the others."""
    listed = [str(a) if a == b else f"{a}-{b}" for a, b in ranges[:_LISTED]]
    more = len(ranges) - len(listed)
    if more:
        return f"{', '.join(listed)} and {count(more, 'more range')}"
    return ", ".join(listed)


def in_words(ranges: Sequence[Range]) -> str:
    """Return "frame 20" or "frames 3-9, 20, 31-34"."""
    return f"{'frame' if is_single(ranges) else 'frames'} {numbers(ranges)}"


def is_single(ranges: Sequence[Range]) -> bool:
    """Whether the ranges are a single frame, for the verb that follows."""
    return len(ranges) == 1 and ranges[0][0] == ranges[0][1]
