"""One process at a time, by a lock on a file that goes away with the process that holds it.

`locked` waits for its turn, `Claim` refuses at once and says who is there. Both are locks of the
system on an open file: a process that ended, however it ended, holds none.
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

_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK)
_LONGEST_NOTE = 4096  # bytes that who holds a lock says of itself
_RETRIES = 100

if sys.platform == "win32":
    import msvcrt

    def _take(handle: int) -> None:
        while True:
            try:
                return msvcrt.locking(handle, msvcrt.LK_LOCK, 1)
            except OSError:  # after ten seconds it gives up
                continue

    def _try(handle: int) -> None:
        # The note lies before it: what is locked can't be read by others.
        os.lseek(handle, 1 << 30, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _try(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)

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


class Claim:
    """The lock of something that one process at a time may change, until `release`.

    The file names its holder. It is removed in the end; one that a dead process left is taken over.
    Where a file system has no locks (some network drives), the note alone must do: it counts while
    the process that it names is alive, or on another machine, which can't be asked.
    """

    def __init__(self, path: str | Path, *, what: str | Path) -> None:
        """Take the lock.

        Parameters
        ----------
        path
            The file of the lock.
        what
            What is locked, for the message.

        Raises
        ------
        OutputError
            If another process holds it, or the file can't be made.
        """
        self._path = Path(path)
        try:
            self._handle: int | None = self._taken(what)
        except OSError as error:
            raise output_error(error, what) from error

    def release(self) -> None:
        """Give it back; nothing where that is done."""
        handle, self._handle = self._handle, None
        if handle is None:
            return
        try:
            if sys.platform == "win32":  # there, what is open can't be removed
                os.close(handle)
            with suppress(OSError):
                os.unlink(self._path)
        finally:
            if sys.platform != "win32":
                os.close(handle)

    def __del__(self) -> None:
        with suppress(Exception):
            self.release()

    def _taken(self, what: str | Path) -> int:
        safe = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        for _ in range(_RETRIES):
            handle = os.open(self._path, os.O_RDWR | os.O_CREAT | safe, 0o666)
            try:
                status = os.fstat(handle)
                if not stat.S_ISREG(status.st_mode):
                    raise OSError(errno.EINVAL, "its lock is no ordinary file")
                held = _read_note(handle)
                try:
                    _try(handle)
                except OSError as error:
                    if error.errno in _TAKEN or _alive(held):
                        raise _refusal(what, held) from None
                if not _is_at(status, self._path):  # its holder removed it just now
                    os.close(handle)
                    continue
                _write_note(handle)
            except BaseException:
                os.close(handle)
                raise
            return handle
        raise _refusal(what, {})


def _is_at(status: os.stat_result, path: Path) -> bool:
    try:
        now = os.lstat(path)
    except OSError:
        return False
    return os.path.samestat(status, now)


def _write_note(handle: int) -> None:
    since = datetime.now(UTC).isoformat(timespec="seconds")
    note = {"pid": os.getpid(), "host": platform.node(), "since": since}
    os.ftruncate(handle, 0)
    os.lseek(handle, 0, os.SEEK_SET)
    os.write(handle, json.dumps(note).encode())


def _read_note(handle: int) -> dict[str, Any]:
    """What the holder of a lock says of itself; nothing where it says nothing sensible."""
    os.lseek(handle, 0, os.SEEK_SET)
    try:
        note = json.loads(os.read(handle, _LONGEST_NOTE))
    except (ValueError, RecursionError):
        return {}
    return note if isinstance(note, dict) else {}


def _alive(held: dict[str, Any]) -> bool:
    """Whether the process that a note names may be at work; asked where there are no locks."""
    pid, host = held.get("pid"), held.get("host")
    if type(pid) is not int or pid <= 0 or not isinstance(host, str):
        return False
    if host != platform.node() or sys.platform == "win32":  # where asking would end it
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return pid != os.getpid()


def _refusal(what: str | Path, held: dict[str, Any]) -> OutputError:
    known = [(word, str(held[key])) for key, word in _WHO if isinstance(held.get(key), int | str)]
    who = ", ".join(f"{word} {text[:80]}" for word, text in known) or "one that does not say more"
    return OutputError(
        f"is being written by another process ({who})",
        where=what,
        remedy="wait until it is done, or give another folder",
    )


_WHO = (("pid", "pid"), ("host", "on"), ("since", "since"))
