"""Reading files and folders that come from outside."""

from __future__ import annotations

import errno
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tofuse.errors import InputError

MAX_TEXT_BYTES = 256 << 20
MAX_BYTES = 4 << 30

_REASONS = {
    errno.ENOENT: ("doesn't exist", "check the path"),
    errno.EACCES: ("may not be read (permission denied)", "change its permissions"),
    errno.EPERM: ("may not be read (permission denied)", "change its permissions"),
    errno.ELOOP: ("is a link that leads back to itself", "replace the link"),
    errno.EISDIR: ("is a folder", "give a file"),
    errno.ENOTDIR: ("lies inside something that is no folder", "check the path"),
    errno.ENAMETOOLONG: ("has too long a name", "check the path"),
}


def input_error(error: OSError, path: str | Path) -> InputError:
    """Say in one line why `path` can't be read, and what to do."""
    problem, remedy = _REASONS.get(
        error.errno or 0, (f"can't be read ({error.strerror or error})", "check the file")
    )
    return InputError(problem, where=path, remedy=remedy)


def read_bytes(path: str | Path, *, limit: int = MAX_BYTES) -> bytes:
    """Return the content of a file of at most `limit` bytes.

    Raises
    ------
    InputError
        If it can't be read, is no ordinary file, or is larger.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "no ordinary file"
            raise InputError(f"is {kind}", where=path, remedy="give a file")
        size = path.stat().st_size
        if size > limit:
            raise InputError(
                f"has {size >> 20} MiB, more than the {limit >> 20} MiB that are read",
                where=path,
                remedy="check that it is the file you meant",
            )
        return path.read_bytes()
    except OSError as error:
        raise input_error(error, path) from error
    except ValueError as error:  # a NUL in the name
        raise InputError(f"is no path ({error})", where=repr(str(path))) from error


def read_head(path: str | Path, size: int) -> bytes:
    """Return the first `size` bytes of a file, fewer if it is shorter; errors as `read_bytes`."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise InputError("is no ordinary file", where=path, remedy="give a file")
        with path.open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise input_error(error, path) from error


def parsed(parse: Callable[[str], Any], text: str, *, where: str | Path, what: str) -> Any:
    """Return what a parser of JSON or TOML makes of a text from outside.

    Raises
    ------
    InputError
        If it is broken, or nested more deeply than any that means something.
    """
    try:
        return parse(text)
    except RecursionError as error:
        raise InputError(f"is not {what} (nested too deeply)", where=where) from error
    except ValueError as error:
        raise InputError(f"is not {what} ({error})", where=where) from error


def read_text(path: str | Path, *, limit: int = MAX_TEXT_BYTES) -> str:
    """Return the content of a UTF-8 file (a byte order mark is dropped); errors as `read_bytes`."""
    try:
        return read_bytes(path, limit=limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not text (byte {error.start} is not UTF-8)",
            where=path,
            remedy="check that it is the file you meant",
        ) from error


def name_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key by name, with runs of digits compared as numbers: frame9 before frame10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(0, int(p), p) if p[:1].isdecimal() else (1, 0, p) for p in parts]


def list_folder(path: str | Path) -> list[Path]:
    """Return what lies in a folder, hidden things left out, in name order.

    Raises
    ------
    InputError
        If it can't be listed.
    """
    try:
        return sorted(
            (p for p in Path(path).iterdir() if not p.name.startswith(".")), key=name_order
        )
    except OSError as error:
        raise input_error(error, path) from error


def files_with(path: str | Path, *suffixes: str) -> list[Path]:
    """Return what a folder holds with one of the suffixes (any case), in name order.

    Also what is no file, or a link that leads nowhere: it stands for a frame, which can't be read,
    and left out it would move all others in time. What has another suffix is none.
    """
    return [p for p in list_folder(path) if p.suffix.lower() in suffixes]


def files_named(path: Path, named: Callable[[str], object]) -> list[Path]:
    """Return files of a folder whose name is `named`, in name order; none if it is no folder."""
    if not is_folder(path):
        return []
    try:
        return [p for p in list_folder(path) if named(p.name) and is_file(p)]
    except InputError:
        return []


def if_file(path: Path) -> Path | None:
    """Return the path if it is that of a file that can be looked at."""
    return path if is_file(path) else None


def is_file(path: Path) -> bool:
    """Whether `path` is a file that can be looked at."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """Whether `path` is a folder that can be looked at."""
    try:
        return path.is_dir()
    except OSError:
        return False
