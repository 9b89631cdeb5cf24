"""Stamps that show whether files have changed, without reading them."""

from __future__ import annotations

import os
from pathlib import Path

Stamp = tuple[str, int, int]


def stamp(path: Path) -> Stamp:
    """Return path, size in bytes and modification time in ns of a file, or of a dangling link."""
    try:
        status = path.stat()
    except OSError:
        status = path.lstat()
    return str(path), status.st_size, status.st_mtime_ns


def stamps_in(folder: Path, without: Path) -> list[Stamp]:
    """Return the stamps of all files below a folder, in order, except those below `without`."""
    stamps = []
    for directory, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if Path(directory) / f != without)
        stamps += [stamp(Path(directory) / name) for name in sorted(names)]
    return stamps
