"""Atomic writes: a file is either complete or absent, even after a power cut.

Files in a folder that is itself moved into place later (its name begins with `UNFINISHED`) are
synced to disk with that folder, by `sync_tree`; all others when they are written.
"""

from __future__ import annotations

import errno
import itertools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from tofuse.engine.errors import output_error

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer as Buffer

UNFINISHED = ".tofuse-"  # prefix of temporary names, which a killed run leaves behind

_counter = itertools.count()


@contextmanager
def replacing(path: str | Path, *, durable: bool | None = None) -> Iterator[Path]:
    """Yield a temporary path, renamed to `path` if the block succeeds, else removed.

    It is in the same folder and keeps the suffix, by which some libraries choose the format. The
    block should only write: its OSErrors become OutputErrors about `path`.

    Parameters
    ----------
    path
        The file to create or replace.
    durable
        Whether to sync the file to disk before it is renamed; unless given, if it is not in a
        folder that is moved into place later.

    Raises
    ------
    OutputError
        If the file can't be written or renamed.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{next(_counter)}.part{path.suffix}")
    if durable is None:
        durable = not any(part.startswith(UNFINISHED) for part in path.parts)
    try:
        yield temporary
        if durable:
            sync(temporary)
        os.replace(temporary, path)
        if durable:
            sync(path.parent)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise output_error(error, path) from error
        raise


def write_bytes(path: str | Path, *parts: Buffer) -> None:
    """Write a file from parts, which saves concatenating them; see `replacing`.

    Arrays must be contiguous.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        for part in parts:
            file.write(part)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 file with line feeds on every system; see `replacing`.

    Bytes of file names that are not UTF-8 are written as escapes.
    """
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def sync(path: str | Path) -> None:
    """Wait until a file, or the entries of a folder, are on disk.

    Does nothing on file systems without support for it, and for folders where they can't be opened.

    Raises
    ------
    OSError
        If the disk reports a failure.
    """
    mode = os.O_RDWR if sys.platform == "win32" else os.O_RDONLY
    try:
        handle = os.open(path, mode | getattr(os, "O_BINARY", 0))
    except OSError:
        if Path(path).is_dir():
            return
        raise
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.ENOSYS):
            raise
    finally:
        os.close(handle)


def sync_tree(folder: str | Path) -> None:
    """Wait until all files below a folder, and their names, are on disk."""
    for directory, _folders, names in os.walk(folder):
        for name in names:
            sync(Path(directory) / name)
        sync(directory)


def make_folder(path: str | Path) -> Path:
    """Create a folder and its parents if needed, and return it.

    Raises
    ------
    OutputError
        If that isn't possible.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(error, path) from error
    return path
