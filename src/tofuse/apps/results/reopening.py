"""The recordings of a result, opened again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.results.folders import RECORDING
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording
from tofuse.formats.recordings import Opening

# Frames whose times differ by more are not of the same recording, s.
_MAX_TIME_DIFFERENCE = 1e-6


@dataclass(frozen=True, eq=False)
class StoredRecording:
    """A recording as a result refers to it; only merged results have more than one.

    Attributes
    ----------
    name
        A name for display.
    opening
        How it was opened.
    config
        The configuration that corrects and filters its frames, as plain data.
    first
        Offset of its frame indices in the result.
    times
        s, by the index of the frame in the recording; None in merged results, which shift them.
    frames
        Indices in the recording of the frames that the result contains.
    """

    name: str
    opening: Opening
    config: dict[str, Any]
    first: int
    times: dict[int, float] | None
    frames: list[int]


def stored_recordings(folder: Path, run: Mapping[str, Any]) -> Iterator[StoredRecording]:
    """Yield the recordings of a result.

    Parameters
    ----------
    folder
        The result.
    run
        Its `run.json`.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError, IndexError
        If `run.json` is damaged.
    InputError
        If it does not state how a recording was opened.
    """
    times = {int(f["index"]): float(f["timestamp"]) for f in run["frames"]}
    if not times:
        raise ValueError("no frames")
    sessions = run.get("sessions") or []
    single = {
        "name": folder.resolve().name,
        "opening": run["input"]["opening"] or _opening_of_path(run["input"]),
        "config": run["config"],
        "first": 0,
        "count": max(times) + 1,
    }
    for part in sessions or [single]:
        first, count = int(part["first"]), int(part["count"])
        part_times = {k - first: t for k, t in times.items() if first <= k < first + count}
        yield StoredRecording(
            str(part["name"]),
            Opening.from_dict(part["opening"], folder / "run.json"),
            dict(part["config"]),
            first,
            None if sessions else part_times,
            list(part_times),
        )


def _opening_of_path(recording: Mapping[str, Any]) -> dict[str, Any]:
    """Return how to open the recording of a result written from Python: only its path is stored."""
    return Opening((Path(recording["path"]),)).to_dict()


def locate_recording(opening: Opening, folder: Path) -> Opening:
    """Return the location of a recording: the stored path, or next to its result (demo)."""
    next_to_result = folder / RECORDING
    if all(path.exists() for path in opening.paths) or not next_to_result.is_dir():
        return opening
    if [path.name for path in opening.paths] == [RECORDING]:
        return replace(opening, paths=(next_to_result,))
    return opening


def reopen(part: StoredRecording, folder: Path) -> Recording:
    """Open the recording of a result again, with the frames that the result contains.

    Parameters
    ----------
    part
        The recording.
    folder
        The result.

    Raises
    ------
    InputError
        If it is missing, can't be opened, or has changed.
    """
    opening = locate_recording(part.opening, folder)
    for path in (*opening.paths, *((opening.camera,) if opening.camera else ())):
        if not path.exists():
            raise InputError(
                f"needs {path}, which doesn't exist",
                where=folder,
                remedy="put it back, or run `tofuse run` again",
            )
    recording = opening.open()
    is_part = np.isin(recording.indices, part.frames)
    matches = int(is_part.sum()) == len(part.frames)
    recording = replace(recording, indices=recording.indices[is_part])
    if matches and part.times is not None:
        times = np.array([part.times[k] for k in recording.indices.tolist()])
        matches = bool(np.allclose(times, recording.timestamps, rtol=0, atol=_MAX_TIME_DIFFERENCE))
    if not matches:
        raise InputError(
            f"does not match the frames of {recording.path}, which has changed",
            where=folder,
            remedy="run `tofuse run` again",
        )
    return recording
