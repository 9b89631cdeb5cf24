"""The `run.json` of a result in memory."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tofuse.apps.results.run_json import read_run_json, write_run_json
from tofuse.engine.results.types import Reconstruction


def run_json(result: Reconstruction) -> dict[str, Any]:
    """Return the content of the file that is written for a result."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.json"
        write_run_json(path, result)
        return read_run_json(path)
