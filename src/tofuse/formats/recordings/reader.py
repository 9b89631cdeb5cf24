"""The interface of a reader, and the files that a recording consists of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol, TypeVar

from tofuse.engine.errors import InputError
from tofuse.engine.frames import Source
from tofuse.formats.files import files_with, is_file, is_folder, read_head

CERTAIN = 0.9
UNCERTAIN = 0.5
PER_FRAME = "a camera per frame"

T = TypeVar("T")


@dataclass(frozen=True)
class Sniff:
    """A reader's guess whether a path has its format.

    Attributes
    ----------
    confidence
        0 to 1; a path is opened automatically from `CERTAIN` on. 1 is for names and contents that
        no other format has.
    evidence
        The evidence for the format, for messages.
    remedy
        What to do if the confidence is below `CERTAIN`.
    """

    confidence: float
    evidence: str
    remedy: str = ""


@dataclass(frozen=True)
class ReaderOptions:
    """Options of the user for opening a recording.

    Attributes
    ----------
    camera
        A camera.json that replaces the recording's own.
    topic
        Of a bag, instead of the detected one.
    """

    camera: Path | None = None
    topic: str | None = None


@dataclass(frozen=True)
class Reader(Protocol):
    """A reader of one format, registered by ``@part("reader", name)`` in a module of `readers`.

    Attributes
    ----------
    joinable
        Whether a folder of such recordings is joined to one recording, in name order.
    """

    part_kind: ClassVar[str] = "reader"
    joinable: ClassVar[bool] = False

    def sniff(self, path: Path) -> Sniff | None:
        """Detect the format from names and first bytes; None if it is another one.

        An InputError, if something can't be read, is taken for None.
        """
        ...

    def open(self, path: Path, options: ReaderOptions) -> Source:
        """Open a file or folder.

        Raises
        ------
        InputError
            If the recording as a whole is unusable.
        """
        ...


def required(files: list[T], name: str, where: Path, remedy: str = "check the path") -> list[T]:
    """Return the files; raise InputError, that `where` has no `name`, if there are none."""
    if not files:
        raise InputError(f"has no {name}", where=where, remedy=remedy)
    return files


def refuse_camera(options: ReaderOptions, name: str, stores: str = "points") -> None:
    """Raise InputError if a camera was passed for the format `name`, which stores `stores`."""
    if options.camera is not None:
        raise InputError(
            f"does not apply to the format {name!r}, which stores {stores}",
            where="--camera",
            remedy="leave it out",
        )


def file_of(path: Path, *suffixes: str) -> Path | None:
    """Return the file at `path`, or the only one with these suffixes in that folder; else None."""
    if is_file(path):
        return path if path.suffix.lower() in suffixes else None
    if not is_folder(path):
        return None
    try:
        files = files_with(path, *suffixes)
    except InputError:
        return None
    return files[0] if len(files) == 1 else None


def begins_with(file: Path | None, head: bytes) -> bool:
    """Return whether there is a file that begins with these bytes; errors as `read_head`."""
    return file is not None and read_head(file, len(head)) == head


def required_file(path: Path, *suffixes: str) -> Path:
    """Return the same as `file_of`, or any file given by its path; else raise InputError."""
    file = file_of(path, *suffixes)
    if file is not None:
        return file
    if is_file(path):
        return path
    raise InputError(
        f"doesn't contain exactly one {' or '.join(suffixes)} file",
        where=path,
        remedy="pass the file",
    )


def files_at(path: Path, *suffixes: str) -> list[Path]:
    """Return the file itself or the files of a folder, if they have one of the suffixes."""
    if is_file(path):
        return [path] if path.suffix.lower() in suffixes else []
    return files_with(path, *suffixes) if is_folder(path) else []
