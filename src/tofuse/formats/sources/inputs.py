"""The files that a recording consists of, and options that do not apply to it."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from tofuse.engine.errors import InputError
from tofuse.formats.files import reading
from tofuse.formats.sources.reader import ReaderOptions

PER_FRAME = "a camera per frame"


T = TypeVar("T")


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
    if reading.is_file(path):
        return path if path.suffix.lower() in suffixes else None
    if not reading.is_folder(path):
        return None
    try:
        files = reading.files_with(path, *suffixes)
    except InputError:
        return None
    return files[0] if len(files) == 1 else None


def begins_with(file: Path | None, head: bytes) -> bool:
    """Return whether there is a file that begins with these bytes; errors as `read_head`."""
    return file is not None and reading.read_head(file, len(head)) == head


def required_file(path: Path, *suffixes: str) -> Path:
    """Return the same as `file_of`, or any file given by its path; else raise InputError."""
    file = file_of(path, *suffixes)
    if file is not None:
        return file
    if reading.is_file(path):
        return path
    raise InputError(
        f"doesn't contain exactly one {' or '.join(suffixes)} file",
        where=path,
        remedy="pass the file",
    )


def files_at(path: Path, *suffixes: str) -> list[Path]:
    """Return the file itself or the files of a folder, if they have one of the suffixes."""
    if reading.is_file(path):
        return [path] if path.suffix.lower() in suffixes else []
    return reading.files_with(path, *suffixes) if reading.is_folder(path) else []
