"""The file of loops given by the user."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from tofuse.engine.errors import InputError
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.loops import PriorLoop
from tofuse.formats.files import reading

_UNIT = 1e-2  # tolerance of a quaternion's length, for files with few digits


def read_loops(path: str | Path, frames: Collection[int] | None = None) -> list[PriorLoop]:
    """Read lines of ``i j`` or ``i j tx ty tz qx qy qz qw`` (frame indices; the measured T_i_j, m).

    ``#`` starts a comment. `frames` are the existing indices, if they are to be checked.

    Raises
    ------
    InputError
        If the file can't be read, and, with the line's number, for any other content, a frame that
        doesn't exist, a loop from a frame to itself, a duplicate pair.
    """
    loops: dict[tuple[int, int], PriorLoop] = {}
    for number, line in enumerate(reading.read_text(path).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        with reading.about(f"{path}, line {number}"):
            loop = _loop(words)
            for index in (loop.i, loop.j):
                if frames is not None and index not in frames:
                    raise InputError(f"there is no frame {index}", remedy="use indices of frames")
            if (loop.i, loop.j) in loops:
                raise InputError(f"the loop {loop.i} {loop.j} is given twice")
        loops[loop.i, loop.j] = loop
    return list(loops.values())


def _loop(words: list[str]) -> PriorLoop:
    form = "write 'i j' or 'i j tx ty tz qx qy qz qw'"
    if len(words) not in (2, 9):
        raise InputError(f"has {len(words)} values", remedy=form)
    try:
        i, j = (int(word) for word in words[:2])
        values = np.array([float(word) for word in words[2:]])
    except ValueError as error:
        raise InputError(f"is not understood ({error})", remedy=form) from error
    if i < 0 or j < 0 or i == j:
        raise InputError(f"joins frames {i} and {j}", remedy="use two frames")
    if len(values) == 0:
        return PriorLoop(min(i, j), max(i, j))
    if not np.isfinite(values).all() or abs(quaternion.length(values[3:]) - 1) > _UNIT:
        raise InputError(
            "is not a rigid motion",
            remedy="use finite numbers and a quaternion qx qy qz qw of length 1",
        )
    T = quaternion.to_pose(values[3:], values[:3])
    return PriorLoop(i, j, T) if i < j else PriorLoop(j, i, se3.inverse(T))
