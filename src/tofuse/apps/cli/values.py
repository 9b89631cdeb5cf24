"""Values of options as they are written at the command line; ArgumentTypeError for others."""

import argparse
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from tofuse.engine.bounds import Bounds

_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def reader(kind: type, extra: object) -> Callable[[str], Any]:
    """Return the function that reads a value of an annotated type.

    Parameters
    ----------
    kind
        The type.
    extra
        What else is declared: the bounds of a number, a function that reads the value, or None.
    """
    if isinstance(extra, Bounds):
        return lambda text: _within(extra, _number(text, kind), text)
    if callable(extra):
        return extra
    if kind is Path:
        return path
    return (lambda text: _number(text, kind)) if kind in (int, float) else kind


def path(text: str) -> Path:
    """Read a path; an empty one, as of a shell variable that is not set, is no current folder.

    Shells leave a ~ after ``--out=`` as it is.
    """
    if not text:
        raise argparse.ArgumentTypeError("'' is not a path")
    return Path(os.path.expanduser(text))


def _number(text: str, kind: type) -> Any:
    try:
        return kind(text)
    except ValueError as error:
        what = "a whole number" if kind is int else "a number"
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}") from error


def _within(bounds: Bounds, value: Any, text: str) -> Any:
    if value not in bounds:
        raise argparse.ArgumentTypeError(f"{text!r} is not {bounds}")
    return value


def _depth(text: str) -> float:
    """Read a length of 0 or more in m, given as 30mm, 3cm, 0.03m or 0.03."""
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(mm|cm|m)?\s*", text)
    value = _number(match[1], float) * _UNITS_M[match[2] or "m"] if match else math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length, such as 30mm or 0.03")
    return value


def _length(text: str) -> float:
    """Read a positive length, of the size of errors and details: metres only if they are stated."""
    value = _depth(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length, such as 30mm or 0.03")
    if value >= 1 and text.strip()[-1] != "m":
        raise argparse.ArgumentTypeError(f"{text!r} would be metres: write {text}mm or {text}m")
    return value


def _size(text: str) -> int:
    """Read an amount of memory in bytes, given as 4GB or 2GiB."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([kmgt]?)(i?)b?", text.strip().lower())
    size = 0.0
    if match and (match[2] or not match[3]):
        size = float(match[1]) * (1024 if match[3] else 1000) ** " kmgt".index(match[2] or " ")
    if not 1 <= size < 1 << 60:
        raise argparse.ArgumentTypeError(f"{text!r} is not an amount of memory, such as 4GB")
    return int(size)


Count = Annotated[int, Bounds(1)]
Planes = Annotated[int, Bounds(1, 20)]
NonNegative = Annotated[int, Bounds(0)]
Port = Annotated[int, Bounds(1, 65535)]
Ratio = Annotated[float, Bounds(0, 1, exclusive=True)]
Seconds = Annotated[float, Bounds(0, exclusive=True)]
Metres = Annotated[float, Bounds(0)]
Depth = Annotated[float, _depth]
Length = Annotated[float, _length]
# As `tofuse.formats.recordings.FACTORS`, which would load NumPy.
Factor = Annotated[float, Bounds(1e-6, 1e6)]
Size = Annotated[int, _size]
