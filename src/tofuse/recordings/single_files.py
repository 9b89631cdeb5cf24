"""Recordings that are one file, given by its path or by its folder."""

from __future__ import annotations

from pathlib import Path

from tofuse.errors import InputError
from tofuse.files.reading import files_with, is_file, is_folder, read_head


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
