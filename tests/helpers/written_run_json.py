"""The `run.json` of a result in memory, and of results that tests make or change by hand."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tofuse._version import __version__
from tofuse.apps.results import integrity
from tofuse.apps.results.run_json import read_run_json, write_run_json
from tofuse.engine.results.types import Reconstruction


def run_json(result: Reconstruction) -> dict[str, Any]:
    """Return the content of the file that is written for a result."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.json"
        write_run_json(path, result)
        return read_run_json(path)


_FIELDS: dict[str, Any] = {
    "schema": 1, "version": __version__, "verdict": "good", "seed": 0,
    "accuracy": {"position_m": None, "rotation_rad": None, "relative": None},
    "reasons": [], "frames": [], "components": [],
    "T_up_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
}  # fmt: skip
_FRAME = {"status": "tracked", "component": None, "covariance": None}


def write_run(folder: Path, **fields: Any) -> None:
    """Write a `run.json` with these fields, after all other files; frames may lack some."""
    run = _FIELDS | fields
    if isinstance(run["frames"], list):
        run["frames"] = [_FRAME | frame for frame in run["frames"]]
    _write(folder, run)


def change_run(folder: Path, **changes: Any) -> None:
    """Change fields of a `run.json` as if it had been written so; None deletes one."""
    run = read_run_json(folder / "run.json") | changes
    del run["sha256"]
    _write(folder, {name: value for name, value in run.items() if value is not None})


def read_from(folder: Path, recording: Path, **changes: Any) -> None:
    """Change where the recording of a result is."""
    given = read_run_json(folder / "run.json")["input"]
    given["opening"]["paths"] = [str(recording)]
    change_run(folder, input=given, **changes)


def _write(folder: Path, run: dict[str, Any]) -> None:
    path = folder / "run.json"
    path.unlink(missing_ok=True)
    path.write_text(json.dumps(run, indent=1).removesuffix("}").rstrip())
    integrity.seal(path)
