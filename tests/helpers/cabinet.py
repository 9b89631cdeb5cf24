"""Finished recordings and results that many tests read, made once for each state of the sources.

They are kept in pytest's cache; tests that change one copy it first.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

from paths import ROOT

Make = Callable[[Path], object]


@cache
def state_of_sources() -> str:
    """A hash of the package and of the helpers of tests."""
    found = hashlib.sha256()
    for folder in (ROOT / "src" / "tofuse", ROOT / "tests" / "helpers"):
        for path in sorted(folder.rglob("*.py")):
            found.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return found.hexdigest()[:16]


class Cabinet:
    """A folder of made folders, of which those of other states of the sources are removed."""

    def __init__(self, root: Path) -> None:
        self.folder = root / state_of_sources()
        for old in root.iterdir() if root.is_dir() else ():
            if old != self.folder:
                shutil.rmtree(old, ignore_errors=True)
        self.folder.mkdir(parents=True, exist_ok=True)

    def get(self, name: str, make: Make) -> Path:
        """Return the folder of a name; `make` writes it if it does not exist.

        Results name the folders of their recordings, which are siblings: each is made in place
        under a name of this process, and becomes visible by its link when it is complete.
        """
        link = self.folder / name
        if not link.exists():
            made = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self.folder)) / name
            make(made)
            try:
                os.symlink(made, link)
            except FileExistsError:  # another process was faster
                shutil.rmtree(made.parent)
        return link.resolve()
