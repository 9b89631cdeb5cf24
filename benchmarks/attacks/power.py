"""A simulated power cut after the n-th system call that changes a folder.

From then on every such call raises, so that the program can't clean up. Half of the data written to
files and not synced is lost. Changes of names are assumed to reach the disk in order, as with a
journalling file system.
"""

from __future__ import annotations

import builtins
import io
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

_CHANGING = ("replace", "rename", "mkdir", "rmdir", "unlink", "remove", "link", "symlink")


class PowerCut(BaseException):
    """The power is off."""


class Power:
    """Counts the system calls in `calls`, and cuts the power after some number of them."""

    def __init__(self, cut_after: int | None = None) -> None:
        self.calls = 0
        self.off = False
        self._cut_after = cut_after
        self._dirty: set[tuple[int, int]] = set()
        self._lock = threading.Lock()

    def _spend(self) -> None:
        with self._lock:
            if self.off or self.calls == self._cut_after:
                self.off = True
                raise PowerCut
            self.calls += 1

    def _counted(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            self._spend()
            return function(*args, **options)

        return call

    def _opened(self, function: Callable[..., Any], writes: Callable[..., bool]) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            if not writes(*args, **options):
                return function(*args, **options)
            self._spend()
            file = function(*args, **options)
            status = os.fstat(file if isinstance(file, int) else file.fileno())
            self._dirty.add((status.st_dev, status.st_ino))
            return file

        return call

    def _fsync(self, function: Callable[[int], None]) -> Callable[[int], None]:
        def call(handle: int) -> None:
            self._spend()
            function(handle)
            status = os.fstat(handle)
            self._dirty.discard((status.st_dev, status.st_ino))

        return call

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Intercept the system calls of a `with` block."""
        with ExitStack() as stack:

            def put(where: Any, name: str, what: Any) -> None:
                stack.enter_context(mock.patch.object(where, name, what))

            opened = io.open
            for name in _CHANGING:
                put(os, name, self._counted(getattr(os, name)))
            put(os, "fsync", self._fsync(os.fsync))
            put(os, "open", self._opened(os.open, _flags_write))
            put(io, "open", self._opened(opened, _mode_writes))
            put(builtins, "open", io.open)
            yield

    def lose(self, folder: Path) -> None:
        """Truncate the files that were written and not synced to half their size."""
        for path in folder.rglob("*"):
            status = path.lstat()
            if path.is_file() and (status.st_dev, status.st_ino) in self._dirty:
                os.truncate(path, status.st_size // 2)


def _flags_write(_path: object, flags: int = 0, *_rest: object, **_options: object) -> bool:
    return bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def _mode_writes(_file: object, mode: str = "r", *_rest: object, **_options: object) -> bool:
    return any(letter in mode for letter in "wax+")


def cut_everywhere(
    prepare: Callable[[], Path],
    job: Callable[[Path], object],
    check: Callable[[Path, int], None],
    every: int = 1,
) -> int:
    """Do a job once for each of its calls with a cut after it; return the number of calls.

    Parameters
    ----------
    prepare
        Creates a folder in its initial state.
    job
        The job.
    check
        Checks the folder, given the number of calls before the cut.
    every
        Steps between cuts.
    """
    whole = Power()
    with whole.connected():
        job(prepare())
    for calls in range(0, whole.calls + 1, every):
        folder, power = prepare(), Power(calls)
        with power.connected(), suppress(PowerCut):
            job(folder)
        if power.off:
            power.lose(folder.parent)
        check(folder, calls)
    return whole.calls
