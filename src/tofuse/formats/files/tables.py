"""Tables of numbers in text files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.formats.files.atomic import write_text
from tofuse.formats.files.reading import read_text

# As separators, commas are not mixed with others: "1,5 2,5" and "1,5;2,5" are two numbers each.
_DECIMAL_COMMA = re.compile(r"\b([0-9]+,[0-9]+)[ \t;]+[-+]?[0-9]+,[0-9]")

# NaN and infinity as C libraries of Windows print them, in older ones rounded like digits: 1.#QNAN
# with 3 decimals is 1.#QO. Infinite measurements are missing, too.
_NOT_FINITE = re.compile(
    r"(?<![\w.])[-+]?(?:nan\((?:ind|snan)\)|1\.(?:\$|#(?:[QS]NAN|IN[DF]|[QS]NB|[IQS]O|[JRT])0*))(?!\w)",
    re.IGNORECASE,
)
# Without these, which are found much faster, there is none.
_MARKS = "1.#", "1.$", "n(", "N("


def plain_nan(text: str) -> str:
    """Return numbers as text with the non-finite ones of programs on Windows written as nan.

    >>> plain_nan("-nan(ind) 1.#QNAN00 -1.#IO 1.5")
    'nan nan nan 1.5'
    """
    return _NOT_FINITE.sub("nan", text) if any(mark in text for mark in _MARKS) else text


def parse_numbers(text: str, path: str | Path, *, skip: int = 0) -> Float64:
    """Parse rows of numbers, (N, C).

    Separators are blanks, commas and semicolons; '#' and '//' (of CloudCompare) start a comment.
    For missing values see `plain_nan`.

    Parameters
    ----------
    text
        The text; empty lines are skipped.
    path
        Names the file in errors.
    skip
        Number of leading lines to skip.

    Raises
    ------
    InputError
        If a cell is not a number, decimals are written with commas, or rows have different lengths.
    """
    text = plain_nan(text)
    if "," in text and (decimal := _DECIMAL_COMMA.search(text)):
        raise InputError(
            f"writes numbers with commas ({decimal.group(1)})",
            where=path,
            remedy="write them with points, such as 1.5",
        )
    text = text.replace(",", " ").replace(";", " ")
    if "\0" in text:
        raise InputError("is not text", where=path, remedy="check the file")
    lines = text.splitlines()[skip:]
    for mark in ("#", "//"):
        if mark in text:
            lines = [line.split(mark, 1)[0] for line in lines]
    lines = [line for line in lines if line.strip()]
    if not lines:
        return np.zeros((0, 0))
    try:
        return np.loadtxt(lines, ndmin=2)
    except (ValueError, OverflowError) as error:
        reason = str(error).split("; use", 1)[0].removesuffix(".")
        raise InputError(
            f"is not a table of numbers ({reason})", where=path, remedy="check the file"
        ) from error


def read_numbers(path: str | Path) -> Float64:
    """Read a file of rows of numbers, (N, C); see `parse_numbers`."""
    return parse_numbers(read_text(path), path)


def read_3x3(path: str | Path, remedy: str) -> Float64:
    """Read a file with a 3x3 matrix, one row a line.

    Raises
    ------
    InputError
        If it holds anything else; with the `remedy`.
    """
    K = read_numbers(path)
    if K.shape != (3, 3):
        raise InputError("is not a 3x3 matrix", where=path, remedy=remedy)
    return K


def read_columns(path: str | Path) -> dict[str, Float64]:
    """Read a CSV file with a header line: (N,) numbers by column name.

    Empty cells are NaN.

    Raises
    ------
    InputError
        If there is no header, a name is repeated, or a row has another length.
    """
    text = plain_nan(read_text(path))
    rows = [line.split(",") for line in text.splitlines() if line.strip()]
    if not rows:
        raise InputError("is empty", where=path, remedy="write a line of column names first")
    names = [name.strip().lstrip("#").strip() for name in rows[0]]
    if len(set(names)) != len(names) or "" in names:
        raise InputError(
            f"has the column names {names}", where=path, remedy="name each column once"
        )
    values = np.empty((len(rows) - 1, len(names)))
    for k, row in enumerate(rows[1:]):
        if len(row) != len(names):
            raise InputError(
                f"has {quantities.count(len(row), 'cell')} in row {k + 1} "
                f"and {len(names)} column names",
                where=path,
                remedy="add a cell for each column to each row",
            )
        try:
            values[k] = [float(cell) if cell.strip() else np.nan for cell in row]
        except ValueError as error:
            raise InputError(f"row {k + 1}: {error}", where=path, remedy="use numbers") from error
    return {name: values[:, k] for k, name in enumerate(names)}


def write_columns(path: str | Path, columns: Mapping[str, NDArray[np.generic]]) -> None:
    """Write (N,) columns as `read_columns` reads them, every number in full precision."""
    names = list(columns)
    arrays = [np.asarray(columns[name], float) for name in names]
    if len({a.shape for a in arrays}) > 1 or any(a.ndim != 1 for a in arrays):
        raise InputError("columns have different lengths", where=path)
    lines = [",".join(names)]
    lines += [",".join(exact(v) for v in row) for row in zip(*arrays, strict=True)]
    write_text(path, "\n".join(lines) + "\n")


def exact(value: float) -> str:
    """Shortest text that reads back as the same float64; -0.0 is written 0.0."""
    return repr(float(value) + 0.0)
