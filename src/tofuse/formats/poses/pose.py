"""A rigid motion in a file: a 4x4 matrix, JSON with one, or a line as in a TUM trajectory."""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import quaternion, se3
from tofuse.engine.loops import PriorLoop
from tofuse.formats.files import reading, tables

FIELD = "T_target_source"
_REMEDY = (
    "write 16 numbers (4 rows of a rigid motion, in metres), "
    f"JSON with {FIELD}, or 'tx ty tz qx qy qz qw'"
)
_MAX_BYTES = 16 << 20


def read_pose(path: str | Path) -> Float64:
    """Read a (4, 4) T_target_source, with the precision of the file.

    The file contains 16 numbers, row by row; or `tx ty tz qx qy qz qw`, possibly after a timestamp;
    or JSON: a 4x4 list, or an object with one as its `T_target_source`. In text # starts a comment.

    Raises
    ------
    InputError
        Naming file and field, if it can't be read or is not a rigid motion.
    """
    text = reading.read_text(path, limit=_MAX_BYTES)
    with reading.about(path, _REMEDY):
        if text.lstrip()[:1] in ("{", "["):
            matrix, where = _from_json(text, path)
        else:
            matrix, where = _from_numbers(text, path), str(path)
        with reading.named(where, _REMEDY):
            return se3.check_pose(matrix, where=where)


def pose_text(T: ArrayLike) -> str:
    """Return the four rows of a (4, 4) matrix, as `read_pose` and `numpy.loadtxt` read them."""
    rows = np.asarray(T, float).tolist()
    return "".join(" ".join(tables.exact(value) for value in row) + "\n" for row in rows)


def _from_json(text: str, path: str | Path) -> tuple[Float64, str]:
    data = reading.parsed(json.loads, text, where=path, format_name="JSON", remedy=_REMEDY)
    where = f"{path}: {FIELD}" if isinstance(data, dict) else str(path)
    if isinstance(data, dict) and FIELD not in data:
        raise InputError("is missing", where=where)
    return reading.matrix_of(data[FIELD] if isinstance(data, dict) else data, where), where


def _from_numbers(text: str, path: str | Path) -> Float64:
    lines = [line.split("#", 1)[0].replace(",", " ") for line in text.splitlines()]
    numbers: list[float] = []
    for number, line in enumerate(lines, 1):
        for cell in line.split():
            try:
                numbers.append(float(cell))
            except ValueError as error:
                where = f"{path}, line {number}"
                raise InputError(f"{cell[:40]!r} is not a number", where=where) from error
            if not math.isfinite(numbers[-1]):
                raise InputError(f"contains {cell}", where=f"{path}, line {number}")
    if len(numbers) == 16:
        return np.array(numbers).reshape(4, 4)
    if len(numbers) not in (7, 8):
        raise InputError(f"contains {quantities.count(len(numbers), 'number')}")
    row = np.array(numbers[-7:])
    norm = float(quaternion.length(row[3:]))
    if abs(norm - 1) > 0.1:
        raise InputError(f"its quaternion has length {norm:.3g}, not 1")
    return quaternion.to_pose(row[3:], row[:3])


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
        raise InputError(f"has {quantities.count(len(words), 'value')}", remedy=form)
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
