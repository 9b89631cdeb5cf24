"""The recordings of a result, opened again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.results import run_json
from tofuse.apps.results.folders import RECORDING
from tofuse.engine.errors import InputError
from tofuse.engine.frames import DerivedSource, Frame, Recording, Source
from tofuse.engine.mapping import Config, changed, from_method
from tofuse.formats.recordings import Opening

# Frames whose times differ by more are not of the same recording, s.
_MAX_TIME_DIFFERENCE = 1e-6
# Relative difference of mean depths of the same image, by rounding on another machine.
_SAME_DEPTH = 1e-4


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
    depths
        Mean depth of the frames as they were read, m, by index, where known.
    frames
        Indices in the recording of the frames that the result contains.
    """

    name: str
    opening: Opening
    config: dict[str, Any]
    first: int
    times: dict[int, float] | None
    depths: dict[int, float]
    frames: list[int]


def check_different(folders: Sequence[Path]) -> None:
    """Raise InputError if frames are in two results, whose errors are then the same.

    Results that don't state their recordings are taken for different ones.
    """
    seen: list[tuple[StoredRecording, Path]] = []
    for folder in folders:
        with run_json.opened(folder) as run:
            try:
                parts = list(stored_recordings(folder, run))
            except InputError:
                continue
        for part, (earlier, other) in product(parts, list(seen)):
            has_common = not set(part.frames).isdisjoint(earlier.frames)
            if other is not folder and has_common and is_same(part, earlier):
                raise InputError(
                    f"is of the same recording as {other}: its errors are the same",
                    where=folder,
                    remedy="pass results of different recordings",
                )
        seen += [(part, folder) for part in parts]


def is_same(first: StoredRecording, second: StoredRecording) -> bool:
    """Return whether recordings are one, or copies, whose images all have the same mean depths."""
    if first.opening.source == second.opening.source:
        return True
    known = first.depths.keys() & second.depths.keys()
    is_equal = all(first.depths[k] == second.depths[k] for k in known)
    return is_equal and len({first.depths[k] for k in known}) > 1


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
    depths = {int(f["index"]): f.get("mean_depth_m") for f in run["frames"]}
    if not run["input"]["opening"]:  # any frames may have been made of it in Python
        depths = {}
    sessions = run.get("sessions") or []
    single = {
        "name": folder.resolve().name,
        "opening": run["input"]["opening"] or _opening_of_path(run["input"], folder),
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
            {k: float(d) for k in part_times if (d := depths.get(first + k)) is not None},
            list(part_times),
        )


def _opening_of_path(recording: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return how to open the recording of a result written from Python: only its path is stored."""
    if recording["path"] is None or recording["format"] == "arrays":  # then it is no path
        problem = "has no recording: its frames were pushed one by one, or arrays in memory"
        raise InputError(problem, where=folder, remedy="record them, and run `tofuse run`")
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
    for path in (*opening.paths, opening.camera, opening.rig):
        if path is not None and not path.exists():
            raise InputError(
                f"needs {path}, which doesn't exist",
                where=folder,
                remedy="put it back, or run `tofuse run` again",
            )
    recording = opening.open()
    is_part = np.isin(recording.indices, part.frames)
    matches = int(is_part.sum()) == len(part.frames)
    source = _Unchanged(recording.source, part.depths, folder)
    recording = replace(recording, source=source, indices=recording.indices[is_part])
    if matches and part.times is not None:
        times = np.array([part.times[k] for k in recording.indices.tolist()])
        matches = bool(np.allclose(times, recording.timestamps, rtol=0, atol=_MAX_TIME_DIFFERENCE))
    if not matches:
        raise _changed(folder, recording.path)
    return recording


def stored_config(part: StoredRecording, folder: Path) -> Config:
    """Return the configuration of a recording of a result, not yet adapted to it.

    Raises
    ------
    InputError
        If `run.json` is damaged.
    """
    return changed(from_method("default"), part.config, where=f"{folder / 'run.json'}: config")


def _changed(folder: Path, what: str) -> InputError:
    problem = f"does not match the frames of {what}, which has changed"
    return InputError(problem, where=folder, remedy="run `tofuse run` again")


class _Unchanged(DerivedSource):
    """A source whose frames must have the mean depths of a result's."""

    def __init__(self, source: Source, depths: Mapping[int, float], folder: Path) -> None:
        super().__init__(source)
        self._depths, self._folder = depths, folder

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        frame = super().read(index)
        expected = self._depths.get(index)
        if expected is not None and abs(frame.mean_depth - expected) > _SAME_DEPTH * expected:
            raise _changed(self._folder, f"its recording at frame {index}")
        return frame
