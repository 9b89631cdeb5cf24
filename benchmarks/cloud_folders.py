"""Folders of bare clouds through `tofuse run`: views registered, errors, wrong poses flagged.

Each case is a folder of PLY files without poses, camera or time. `scoring.py` defines wrong and
marked poses; here, as in `cloud_kinds.py`, a pose is wrong beyond 0.1 m or 4 degrees, one of the
dragon beyond 4 mm. Scans are those of `cloud_kinds.py`, with more points.

    python benchmarks/cloud_folders.py [--data ../shared/data] [--cases kitchen scans]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import cloud_kinds
import pairs
import scoring
import tofuse
from sequences import DATA
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.formats.geometry.ply import write_ply

# Pose (4, 4) in a common frame and points (n, 3) of each view.
Views = Iterator[tuple[Float64, Float32]]


def every(name: str, step: int) -> Callable[[Path], Views]:
    """Every `step`-th view of a scene of `pairs.py`."""

    def views(data: Path) -> Views:
        recording = pairs.opened(name, data)
        assert recording.reference is not None
        for k in range(0, len(recording), step):
            yield recording.reference[k], recording[k].points

    return views


def spheres(name: str, count: int, points: int, seed: int) -> Callable[[Path], Views]:
    """Spherical scans along a path through a simulated scene, with random heading."""
    return lambda _data: cloud_kinds.scanned(name, count, points, seed)


def dragon(data: Path) -> Views:
    """Scans of an object of 0.2 m that turns once."""
    for T, points in cloud_kinds.dragon_scans(data):
        yield T, points.astype(np.float32)


CASES: dict[str, tuple[str, Callable[[Path], Views]]] = {
    "kitchen": ("7-Scenes kitchen, every 20th frame", every("kitchen", 10)),
    "flat": ("Tour of four rooms, every 12th frame", every("flat", 1)),
    "room": ("Turn in a furnished room, every 24th frame (22 degrees)", every("room", 3)),
    "scans": (
        "Six scans of 1.4 million points through four rooms",
        spheres("flat", 6, 1_400_000, 0),
    ),
    "scans-2": ("The same in another flat", spheres("flat", 6, 1_400_000, 3)),
    "dragon": ("Stanford dragon, 15 scans, one turn", dragon),
}
RIGHT_M = {"dragon": 0.004}


def row(title: str, views: Views, right_m: float) -> str:
    """Reconstruct one folder; return its row of the table."""
    poses = []
    with tempfile.TemporaryDirectory() as folder:
        for k, (T, points) in enumerate(views):
            write_ply(Path(folder) / f"{k:04d}.ply", GeometryRecord(points))
            poses.append(T)
        start = time.perf_counter()
        result = tofuse.reconstruct(tofuse.open(folder))
        seconds = time.perf_counter() - start
    allowed = scoring.Tolerance(right_m, float(np.radians(cloud_kinds.RIGHT_DEG)))
    truth = scoring.Truth(np.stack(poses), np.zeros(len(poses), np.intp), allowed)
    score = scoring.score(scoring.parts_of(result, range(len(poses))), truth)
    diagnostics = result.diagnostics
    cells = [
        title,
        f"{score.main} of {score.frames}",
        f"{1000 * score.ate_m:.{0 if score.ate_m >= 0.01 else 1}f}",
        score.wrong,
        score.unmarked,
        sum(loop.accepted for loop in diagnostics.loops),
        diagnostics.verdict,
        f"{seconds:.0f}",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--cases", nargs="*", choices=list(CASES), default=list(CASES))
    given = parser.parse_args()
    print(
        "| Folder | in the main component | ATE rms, mm | wrong "
        "| wrong and not marked uncertain | loops | verdict | s |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    for name in given.cases:
        title, made = CASES[name]
        try:
            right_m = RIGHT_M.get(name, cloud_kinds.RIGHT_M)
            print(row(title, made(given.data), right_m), flush=True)
        except FileNotFoundError:
            print(f"| {title}: no data |")


if __name__ == "__main__":
    main()
