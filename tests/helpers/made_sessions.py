"""Results of runs on small recordings of one room, or of another one with the same plan."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from made_rooms import BOXES, Box, at, seen
from tofuse.apps.results.folders import OutputFolder
from tofuse.apps.results.output import write_result
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.graph.external_sensors import OdometryEdges
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.search.search_grid import SearchOptions
from tofuse.formats.poses.trajectory import write_tum
from tofuse.formats.recordings.open import Opening
from written import record

QUICK = SearchOptions("full", full_candidates=15, photometric_candidates=5)
# Two walks that see the same corner of the room from opposite sides.
HERE = [at(0.2 * np.sin(0.2 * k), 0.2 * np.cos(0.2 * k), 0.06 * k) for k in range(12)]
THERE = [
    at(0.1 + 0.25 * np.sin(0.2 * k), -0.1 + 0.2 * np.cos(0.2 * k), 1.5 - 0.06 * k)
    for k in range(12)
]


def quick(config: Config | None = None) -> Config:
    """Coarse and quick: only the poses matter."""
    config = from_method("default") if config is None else config
    return replace(
        config,
        corrections=(),
        model_filters=(),
        fusion=Fusion(voxel_m=0.05),
        loops=replace(config.loops, searches=0, similar_pairs=0),
        search=QUICK,
        self_calibration=False,
    )


def with_moved(which: int, by: Sequence[float]) -> tuple[Box, ...]:
    """The room's boxes, of which one has been moved, m."""
    centre, half, turn = BOXES[which]
    there = (centre[0] + by[0], centre[1] + by[1], centre[2] + by[2])
    return (*BOXES[:which], (there, half, turn), *BOXES[which + 1 :])


def made_result(folder: Path, path: Sequence[Float64], number: int, **scene: object) -> Path:
    """Record a walk beside `folder`, and write the result of a run, without a report, into it.

    `number` selects the noise, different from that of other walks.
    """
    return made_result_of(folder, [seen(T, 100 * number + k, **scene) for k, T in enumerate(path)])


def recorded(folder: Path, frames: Iterable[RangeFrame]) -> Path:
    """Record these frames, ten per second."""
    timed = (replace(frame, index=k, timestamp=k / 10) for k, frame in enumerate(frames))
    options = {"depth_unit_m": 0.0005, "amplitude_kind": "range_compensated"}
    return record(folder, timed, frame_rate_hz=10.0, **options)


def made_result_of(
    folder: Path, frames: Sequence[RangeFrame], odometry: Float64 | None = None
) -> Path:
    """Record these frames beside `folder`, and write the result of a run into it.

    Optionally with recorded odometry (N, 4, 4), which the path then rests on.
    """
    recording = recorded(folder.with_name(f"{folder.name}-recording"), frames)
    config = quick()
    if odometry is not None:
        write_tum(recording / "odometry.txt", np.arange(len(frames)) / 10, odometry)
        config = replace(config, priors=(*config.priors, OdometryEdges()))
    opening = Opening((recording,))
    result = reconstruct(opening.open(), config, threads=2)
    about = {**result.recording, "opening": opening.to_dict()}
    write_result(replace(result, recording=about), OutputFolder(folder))
    return folder
