"""Locks between processes, which the operating system releases when a process ends in any way.

`locked` waits for a lock, `Claim` fails at once and names the holder.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from tofuse.engine.errors import OutputError, output_error

# The holder describes itself behind the first byte, which others can't read on Windows.
_NOTE_OFFSET, _MAX_NOTE_BYTES = 1, 200


@contextmanager
def locked(path: str | Path) -> Iterator[int]:
    """Wait for the lock of a file, creating it if needed, and hold the lock during the block.

    Yields the file descriptor. If this process is killed, a child process that inherited it holds
    the lock until it ends (not on Windows).

    Raises
    ------
    OutputError
        If the file can't be created or locked.
    """
    from filelock import FileLock

    handles: list[int] = []
    lock = FileLock(path, on_acquired=handles.append, preserve_lock_file=True)
    try:
        lock.acquire()
    except OSError as error:
        raise output_error(error, path) from error
    try:
        yield handles[0]
    finally:
        lock.release()


class Claim:
    """An exclusive lock that is acquired at once or not at all, until `release`.

    The lock file names its holder, and is removed in the end.
    """

    def __init__(self, path: Path, *, target: str | Path) -> None:
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
        from filelock import FileLock, Timeout

        self._path = path
        self._lock = FileLock(path, blocking=False, thread_local=False)
        try:
            path.open("ab").close()  # filelock takes any failure for a lock of another process
            self._lock.acquire()
        except Timeout:
            raise OutputError(
                f"is being written by another process ({_note(path)})",
                where=target,
                remedy="wait until it is done, or choose another folder",
            ) from None
        except OSError as error:
            raise output_error(error, path.parent) from error
        since = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            path.write_text(f"\npid {os.getpid()}, on {platform.node()}, since {since}")
        except BaseException as error:
            self.release()
            if isinstance(error, OSError):
                raise output_error(error, path.parent) from error
            raise

    def release(self) -> None:
        """Release the lock; harmless if already released."""
        if not self._lock.is_locked:
            return
        try:
            with suppress(OSError):  # on Windows open files can't be removed; filelock does it
                self._path.unlink()
        finally:
            self._lock.release()


def _note(path: Path) -> str:
    """What the holder of a lock says about itself."""
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(_NOTE_OFFSET)
            text = file.read(_MAX_NOTE_BYTES).decode("utf-8", "replace")
    except OSError:
        text = ""
    return " ".join(text.split()) or "unknown"
