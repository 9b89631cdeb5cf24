"""The result of tracking in a file, from which an interrupted run goes on after tracking.

The file contains the steps of the tracker: poses, registrations, links and masks of moving objects.
When the run is repeated, the recording is read and its frames are prepared again; only the tracker
is replaced by one that returns the stored steps. As everything after it receives the same input,
the result has the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from tofuse.engine.alignment import Link, Registration
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.mapping import FrameLog
from tofuse.engine.stopwatch import timing
from tofuse.engine.tracking import FrameTime, Step, Tracker, moving_objects
from tofuse.engine.views import PreparedView
from tofuse.formats.files import atomic, npz

# Tracking that took less, in s, is repeated.
_MIN_TRACKING_S = 10.0
# Images of steps, which are made again, and the arrays of registrations.
_IMAGES = ("surface", "moving")
_ARRAYS = ("T_target_source", "information", "unobservable", "runner_up", "reference_point")
_MOVING = "moving-"  # prefix of the masks, by frame index
_NOT_TRACKED = Step("lost", "not tracked before", None)


class TrackedFile:
    """The file of one run's tracked frames, until the run has a result.

    Parameters
    ----------
    path
        The file.
    key
        Text that identifies everything that determines the result of tracking. A file with another
        key is not used.
    note
        Shows a message to the user.
    """

    def __init__(self, path: Path, key: str, note: Callable[[str], None]) -> None:
        self._path, self._key, self._note = path, key, note

    def tracker(self, tracker: Tracker) -> Tracker:
        """Return a tracker that repeats the stored steps, or else one that tracks.

        Parameters
        ----------
        tracker
            Prepares views, and tracks.
        """
        return self._replaying(tracker) or LoggingTracker(tracker)

    @timing("writing")
    def finish(self, tracker: Tracker, log: FrameLog) -> None:
        """Store the steps of all frames after tracking, with what the tracker has kept.

        Raises
        ------
        InputError
            If steps were repeated, and not those of all frames.
        """
        if isinstance(tracker, ReplayingTracker):
            if [e.record.index for e in log.entries if e.step is not None] != tracker.indices:
                raise InputError(
                    "other frames can be read than before the interruption",
                    where=self._path,
                    remedy="run the same command again: it starts again from the beginning",
                )
        elif isinstance(tracker, LoggingTracker) and tracker.took_long:
            self._store(_packed(log, tracker))

    def keep_after(self, error: BaseException) -> None:
        """Keep the file if repeating the run may succeed; the error gets a note about that."""
        is_lasting = isinstance(error, Exception) and not isinstance(
            error, OutputError | OSError | MemoryError | SystemError
        )
        if is_lasting:
            self.remove()
        effect = (
            "goes on after tracking" if self._path.exists() else "starts again from the beginning"
        )
        error.add_note(f"the same command {effect}")

    def remove(self) -> None:
        """Remove the file, if there is one; a folder in its place is named when it is written."""
        if not self._path.is_dir():
            self._path.unlink(missing_ok=True)

    def _replaying(self, tracker: Tracker) -> ReplayingTracker | None:
        if not self._path.exists():
            return None
        try:
            arrays = npz.read_npz(self._path)
            if arrays["key"].tolist() == self._key:
                replaying = ReplayingTracker(tracker, arrays)
                self._note("goes on after the tracking of an interrupted run")
                return replaying
            problem = "belong to another input, other options or another version"
        except (
            InputError,
            AttributeError,
            LookupError,
            RuntimeError,
            TypeError,
            ValueError,
        ) as error:
            reason = error.problem if isinstance(error, InputError) else str(error)
            problem = f"are damaged ({reason})"
        self._note(
            f"the tracked frames of an interrupted run {problem}: it starts again from "
            "the beginning"
        )
        self.remove()
        return None

    def _store(self, arrays: npz.Arrays) -> None:
        try:
            with atomic.replacing(self._path, durable=False) as part, part.open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, key=np.array(self._key), **arrays)
        except OutputError as error:
            self._note(
                f"the tracked frames {error.problem}; if the run is interrupted and repeated, "
                "it starts again from the beginning"
            )


class LoggingTracker(Tracker):
    """Tracks, and keeps what the log of frames lacks.

    Attributes
    ----------
    predicted
        (4, 4) predicted poses by frame index.
    moving
        Masks of moving objects by frame index, of the prepared views, as bits.
    """

    def __init__(self, tracker: Tracker) -> None:
        self.predicted: dict[int, Float64] = {}
        self.moving: dict[int, UInt8] = {}
        self._tracker, self._start_s = tracker, perf_counter()

    @property
    def took_long(self) -> bool:
        """Whether what has been tracked is worth a file."""
        return perf_counter() - self._start_s >= _MIN_TRACKING_S

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`."""
        step = self._tracker.push(frame, T_odometry, surface)
        if step.moving is not None and step.surface is not None:
            rows, columns = step.surface.z.shape
            size = step.moving.shape[1] // columns
            mask = step.moving[: rows * size : size, : columns * size : size]
            self.moving[frame.index] = np.packbits(mask)
        return step

    def prepare(self, frame: Frame) -> PreparedView | None:
        """See `Tracker.prepare`."""
        return self._tracker.prepare(frame)

    def predicted_pose(self, now: FrameTime) -> Float64 | None:
        """See `Tracker.predicted_pose`."""
        T = self._tracker.predicted_pose(now)
        if T is not None:
            self.predicted[now.index] = T
        return T

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._tracker.interrupt()


