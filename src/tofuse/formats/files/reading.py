"""Reading external files and folders."""

from __future__ import annotations

import errno
import importlib
import json
import os
import re
import struct
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError

T = TypeVar("T")
R = TypeVar("R")

MAX_TEXT_BYTES = 256 << 20
MAX_BYTES = 4 << 30
_MAX_DOTS = 1000  # on a line of TOML
# Errors that malformed data cause in code that parses it.
_MALFORMED = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)

_REASONS = {
    errno.ENOENT: ("doesn't exist", "check the path"),
    errno.EACCES: ("may not be read (permission denied)", "change its permissions"),
    errno.EPERM: ("may not be read (permission denied)", "change its permissions"),
    errno.ELOOP: ("is a link that leads back to itself", "replace the link"),
    errno.EISDIR: ("is a folder", "pass a file"),
    errno.ENOTDIR: ("is inside something that is not a folder", "check the path"),
    errno.ENAMETOOLONG: ("has too long a name", "check the path"),
}


def input_error(error: OSError, path: str | Path) -> InputError:
    """Return the error that `path` can't be read, with reason and remedy."""
    problem, remedy = _REASONS.get(
        error.errno or 0, (f"can't be read ({error.strerror or error})", "check the file")
    )
    return InputError(problem, where=path, remedy=remedy)


@contextmanager
def readable(path: str | Path) -> Iterator[None]:
    """Turn the OSErrors of a block that reads `path` into `input_error`."""
    try:
        yield
    except OSError as error:
        raise input_error(error, path) from error


def path_of(value: object, name: str, remedy: str) -> Path:
    """Return an argument of the user as a path.

    Parameters
    ----------
    value
        The argument.
    name
        Its name.
    remedy
        What to pass instead.

    Raises
    ------
    InputError
        If it is no path.
    """
    if not isinstance(value, str | os.PathLike):
        raise InputError(
            f"is {quantities.one(type(value).__name__)}, not a path", where=name, remedy=remedy
        )
    if not str(value) or "\0" in str(value):
        raise InputError(f"is {str(value)!r}, not a path", where=name, remedy=remedy)
    return Path(value)


def required_package(name: str, extra: str | None, where: str | Path) -> Any:
    """Import a package that only some functions need.

    Parameters
    ----------
    name
        The package.
    extra
        The extra of tofuse that installs it; None if there is none.
    where
        What needs it, for the error.

    Raises
    ------
    InputError
        With the command that installs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        remedy = f"pip install {name}" if extra is None else f"pip install 'tofuse[{extra}]'"
        raise InputError(f"needs the package {name}", where=where, remedy=remedy) from error


def read_bytes(path: str | Path, *, limit: int = MAX_BYTES) -> bytes:
    """Return the content of a file of at most `limit` bytes.

    Raises
    ------
    InputError
        If it can't be read, is not a regular file, or is larger.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "not a regular file"
            raise InputError(f"is {kind}", where=path, remedy="pass a file")
        size = path.stat().st_size
        if size > limit:
            raise InputError(
                f"has {size >> 20} MiB, more than the limit of {limit >> 20} MiB",
                where=path,
                remedy="check that it is the file you meant",
            )
        return path.read_bytes()
    except OSError as error:
        raise input_error(error, path) from error
    except ValueError as error:  # a NUL in the name
        raise InputError(f"is not a path ({error})", where=repr(str(path))) from error


def read_head(path: str | Path, size: int) -> bytes:
    """Return the first `size` bytes of a file, fewer if it is shorter; errors as `read_bytes`."""
    path = Path(path)
    with readable(path):
        if path.exists() and not path.is_file():
            raise InputError("is not a regular file", where=path, remedy="pass a file")
        with path.open("rb") as file:
            return file.read(size)


@contextmanager
def damage_reported(path: str | Path, kind: str) -> Iterator[None]:
    """Turn errors of a block that parses a file written by tofuse into InputError.

    Parameters
    ----------
    path
        The file.
    kind
        Kind of file, for the message, such as "a run.json".
    """
    try:
        yield
    except _MALFORMED as error:
        raise InputError(
            f"is damaged, or not {kind} written by tofuse ({type(error).__name__}: {error})",
            where=path,
            remedy="copy the whole folder again, or create it again",
        ) from error


