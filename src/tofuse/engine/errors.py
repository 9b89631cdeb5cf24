"""Errors with a place, a problem and a remedy, on one line."""

from __future__ import annotations

import errno
from pathlib import Path

_MAX_LENGTH = 600  # maximum characters of a problem: text quoted from a file may have any length


# Temporary folders, and what messages name in their place: the archive that was unpacked there.
SHOWN_AS: dict[str, str] = {}


def shown(text: str) -> str:
    """Return a message for the user, without the names of temporary folders."""
    for folder, path in list(SHOWN_AS.items()):  # another thread may add one
        text = text.replace(folder, path)
    return text


def _clipped(text: str) -> str:
    return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]} ..."


class TofuseError(Exception):
    """Base class of the package's errors: where the problem is, what it is, and a remedy."""

    def __init__(
        self, problem: str, *, where: str | Path | None = None, remedy: str | None = None
    ) -> None:
        self.problem = _clipped(shown(problem))
        self.where = None if where is None else shown(str(where))
        self.remedy = None if remedy is None else shown(remedy)
        parts = [f"{_clipped(self.where)}: " if self.where else "", self.problem]
        parts += [f"; {_clipped(self.remedy)}"] if self.remedy else []
        super().__init__(" ".join("".join(parts).split()))


class Ended(BaseException):
    """The process is to end because of a signal with this `number`."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(number)


class InputError(TofuseError):
    """A recording, file, option or array from outside can't be used."""


class UnreadableFrameError(InputError):
    """One frame of a recording can't be read; the others may be fine."""


class OutputError(TofuseError):
    """A result can't be written to the requested location."""


class RegistrationError(TofuseError):
    """Two views can't be registered (no points, no overlap)."""


class InputWarning(UserWarning):
    """A file is read, but not exactly as it is."""


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
