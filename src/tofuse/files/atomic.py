"""Writing a file so that it is either whole or not there, also after a power cut.

What is written into a folder that is itself moved into place later (its name begins with
`UNFINISHED`) reaches the disk with that folder, by `sync_tree`; everything else by itself.
"""

from __future__ import annotations

import errno
import itertools
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from tofuse.errors import OutputError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer as Buffer

UNFINISHED = ".tofuse-"  # how names begin that are no result: a run that was killed left them

_counter = itertools.count()

_REMEDIES = {
    errno.ENOSPC: "free some space, or choose another folder",
    errno.EDQUOT: "free some space, or choose another folder",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.EROFS: "choose a folder that you may write to",
    errno.ENOENT: "create its folder first",
    errno.ENOTDIR: "choose a path whose parents are folders",
    errno.EISDIR: "choose the path of a file",
}


def output_error(error: OSError, path: str | Path) -> OutputError:
    """Say in one line why `path` can't be written, and what to do."""
    reason = (error.strerror or str(error)).lower()
    remedy = _REMEDIES.get(error.errno or 0, "choose another place for it")
    return OutputError(f"can't be written ({reason})", where=path, remedy=remedy)


@contextmanager
def replacing(path: str | Path, *, durable: bool | None = None) -> Iterator[Path]:
    """Give a temporary path beside `path`, renamed to it if the block succeeds, else removed.

    The temporary name keeps the suffix, as some libraries choose the format by it. The block
    should only write: its OSErrors are taken for trouble with the output.

    Parameters
    ----------
    durable
        Whether to wait until it is on the disk, before the name is; unless given, where it is not
        in a folder that is moved into place later.

    Raises
    ------
    OutputError
        If the file can't be written or renamed.
    """
    path = Path(path)
    beside = path.with_name(f".{path.stem}.{os.getpid()}-{next(_counter)}.part{path.suffix}")
    if durable is None:
        durable = not any(part.startswith(UNFINISHED) for part in path.parts)
    try:
        yield beside
        if durable:
            sync(beside)
        os.replace(beside, path)
        if durable:
            sync(path.parent)
    except BaseException as error:
        with suppress(OSError):
            beside.unlink()
        if isinstance(error, OSError):
            raise output_error(error, path) from error
        raise


def write_bytes(path: str | Path, *parts: Buffer) -> None:
    """Write a whole file of parts, one after the other, which saves joining them; see `replacing`.

    Arrays must be contiguous.
    """
    with replacing(path) as beside, beside.open("wb") as file:
        for part in parts:
            file.write(part)


def write_text(path: str | Path, text: str) -> None:
    """Write a whole UTF-8 file with line feeds on every system; see `replacing`.

    Bytes of names of files that are no UTF-8 are written as escapes.
    """
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def sync(path: str | Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk.

    File systems that know no such thing, and systems that can't open folders, are let be.

    Raises
    ------
    OSError
        If the disk says that it failed.
    """
    writable = os.O_RDWR if sys.platform == "win32" else os.O_RDONLY
    try:
        handle = os.open(path, writable | getattr(os, "O_BINARY", 0))
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
    """Wait until all files in a folder and below it, and their names, are on the disk."""
    for here, _folders, names in os.walk(folder):
        for name in names:
            sync(Path(here) / name)
        sync(here)


def make_folder(path: str | Path) -> Path:
    """Create a folder and its parents, where they are missing, and return it.

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


@contextmanager
def new_folder(path: str | Path) -> Iterator[Path]:
    """Give an empty folder beside `path`, renamed to it if the block succeeds, else removed.

    The block should only write: its OSErrors are taken for trouble with the output.

    Raises
    ------
    OutputError
        If `path` is there and is not an empty folder, or can't be written.
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise OutputError("isn't empty", where=path, remedy="choose a new folder")
    parent = make_folder(path.absolute().parent)
    try:
        # The folder made by `tempfile` is private; the one inside has the usual permissions.
        with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=parent) as private:
            beside = make_folder(Path(private) / "made")
            yield beside
            sync_tree(beside)
            if path.exists():
                path.rmdir()
            os.replace(beside, path)
            sync(parent)
    except OSError as error:
        raise output_error(error, path) from error