def parsed(
    parse: Callable[[Any], Any],
    text: str | bytes,
    *,
    where: str | Path,
    format_name: str,
    remedy: str | None = None,
) -> Any:
    """Parse external JSON or TOML.

    Parameters
    ----------
    parse
        Function from text to data, such as `json.loads`.
    text
        The text.
    where
        Its source, for errors.
    format_name, remedy
        Its format, and the remedy, for errors.

    Raises
    ------
    InputError
        If it is invalid or too deeply nested.
    """
    try:
        return parse(text)
    except (RecursionError, ValueError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else error
        raise InputError(f"is not {format_name} ({reason})", where=where, remedy=remedy) from error


def parse_toml(text: str, *, where: str | Path) -> dict[str, Any]:
    """Return the data of an external TOML text; errors as `parsed`.

    The time of tomllib for a dotted key grows with the square of the number of its parts.
    """
    if any(line.count(".") > _MAX_DOTS for line in text.split("\n")):
        raise InputError("is not TOML (nested too deeply)", where=where)
    data: dict[str, Any] = parsed(tomllib.loads, text, where=where, format_name="TOML")
    return data


def read_text(path: str | Path, *, limit: int = MAX_TEXT_BYTES) -> str:
    """Return the content of a UTF-8 file, or UTF-16 with a byte order mark, which is dropped.

    Errors as `read_bytes`.
    """
    data = read_bytes(path, limit=limit)
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not text (byte {error.start} is not UTF-8)",
            where=path,
            remedy="check that it is the file you meant, and save it as UTF-8",
        ) from error


def name_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key by name, with runs of digits compared as numbers: frame9 before frame10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(0, int(p), p) if p[:1].isdecimal() else (1, 0, p) for p in parts]


def list_folder(path: str | Path, matches: Callable[[Path], object] | None = None) -> list[Path]:
    """Return the visible entries of a folder (that match) in name order, see `name_order`.

    Raises
    ------
    InputError
        If it can't be listed.
    """
    with readable(path):
        visible = (p for p in Path(path).iterdir() if not p.name.startswith("."))
        return sorted(filter(matches, visible), key=name_order)


def files_with(path: str | Path, *suffixes: str) -> list[Path]:
    """Return the entries of a folder with one of the suffixes (any case), in name order.

    Including non-files and dangling links: each stands for an unreadable frame, without which all
    later ones would be assigned wrong times.
    """
    return list_folder(path, lambda p: p.suffix.lower() in suffixes)


def files_named(path: Path, matches: Callable[[str], object]) -> list[Path]:
    """Return the files in a folder whose name `matches`; none if it is not a folder."""
    if not is_folder(path):
        return []
    try:
        return list_folder(path, lambda p: matches(p.name) and is_file(p))
    except InputError:
        return []


def first_file(*paths: Path) -> Path | None:
    """Return the first of the paths that is an accessible file, as `if_file`; None if none is."""
    return next((file for path in paths if (file := if_file(path)) is not None), None)


def first_readable(items: Iterable[T], read: Callable[[T], R], nothing: InputError) -> R:
    """Return what `read` returns for the first item that can be read.

    Raises
    ------
    InputError
        The first error if none can be; `nothing` if there are no items.
    """
    first_error: InputError | None = None
    for item in items:
        try:
            return read(item)
        except InputError as error:
            first_error = first_error or error
    raise first_error or nothing


def if_file(path: Path) -> Path | None:
    """Return the path, or else that with its suffix in capitals, if it is an accessible file."""
    capital = path.with_suffix(path.suffix.upper())
    return next((file for file in (path, capital) if is_file(file)), None)


def is_file(path: Path) -> bool:
    """Whether `path` is an accessible file."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """Whether `path` is an accessible folder."""
    try:
        return path.is_dir()
    except OSError:
        return False


def read_part(path: Path, offset: int, size: int) -> bytes:
    """Return up to `size` bytes of a file from an offset; InputError if it can't be read."""
    with readable(path), path.open("rb") as file:
        file.seek(offset)
        return file.read(size)


@contextmanager
def named(where: str | Path, remedy: str | None = None) -> Iterator[None]:
    """Name `where` in the InputErrors of a block that checks values of a file."""
    try:
        yield
    except InputError as error:
        raise InputError(error.problem, where=where, remedy=remedy or error.remedy) from error


@contextmanager
def prefixed(where: str | Path) -> Iterator[None]:
    """Put the file before the place, such as a field, in InputErrors of a block."""
    try:
        yield
    except InputError as error:
        where = f"{where}: {error.where}"
        raise InputError(error.problem, where=where, remedy=error.remedy) from error


@contextmanager
def about(where: str | Path, remedy: str | None = None) -> Iterator[None]:
    """Complete the InputErrors of a block that state no place, or no remedy."""
    try:
        yield
    except InputError as error:
        if error.where and (error.remedy or not remedy):
            raise
        where, remedy = error.where or where, error.remedy or remedy
        raise InputError(error.problem, where=where, remedy=remedy) from error


@contextmanager
def library_errors(where: str | Path, remedy: str = "copy the file again") -> Iterator[None]:
    """Turn any exception of a library that reads a damaged file into an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        line = " ".join(str(error).split())[:200]
        raise InputError(
            f"can't be read ({type(error).__name__}: {line})", where=where, remedy=remedy
        ) from error


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
    if data is None:
        raise InputError("is missing", where=where, remedy=remedy)
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