class ReplayingTracker(Tracker):
    """Repeats stored steps.

    Parameters
    ----------
    tracker
        Prepares views.
    arrays
        As made by `_packed`.

    Attributes
    ----------
    indices
        Indices of the frames with a step.
    """

    def __init__(self, tracker: Tracker, arrays: npz.Arrays) -> None:
        self._prepare = tracker.prepare
        rows = json.loads(arrays["steps"].tobytes())
        self.indices = [index for index, _, _ in rows]
        self._predicted = {index: _array(T) for index, T, _ in rows}
        self._steps = {index: _step(stored) for index, _, stored in rows}
        self._moving = {
            int(name.removeprefix(_MOVING)): bits
            for name, bits in arrays.items()
            if name.startswith(_MOVING)
        }

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`."""
        step = self._steps.pop(frame.index, _NOT_TRACKED)
        if step.T_component_camera is None:
            return step
        view = self._prepare(frame) if surface is None else surface
        bits = self._moving.get(frame.index)
        if bits is None or view is None or not isinstance(frame, RangeFrame):
            return replace(step, surface=view)
        mask = np.unpackbits(bits, count=view.z.size).astype(np.bool_).reshape(view.z.shape)
        return replace(
            step,
            surface=moving_objects.without_pixels(view, mask),
            moving=moving_objects.at_size(mask, frame),
        )

    def prepare(self, frame: Frame) -> PreparedView | None:
        """See `Tracker.prepare`."""
        return self._prepare(frame)

    def predicted_pose(self, now: FrameTime) -> Float64 | None:
        """See `Tracker.predicted_pose`."""
        return self._predicted.get(now.index)


def _packed(log: FrameLog, tracker: LoggingTracker) -> npz.Arrays:
    """Return the steps of a log as arrays."""
    rows = [
        (e.record.index, tracker.predicted.get(e.record.index), e.step)
        for e in log.entries
        if e.step is not None
    ]
    # JSON has all digits of the numbers.
    text = json.dumps(rows, default=_plain)
    masks = {f"{_MOVING}{index}": bits for index, bits in tracker.moving.items()}
    return {"steps": np.frombuffer(text.encode(), np.uint8), **masks}


def _plain(value: Any) -> Any:
    """Return what JSON can't represent as plain data: steps, arrays, NumPy's numbers."""
    if isinstance(value, Step):
        return {name: x for name, x in vars(value).items() if name not in _IMAGES}
    if isinstance(value, Registration | Link):
        return {name: x for name, x in vars(value).items() if name != "errors"}
    return value.tolist()


def _step(stored: dict[str, Any]) -> Step:
    """Return a step from plain data."""
    return Step(
        **stored
        | {
            "T_component_camera": _array(stored["T_component_camera"]),
            "registration": _registration(stored["registration"]),
            "links": tuple(
                Link(**link | {"registration": _registration(link["registration"])})
                for link in stored["links"]
            ),
        }
    )


def _registration(stored: dict[str, Any] | None) -> Registration | None:
    if stored is None:
        return None
    arrays: dict[str, Any] = {name: _array(stored[name]) for name in _ARRAYS}
    arrays["unobservable"] = arrays["unobservable"].reshape(-1, 6)
    return Registration(**(stored | arrays))


def _array(values: Any) -> Float64 | None:
    return None if values is None else np.array(values, float)
