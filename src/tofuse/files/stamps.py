"""What tells whether files are still the same, without reading them."""

from __future__ import annotations

import os
from pathlib import Path

Stamp = tuple[str, int, int]


def stamp(path: Path) -> Stamp:
    """Path, size in bytes and time of change in ns of a file; of a link to nowhere, its own."""
    try:
        status = path.stat()
    except OSError:
        status = path.lstat()
    return str(path), status.st_size, status.st_mtime_ns


def stamps_in(folder: Path, without: Path) -> list[Stamp]:
    """Stamps of all files in a folder and below it, in order; `without` is a folder left out."""
    found = []
    for here, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if Path(here) / f != without)
        found += [stamp(Path(here) / name) for name in sorted(names)]
    return found
