"""`tofuse compare` and `tofuse repeat` with files: read, compare, write."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.compare.comparing import Comparison, compare
from tofuse.apps.compare.page import colors, limit_of, write_compare_report
from tofuse.apps.compare.repeating import Repetition, loaded_sessions, repeated
from tofuse.apps.results import folders, run_json
from tofuse.engine.compute import threads
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.progress import Progress
from tofuse.formats.files import atomic
from tofuse.formats.geometry import write_ply
from tofuse.formats.poses import read_pose

COMPARED, REPEATED = "compare.json", "repeat.json"
COMPARE_CONTRACT = folders.Contract.of_files(
    COMPARED, "deviations.csv", "deviations.ply", "report.html", keys=("regions", "tolerance_m")
)
REPEAT_CONTRACT = folders.Contract.of_files(REPEATED, "repeat.csv", keys=("components", "bounds"))
_STATUS = {None: 0, "pass": 0, "fail": 3, "undecided": 4}


@dataclass(frozen=True)
class CompareOptions(folders.OutputOptions):
    """The options of ``tofuse compare``; see its ``--help``."""

    tolerance: float | None = None
    guess: Path | None = None
    accuracy: float | None = None
    unit: Literal["mm", "cm", "m", "in"] | None = None
    threads: int | None = None


@dataclass(frozen=True)
class RepeatOptions(folders.OutputOptions):
    """The options of ``tofuse repeat``; see its ``--help``."""

    threads: int | None = None


def compare_files(
    result: str, reference: str, options: CompareOptions, progress: Progress
) -> Comparison:
    """Compare two files or folders, and write the result; see `compare` for errors.

    Raises
    ------
    OutputError
        If the result can't be written; existing files are then unchanged.
    """
    with threads(options.threads), threadpool_limits(1), options.folder(COMPARE_CONTRACT) as folder:
        progress.stage("comparing")
        comparison = compare(
            result,
            reference,
            tolerance_m=options.tolerance,
            guess=None if options.guess is None else read_pose(options.guess),
            accuracy_m=options.accuracy,
            unit=options.unit,
        )
        if folder is not None:
            progress.stage("writing")
            with folder.staging() as staging:
                write_comparison(comparison, staging)
    return comparison


def compare_exit_status(comparison: Comparison) -> int:
    """Return 0 if all that was seen passes, or without a tolerance; 3 if not; 4 if undecided."""
    undecided = comparison.verdict is None and comparison.reason
    return _STATUS["undecided" if undecided else comparison.verdict]


def write_comparison(comparison: Comparison, folder: Path) -> None:
    """Write the files of a comparison."""
    found = comparison.deviations
    atomic.write_text(folder / "deviations.csv", _table(comparison.worst))
    faces = comparison.measured.faces
    whole = faces is not None and len(found.points) == len(comparison.measured.points)
    kept = np.ones(len(found.points), bool) if whole else np.isfinite(found.deviation)
    write_ply(
        folder / "deviations.ply",
        GeometryRecord(
            found.points[kept],
            faces if whole else None,
            normals=found.normals[kept].astype(np.float32),
            color=colors(found.deviation[kept], limit_of(comparison)),
            scalars={
                "deviation": found.deviation[kept].astype(np.float32),
                "sigma": found.sigma[kept].astype(np.float32),
            },
        ),
    )
    write_compare_report(comparison, folder / "report.html")
    run_json.write_object(folder / COMPARED, comparison.to_dict())


def repeat_files(results: Sequence[Path], options: RepeatOptions, progress: Progress) -> Repetition:
    """Compare results of the same place, and write what was found; see `repeated` for errors."""
    with threads(options.threads), threadpool_limits(1), options.folder(REPEAT_CONTRACT) as folder:
        progress.stage("reading", len(results))
        sessions = loaded_sessions(results, progress)
        progress.stage("comparing")
        repetition = repeated(sessions)
        if folder is not None:
            with folder.staging() as staging:
                rows = [vars(component) for component in repetition.components]
                atomic.write_text(staging / "repeat.csv", _table(rows))
                run_json.write_object(staging / REPEATED, repetition.to_dict())
    return repetition


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()
