"""Standard output and error that may be closed, full, or not UTF-8.

Printed text is not the result: a command continues when its output can't be written, and reports
that at the end.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


class SafeStream:
    """A text stream that never raises: output that can't be written is dropped.

    Attributes
    ----------
    error
        Reason for dropped output; None as long as nothing was dropped.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self.error: Exception | None = OSError("it is closed") if stream is None else None
        target: Any = io.StringIO() if stream is None else stream
        self._stream = target
        with suppress(AttributeError, ValueError, OSError):
            # File names may not be representable in the terminal's encoding.
            self._stream.reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        """Write text, or drop it."""
        if self.error is None:
            try:
                self._stream.write(text)
            except (OSError, ValueError) as error:
                self._fail(error)
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write lines."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the stream."""
        if self.error is None:
            try:
                self._stream.flush()
            except (OSError, ValueError) as error:
                self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Drop everything from now on, including what is buffered when the process ends."""
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
def safe_streams() -> Iterator[tuple[SafeStream, SafeStream]]:
    """Replace standard output and error in the block, and yield both replacements."""
    previous = sys.stdout, sys.stderr
    out, err = SafeStream(sys.stdout), SafeStream(sys.stderr)
    sys.stdout, sys.stderr = cast(TextIO, out), cast(TextIO, err)
    try:
        yield out, err
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = previous
