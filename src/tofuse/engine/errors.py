"""Errors with a place, a problem and a remedy, on one line."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_MAX_LENGTH = 600  # maximum characters of a problem: text quoted from a file may have any length


# Temporary folders, and what messages name in their place: the archive that was unpacked there.
SHOWN_AS: dict[str, str] = {}


# Messages name options as on the command line, which are arguments in Python; not in paths. A
# value is the name of a file.
_OPTION = re.compile(r"(?<![\w/\\.-])--([a-z][a-z-]*)\b(?: (?=\w+\.json\b))?")
_on_command_line = False


@contextmanager
def on_command_line() -> Iterator[None]:
    """Let messages name options as they are typed, instead of arguments in Python."""
    global _on_command_line
    before, _on_command_line = _on_command_line, True
    try:
        yield
    finally:
        _on_command_line = before


def shown(text: str) -> str:
    """Return a message for the user, without temporary folders, and with options as named there.

    >>> shown("use --min-depth, or --camera camera.json")
    'use min_depth, or camera=camera.json'
    """
    text = _without_temporary(text)
    return text if _on_command_line else _OPTION.sub(_argument, text)


def _without_temporary(text: str) -> str:
    # The last first, which may be in an earlier one; another thread may add one.
    for folder, path in reversed(list(SHOWN_AS.items())):
        text = text.replace(folder, path)
    return text


def _argument(option: re.Match[str]) -> str:
    return option[1].replace("-", "_") + ("=" if option[0].endswith(" ") else "")


def _clipped(text: str) -> str:
    return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]} ..."


class TofuseError(Exception):
    """Base class of the package's errors: where the problem is, what it is, and a remedy."""

    def __init__(
        self, problem: str, *, where: str | Path | None = None, remedy: str | None = None
    ) -> None:
        self.problem = _clipped(shown(problem))
        place = "" if where is None else str(where)
        # A path may look as if it had an option in it.
        self.where = (shown if place.startswith("--") else _without_temporary)(place) or None
        self.remedy = None if remedy is None else shown(remedy)
        parts = [f"{_clipped(self.where)}: " if self.where else "", self.problem]
        parts += [f"; {_clipped(self.remedy)}"] if self.remedy else []
        super().__init__(" ".join("".join(parts).split()))


class Ended(BaseException):
    """The process is to end because of a signal with this `number`."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(number)


@contextmanager
def signals_as_themselves() -> Iterator[None]:
    """Raise a signal that arrived in compiled code as itself, not as the cause of a SystemError."""
    try:
        yield
    except SystemError as error:
        cause: BaseException | None = error
        while isinstance(cause, SystemError):
            cause = cause.__cause__ or cause.__context__
        if isinstance(cause, KeyboardInterrupt | Ended):
            for note in getattr(error, "__notes__", ()):
                cause.add_note(note)
            raise cause from None
        raise


class InputError(TofuseError):
    """A recording, file, option or array from outside can't be used."""


class UnreadableFrameError(InputError):
    """One frame of a recording can't be read; the others may be fine."""


class OutputError(TofuseError):
    """A result can't be written to the requested location."""


class RegistrationError(TofuseError):
    """Two views can't be registered (no points, no overlap)."""


class InputWarning(UserWarning):
    """A file is read, but not exactly as it is; or what is given may not be as it should."""


class KernelCacheWarning(RuntimeWarning):
    """Compiled kernels can't be kept, so that each run takes half a minute longer."""


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
    """Return the error that `path` can't be written, with reason and remedy."""
    reason = (error.strerror or str(error)).lower()
    remedy = _REMEDIES.get(error.errno or 0, "choose another place for it")
    return OutputError(f"can't be written ({reason})", where=path, remedy=remedy)
