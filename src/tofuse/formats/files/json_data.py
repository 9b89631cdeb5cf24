"""JSON objects with checked fields."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.formats.files.reading import parsed, read_text


def read_json(path: str | Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises
    ------
    InputError
        If the file can't be read, is invalid (with line and column), or is not an object.
    """
    return parse_json(read_text(path, limit=64 << 20), path)


def parse_json(
    text: str | bytes, where: str | Path, remedy: str = "correct it there"
) -> dict[str, Any]:
    """Parse a JSON object; for the parameters and errors see `reading.parsed`."""
    data = parsed(json.loads, text, where=where, format_name="JSON", remedy=remedy)
    if not isinstance(data, dict):
        raise InputError("is not a JSON object", where=where, remedy=remedy)
    return data


def number_in(
    data: Mapping[str, Any],
    name: str,
    where: str | Path,
    default: float | None = None,
    remedy: str = "use a number",
) -> float:
    """Return a number of JSON data.

    Parameters
    ----------
    data
        The object.
    name
        Its field.
    where
        The file, for errors.
    default
        The value if it is missing; required unless given.
    remedy
        The remedy.

    Raises
    ------
    InputError
        If it is missing and has no default, is not a number, or does not fit into a float.
    """
    value = data.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        problem = "is missing" if value is None else f"is {value!r:.60}"
        raise InputError(problem, where=f"{where}: {name}", remedy=remedy)
    try:
        return float(value)
    except OverflowError as error:
        raise InputError("is too large", where=f"{where}: {name}", remedy=remedy) from error


def check_schema(data: Mapping[str, Any], version: int) -> None:
    """Raise InputError unless JSON data has this `schema`."""
    schema = data.get("schema")
    if schema != version or isinstance(schema, bool):
        problem = f"schema is {schema!r}" if "schema" in data else "schema is missing"
        raise InputError(problem, remedy=f"write {version}, the only version")


def rows_in(
    data: Mapping[str, Any], name: str, where: str | Path, default: object = None
) -> list[dict[str, Any]]:
    """Return a list of objects in JSON data; InputError if it is anything else."""
    rows = data.get(name, default)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError("is not a list of objects", where=f"{where}: {name}")
    return rows


def matrix_of(data: object, where: str | Path, remedy: str | None = None) -> Float64:
    """Return the (4, 4) matrix in JSON data; InputError naming `where` if it is anything else."""
    try:
        matrix = np.array(data, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("is not a 4x4 list of numbers", where=where, remedy=remedy) from error
    if matrix.shape != (4, 4):
        raise InputError(f"has shape {matrix.shape}, not (4, 4)", where=where, remedy=remedy)
    return matrix


def numbers_in(
    data: Mapping[str, Any],
    name: str,
    where: str | Path,
    shape: tuple[int, ...],
    remedy: str,
    *,
    finite: bool = True,
) -> Float64:
    """Return an array of numbers of JSON data.

    Parameters
    ----------
    data
        The object.
    name
        Its field, which contains lists of numbers, nested or not.
    where
        The file, for errors.
    shape
        Of the array; -1 in it stands for any length.
    remedy
        The remedy.
    finite
        Whether all numbers have to be finite.

    Raises
    ------
    InputError
        If it is missing, has another count of numbers, or contains anything else.
    """
    place = f"{where}: {name}"
    if data.get(name) is None:
        raise InputError("is missing", where=place, remedy=remedy)
    try:
        values = np.array(data[name], float).reshape(shape)
        valid = not finite or np.isfinite(values).all()
    except (TypeError, ValueError, OverflowError):
        valid = False
    if not valid:
        counts = " x ".join("N" if count < 0 else str(count) for count in shape)
        noun = "finite numbers" if finite else "numbers"
        raise InputError(f"is not {counts} {noun}", where=place, remedy=remedy)
    return values
