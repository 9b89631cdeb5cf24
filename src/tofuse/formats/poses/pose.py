"""A rigid motion in a file: a 4x4 matrix, JSON with one, or a line as in a TUM trajectory."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import quaternion, se3
from tofuse.formats.files import json_data, reading, tables

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
    return json_data.matrix_of(data[FIELD] if isinstance(data, dict) else data, where), where


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
        raise InputError(f"contains {len(numbers)} numbers")
    row = np.array(numbers[-7:])
    norm = float(quaternion.length(row[3:]))
    if abs(norm - 1) > 0.1:
        raise InputError(f"its quaternion has length {norm:.3g}, not 1")
    return quaternion.to_pose(row[3:], row[:3])
