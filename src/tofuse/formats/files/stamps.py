"""Stamps that show whether files have changed, without reading them."""

from __future__ import annotations

import os
from pathlib import Path

# Files that readers use in the folder of a single file, whatever its name.
_SIDECARS = ("camera.json", "rays.npy", "correction.npz")

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


def stamps_of(path: Path, without: Path) -> list[Stamp]:
    """Return the stamps of an input: all files in a folder, or a file and those that belong to it.

    Files below `without` are ignored; there are none if the path doesn't exist.
    """
    if os.path.isdir(path):
        return stamps_in(path, without)
    if not os.path.isfile(path):
        return []
    stem = path.name.split(".")[0]
    siblings = sorted(p for p in path.parent.iterdir() if p.name.split(".")[0] == stem)
    siblings += [path.parent / name for name in _SIDECARS]
    return [stamp(p) for p in siblings if p.is_file()]
