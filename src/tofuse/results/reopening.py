"""The recordings of a result, opened again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.errors import InputError
from tofuse.recordings.opening import Opening
from tofuse.recordings.recording import Recording
from tofuse.results.folder import RECORDING

# Times of frames that differ by more are not those of the same recording, s.
_SAME_TIME = 1e-6


@dataclass(frozen=True, eq=False)
class RecordedPart:
    """What a result says of one of its recordings; but for merged results there is one.

    Attributes
    ----------
    name
        What it is called in words.
    opening
        How it was opened.
    config
        How its frames were corrected and filtered, as plain data.
    first
        What was added to the indices of its frames.
    times
        s, by the index of the frame in the recording; None where other recordings moved them on.
    frames
        Indices in the recording of the frames that the result speaks of.
    """

    name: str
    opening: Opening
    config: dict[str, Any]
    first: int
    times: dict[int, float] | None
    frames: list[int]


def recorded_parts(folder: Path, run: Mapping[str, Any]) -> Iterator[RecordedPart]:
    """Read what the `run.json` of a folder says of its recordings.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError, IndexError
        If it is damaged.
    InputError
        If it does not say how a recording was opened.
    """
    times = {int(f["index"]): float(f["timestamp"]) for f in run["frames"]}
    if not times:
        raise ValueError("no frames")
    several = run.get("sessions") or []
    alone = {
        "name": folder.resolve().name,
        "opening": run["input"].get("opening") or _of_old(run["input"]),
        "config": run["config"],
        "first": 0,
        "count": max(times) + 1,
    }
    for part in several or [alone]:
        first, count = int(part["first"]), int(part["count"])
        mine = {k - first: t for k, t in times.items() if first <= k < first + count}
        yield RecordedPart(
            str(part["name"]),
            Opening.from_dict(part["opening"], folder / "run.json"),
            dict(part["config"]),
            first,
            None if several else mine,
            list(mine),
        )


def _of_old(told: Mapping[str, Any]) -> dict[str, Any]:
    """How the recording of a result of before version 0.2 was opened, as far as it says."""
    return Opening((Path(told["path"]),)).to_dict()


def where_it_lies(opening: Opening, folder: Path) -> Opening:
    """Return where a recording is: as told, or where `tofuse demo` leaves it, beside its result."""
    beside = folder / RECORDING
    lies = all(path.exists() for path in opening.paths)
    if not lies and beside.is_dir() and [path.name for path in opening.paths] == [RECORDING]:
        return replace(opening, paths=(beside,))
    return opening


def reopened(part: RecordedPart, folder: Path) -> Recording:
    """Open the recording of a result again: the frames that the result speaks of.

    Raises
    ------
    InputError
        If it is gone, can't be opened, or is another one by now.
    """
    opening = where_it_lies(part.opening, folder)
    for path in (*opening.paths, *((opening.camera,) if opening.camera else ())):
        if not path.exists():
            raise InputError(
                f"needs {path}, which is gone",
                where=folder,
                remedy="put it back there, or run `tofuse run` again where it is now",
            )
    recording = opening.open()
    chosen = np.isin(recording.indices, part.frames)
    same = int(chosen.sum()) == len(part.frames)
    recording = replace(recording, indices=recording.indices[chosen])
    if same and part.times is not None:
        times = np.array([part.times[k] for k in recording.indices.tolist()])
        same = bool(np.allclose(times, recording.timestamps, rtol=0, atol=_SAME_TIME))
    if not same:
        raise InputError(
            f"is not of the frames that {recording.path} holds by now",
            where=folder,
            remedy="run `tofuse run` again",
        )
    return recording
