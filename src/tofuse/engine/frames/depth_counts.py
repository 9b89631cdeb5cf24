"""Depth stored as counts of 16 bits, or as other numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3

INVALID_DEPTH = 65535
MAX_COUNTS = 65535


def depth_from_counts(counts: NDArray[np.generic], unit_m: float) -> Float32:
    """Return depth in m (float32) of stored counts (H, W); 0 and 65535 give 0."""
    depth = counts.astype(np.float32) * np.float32(unit_m)
    depth[counts == INVALID_DEPTH] = 0
    return depth


def depth_from_numbers(numbers: NDArray[np.generic], unit_m: float) -> Float32:
    """Return depth in m (float32) of stored integers or floats (H, W) in units of `unit_m`.

    Depth that is not finite or implausibly large is 0, and so are integers that mark no depth.

    Raises
    ------
    InputError
        If all depth is negative.
    """
    with np.errstate(all="ignore"):
        depth = numbers.astype(np.float32) * np.float32(unit_m)
        depth[~(np.abs(depth) < se3.MAX_COORDINATE_M)] = 0
    depth[is_marked_invalid(numbers)] = 0
    check_sign(numbers)
    return depth


def check_sign(numbers: NDArray[Any], where: str | None = None) -> None:
    """Raise InputError for negative depth (H, W), as of programs where z points backwards.

    Integers, and a single negative value, may mark pixels without a measurement.
    """
    if numbers.dtype.kind != "f" or (numbers > 0).any():
        return
    negative = numbers[numbers < 0]
    if len(negative) and negative.min() < negative.max():
        problem, remedy = "holds negative depth only", "negate it, as z points forward"
        raise InputError(problem, where=where, remedy=remedy)


def is_marked_invalid(numbers: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether stored depth is an integer for no depth: 65535, or the largest of its type."""
    if numbers.dtype.kind not in "ui":
        return np.zeros(numbers.shape, bool)
    return (numbers == INVALID_DEPTH) | (numbers == np.iinfo(numbers.dtype).max)
