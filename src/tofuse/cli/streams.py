"""Standard output and error of a command, whatever they lead to: closed, full, gone, or not UTF-8.

What is printed is not the result. A command goes on when nobody reads it any more, and says in the
end that something could not be told.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


class Outlet:
    """A text stream that never fails: what can't be written is dropped, and `error` says why."""

    def __init__(self, stream: TextIO | None) -> None:
        self.error: Exception | None = OSError("it is closed") if stream is None else None
        kept: Any = stream if stream is not None else io.StringIO()
        self._stream = kept
        with suppress(AttributeError, ValueError, OSError):
            # Names of files need not be in the terminal's encoding, nor in any.
            self._stream.reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        """Write, or drop it."""
        if self.error is None:
            try:
                self._stream.write(text)
            except (OSError, ValueError) as error:
                self._fail(error)
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write them one after the other."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Hand on what was written."""
        if self.error is None:
            try:
                self._stream.flush()
            except (OSError, ValueError) as error:
                self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Write nothing more. What still waits must not fail again when the process ends."""
        self.error = error
        with suppress(AttributeError, OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            try:
                os.dup2(null, self._stream.fileno())
            finally:
                os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def outlets() -> Iterator[tuple[Outlet, Outlet]]:
    """Let all that the block prints go through outlets, and give them."""
    before = sys.stdout, sys.stderr
    out, err = Outlet(sys.stdout), Outlet(sys.stderr)
    sys.stdout, sys.stderr = cast(TextIO, out), cast(TextIO, err)
    try:
        yield out, err
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before
