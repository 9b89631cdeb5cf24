"""The result of tracking in a file, from which an interrupted run goes on after tracking.

The file contains the steps of the tracker: poses, registrations, links and masks of moving objects.
When the run is repeated, the recording is read and its frames are prepared again; only the tracker
is replaced by one that returns the stored steps. As everything after it receives the same input,
the result has the same bytes.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.alignment import Link, Registration
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.mapping import FrameLog
from tofuse.engine.tracking import FrameTime, Step, Tracker, moving_objects
from tofuse.engine.views import PreparedView
from tofuse.formats.files import atomic, npz

# Tracking that took less, in s, is repeated.
_MIN_TRACKING_S = 10.0
# Attributes of steps that are plain data, and those of registrations that are arrays.
_PLAIN_STEP = ("status", "reason", "reference", "component", "doubtful", "inflation")
_ARRAYS = ("T_target_source", "information", "unobservable", "runner_up")
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
        self._tracker: LoggingTracker | ReplayingTracker
        self._start_s = 0.0

    def tracker(self, tracker: Tracker) -> Tracker:
        """Return a tracker that repeats the stored steps, or else one that tracks.

        Parameters
        ----------
        tracker
            Prepares views, and tracks.
        """
        self._start_s = perf_counter()
        self._tracker = self._replaying(tracker) or LoggingTracker(tracker)
        return self._tracker

    def finish(self, log: FrameLog) -> None:
        """Store the steps of all frames after tracking.

        Raises
        ------
        InputError
            If steps were repeated, and not those of all frames.
        """
        indices = [e.record.index for e in log.entries if e.step is not None]
        if isinstance(self._tracker, ReplayingTracker):
            if indices != self._tracker.indices:
                raise InputError(
                    "other frames can be read than before the interruption",
                    where=self._path,
                    remedy="run the same command again: it starts again from the beginning",
                )
        elif perf_counter() - self._start_s >= _MIN_TRACKING_S:
            self._store(_packed(log, self._tracker))

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
        """Remove the file, if there is one."""
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
                np.savez(file, allow_pickle=False, key=np.array(self._key), **arrays)
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
        Masks of moving objects by frame index, of the prepared views, as compressed bits.
    """

    def __init__(self, tracker: Tracker) -> None:
        self.predicted: dict[int, Float64] = {}
        self.moving: dict[int, bytes] = {}
        self._tracker = tracker

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`."""
        step = self._tracker.push(frame, T_odometry, surface)
        if step.moving is not None and step.surface is not None:
            rows, columns = step.surface.z.shape
            size = step.moving.shape[1] // columns
            mask = step.moving[: rows * size : size, : columns * size : size]
            self.moving[frame.index] = zlib.compress(np.packbits(mask).tobytes())
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
        self._steps = dict(_unpacked_steps(arrays))
        self.indices = list(self._steps)
        poses = map(_matrix, arrays["predicted"])
        self._predicted = dict(zip(self.indices, poses, strict=True))
        masks = np.split(arrays["moving"], np.cumsum(arrays["n_moving"]))[:-1]
        self._moving = dict(zip(arrays["moving_index"].tolist(), masks, strict=True))

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
        mask = _unpacked_mask(bits, view.z.shape)
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
    steps = [(e.record.index, e.step) for e in log.entries if e.step is not None]
    masks = [np.frombuffer(bits, np.uint8) for bits in tracker.moving.values()]
    # JSON has all digits of the numbers.
    text = json.dumps([_plain_step(index, step) for index, step in steps], default=_plain)
    return {
        "steps": np.frombuffer(text.encode(), np.uint8),
        "poses": _matrices([step.T_component_camera for _, step in steps]),
        "predicted": _matrices([tracker.predicted.get(index) for index, _ in steps]),
        "moving": np.concatenate([np.zeros(0, np.uint8), *masks]),
        "n_moving": np.array([len(mask) for mask in masks], np.int64),
        "moving_index": np.array(list(tracker.moving), np.int64),
    }


def _plain_step(index: int, step: Step) -> list[Any]:
    """Return a frame's index, registration, links and plain attributes."""
    links = [vars(link) for link in step.links]
    return [index, step.registration, links, *(getattr(step, name) for name in _PLAIN_STEP)]


def _plain(value: Any) -> Any:
    """Return what JSON can't represent as plain data: registrations, arrays, NumPy's numbers."""
    if isinstance(value, Registration):
        return {name: x for name, x in vars(value).items() if name != "errors"}
    return value.tolist()


def _unpacked_steps(arrays: npz.Arrays) -> Iterator[tuple[int, Step]]:
    """Yield the steps in arrays of `_packed`, by frame index."""
    steps = json.loads(arrays["steps"].tobytes())
    for (index, registration, links, *plain), pose in zip(steps, arrays["poses"], strict=True):
        yield (
            index,
            Step(
                T_component_camera=_matrix(pose),
                registration=None if registration is None else _registration(registration),
                links=tuple(
                    Link(**(link | {"registration": _registration(link["registration"])}))
                    for link in links
                ),
                **dict(zip(_PLAIN_STEP, plain, strict=True)),
            ),
        )


def _registration(plain: dict[str, Any]) -> Registration:
    arrays: dict[str, Any] = {
        name: None if plain[name] is None else np.array(plain[name], float) for name in _ARRAYS
    }
    arrays["unobservable"] = arrays["unobservable"].reshape(-1, 6)
    return Registration(**(plain | arrays))


def _unpacked_mask(bits: NDArray[Any], shape: tuple[int, ...]) -> Bool:
    """Return a mask (H, W) from its compressed bits."""
    rows, columns = shape
    packed = np.frombuffer(zlib.decompress(bits.tobytes()), np.uint8)
    return np.unpackbits(packed, count=rows * columns).astype(np.bool_).reshape(rows, columns)


def _matrices(items: Sequence[Float64 | None]) -> Float64:
    """Return matrices (4, 4) as one array (N, 4, 4); NaN for None."""
    unknown = np.full((4, 4), np.nan)
    return np.array([unknown if T is None else T for T in items], float).reshape(-1, 4, 4)


def _matrix(row: Float64) -> Float64 | None:
    return None if np.isnan(row).all() else row.copy()
