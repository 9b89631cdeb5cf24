"""Locks between processes.

`locked` waits for a lock, `Claim` fails at once and names the holder. Both lock an open file by the
operating system, which releases the lock when the process ends in any way.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tofuse.errors import OutputError
from tofuse.files.atomic import output_error

_HELD_ERRORS = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK)
_MAX_NOTE_BYTES = 4096  # the holder's description of itself in the lock file
_RETRIES = 100

if sys.platform == "win32":
    import msvcrt

    def _lock_blocking(handle: int) -> None:
        while True:
            try:
                return msvcrt.locking(handle, msvcrt.LK_LOCK, 1)
            except OSError:  # after ten seconds it gives up
                continue

    def _lock_nonblocking(handle: int) -> None:
        # Beyond the note: other processes can't read a locked range.
        os.lseek(handle, 1 << 30, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _lock_nonblocking(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _lock_blocking(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX)


@contextmanager
def locked(path: str | Path) -> Iterator[int]:
    """Wait for the lock of a file, creating it if needed, and hold the lock during the block.

    Yields the file descriptor. A child process that inherits it holds the lock as well, until it
    ends (not on Windows). The file is not removed: otherwise two processes could lock two files of
    one name.

    Raises
    ------
    OutputError
        If the file can't be created or locked.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise output_error(error, path) from error
    try:
        try:
            _lock_blocking(handle)
        except OSError as error:
            raise output_error(error, path) from error
        yield handle
    finally:
        os.close(handle)


class Claim:
    """An exclusive lock that is acquired at once or not at all, until `release`.

    The lock file names its holder, and is removed in the end; one left by a dead process is taken
    over. On file systems without locks (some network drives) the note alone serves: it is valid
    while the process that it names is alive, or if that ran on another machine.
    """

    def __init__(self, path: str | Path, *, target: str | Path) -> None:
        """Take the lock.

        Parameters
        ----------
        path
            The lock file.
        target
            What is locked, for error messages.

        Raises
        ------
        OutputError
            If another process holds it, or the file can't be created.
        """
        self._path = Path(path)
        try:
            self._handle: int | None = self._acquire(target)
        except OSError as error:
            raise output_error(error, target) from error

    def release(self) -> None:
        """Release the lock; harmless if already released."""
        handle, self._handle = self._handle, None
        if handle is None:
            return
        try:
            if sys.platform == "win32":  # where open files can't be removed
                os.close(handle)
            with suppress(OSError):
                os.unlink(self._path)
        finally:
            if sys.platform != "win32":
                os.close(handle)

    def __del__(self) -> None:
        with suppress(Exception):
            self.release()

    def _acquire(self, target: str | Path) -> int:
        flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        for _ in range(_RETRIES):
            handle = os.open(self._path, os.O_RDWR | os.O_CREAT | flags, 0o666)
            try:
                status = os.fstat(handle)
                if not stat.S_ISREG(status.st_mode):
                    raise OSError(errno.EINVAL, "its lock is not a regular file")
                holder = _read_note(handle)
                try:
                    _lock_nonblocking(handle)
                except OSError as error:
                    if error.errno in _HELD_ERRORS or _alive(holder):
                        raise _refusal(target, holder) from None
                if not _is_at(status, self._path):  # removed by its holder in the meantime
                    os.close(handle)
                    continue
                _write_note(handle)
            except BaseException:
                os.close(handle)
                raise
            return handle
        raise _refusal(target, {})


def _is_at(status: os.stat_result, path: Path) -> bool:
    try:
        current = os.lstat(path)
    except OSError:
        return False
    return os.path.samestat(status, current)


def _write_note(handle: int) -> None:
    since = datetime.now(UTC).isoformat(timespec="seconds")
    note = {"pid": os.getpid(), "host": platform.node(), "since": since}
    os.ftruncate(handle, 0)
    os.lseek(handle, 0, os.SEEK_SET)
    os.write(handle, json.dumps(note).encode())


def _read_note(handle: int) -> dict[str, Any]:
    """The note of the holder of a lock; empty if it is invalid."""
    os.lseek(handle, 0, os.SEEK_SET)
    try:
        note = json.loads(os.read(handle, _MAX_NOTE_BYTES))
    except (ValueError, RecursionError):
        return {}
    return note if isinstance(note, dict) else {}


def _alive(holder: dict[str, Any]) -> bool:
    """Whether the process that a note names may be running; used on file systems without locks."""
    pid, host = holder.get("pid"), holder.get("host")
    if type(pid) is not int or pid <= 0 or not isinstance(host, str):
        return False
    if host != platform.node() or sys.platform == "win32":  # where os.kill(pid, 0) would end it
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return pid != os.getpid()


def _refusal(target: str | Path, holder: dict[str, Any]) -> OutputError:
    fields = [
        (label, str(holder[key])) for key, label in _NOTE if isinstance(holder.get(key), int | str)
    ]
    description = ", ".join(f"{label} {text[:80]}" for label, text in fields) or "unknown"
    return OutputError(
        f"is being written by another process ({description})",
        where=target,
        remedy="wait until it is done, or choose another folder",
    )


_NOTE = (("pid", "pid"), ("host", "on"), ("since", "since"))
