"""One process at a time, by a lock on a file that goes away with the process that holds it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tofuse.files.atomic import output_error

if sys.platform == "win32":
    import msvcrt

    def _take(handle: int) -> None:
        while True:
            try:
                return msvcrt.locking(handle, msvcrt.LK_LOCK, 1)
            except OSError:  # after ten seconds it gives up
                continue

else:
    import fcntl

    def _take(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX)


@contextmanager
def locked(path: str | Path) -> Iterator[int]:
    """Wait for the lock of a file, which is made where it is missing, and hold it in the block.

    Gives the open file's descriptor. A child process that inherits it holds the lock as well, until
    it ends (not on Windows). The file stays: removing it would let two hold locks of one name.

    Raises
    ------
    OutputError
        If the file can't be made or locked.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise output_error(error, path) from error
    try:
        try:
            _take(handle)
        except OSError as error:
            raise output_error(error, path) from error
        yield handle
    finally:
        os.close(handle)
