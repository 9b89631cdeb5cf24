"""What benchmarks make once and keep."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def made_once(folder: Path, make: Callable[[Path], object]) -> Path:
    """Return a folder, which `make` writes if it doesn't exist yet: all of it or nothing."""
    if not folder.is_dir():
        unfinished = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.parent.mkdir(parents=True, exist_ok=True)
        make(unfinished)
        unfinished.rename(folder)
    return folder


def computed_once(file: Path | None, make: Callable[[], T]) -> T:
    """Return what `make` returns, which is kept in a file if one is given."""
    if file is not None and file.exists():
        kept: T = pickle.loads(file.read_bytes())
        return kept
    made = make()
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(made))
    return made
