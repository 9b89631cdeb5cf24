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
from dataclasses import fields, replace
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
# Attributes of steps and of registrations that are plain data.
_PLAIN_STEP = ("status", "reason", "reference", "component", "doubtful", "inflation")
_ARRAYS = ("T_target_source", "information", "unobservable", "errors", "runner_up")
_PLAIN_REGISTRATION = tuple(f.name for f in fields(Registration) if f.name not in _ARRAYS)
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
        except (InputError, LookupError, RuntimeError, TypeError, ValueError) as error:
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
        masks = _split(arrays, "moving")
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
    registrations = [
        registration
        for _, step in steps
        for registration in (step.registration, *(link.registration for link in step.links))
        if registration is not None
    ]
    unobservable = [r.unobservable for r in registrations]
    masks = [np.frombuffer(bits, np.uint8) for bits in tracker.moving.values()]
    return {
        "steps": _text([_plain_step(index, step) for index, step in steps]),
        "poses": _matrices([step.T_component_camera for _, step in steps], 4),
        "predicted": _matrices([tracker.predicted.get(index) for index, _ in steps], 4),
        "registrations": _text([_attributes(r, _PLAIN_REGISTRATION) for r in registrations]),
        "T_target_source": _matrices([r.T_target_source for r in registrations], 4),
        "information": _matrices([r.information for r in registrations], 6),
        "runner_up": _matrices([r.runner_up for r in registrations], 4),
        "unobservable": np.concatenate([np.zeros((0, 6)), *unobservable]),
        "n_unobservable": np.array([len(u) for u in unobservable], np.int64),
        "moving": np.concatenate([np.zeros(0, np.uint8), *masks]),
        "n_moving": np.array([len(mask) for mask in masks], np.int64),
        "moving_index": np.array(list(tracker.moving), np.int64),
    }


def _plain_step(index: int, step: Step) -> list[Any]:
    """Return a frame's index, links, and plain attributes, without matrices."""
    links = [[link.i, link.j, link.certain, link.how] for link in step.links]
    return [index, step.registration is not None, links, *_attributes(step, _PLAIN_STEP)]


def _unpacked_steps(arrays: npz.Arrays) -> Iterator[tuple[int, Step]]:
    """Yield the steps in arrays of `_packed`, by frame index."""
    registrations = _unpacked_registrations(arrays)
    for plain, pose in zip(_parsed(arrays["steps"]), arrays["poses"], strict=True):
        index, is_registered, links, *others = plain
        step = Step(
            T_component_camera=_matrix(pose),
            registration=next(registrations) if is_registered else None,
            links=tuple(
                Link(i, j, next(registrations), certain, how) for i, j, certain, how in links
            ),
            **dict(zip(_PLAIN_STEP, others, strict=True)),
        )
        yield index, step


def _unpacked_registrations(arrays: npz.Arrays) -> Iterator[Registration]:
    names = ("T_target_source", "information", "runner_up")
    matrices = zip(*(map(_matrix, arrays[name]) for name in names), strict=True)
    rows = zip(
        _parsed(arrays["registrations"]), matrices, _split(arrays, "unobservable"), strict=True
    )
    for plain, given, unobservable in rows:
        yield Registration(
            unobservable=unobservable.copy(),
            **dict(zip(names, given, strict=True)),
            **dict(zip(_PLAIN_REGISTRATION, plain, strict=True)),
        )


def _attributes(item: Step | Registration, names: Sequence[str]) -> list[Any]:
    return [getattr(item, name) for name in names]


def _split(arrays: npz.Arrays, name: str) -> list[NDArray[Any]]:
    """Return the parts of an array whose lengths are in another one."""
    return np.split(arrays[name], np.cumsum(arrays[f"n_{name}"]))[:-1]


def _unpacked_mask(bits: NDArray[Any], shape: tuple[int, ...]) -> Bool:
    """Return a mask (H, W) from its compressed bits."""
    rows, columns = shape
    packed = np.frombuffer(zlib.decompress(bits.tobytes()), np.uint8)
    return np.unpackbits(packed, count=rows * columns).astype(np.bool_).reshape(rows, columns)


def _matrices(items: Sequence[Float64 | None], size: int) -> Float64:
    """Return matrices (size, size) as one array (N, size, size); NaN for None."""
    out = np.full((len(items), size, size), np.nan)
    for row, item in zip(out, items, strict=True):
        if item is not None:
            row[:] = item
    return out


def _matrix(row: Float64) -> Float64 | None:
    return None if np.isnan(row).all() else row.copy()


def _text(data: Any) -> NDArray[np.uint8]:
    """Return plain data as JSON in an array, with all digits of its numbers."""
    text = json.dumps(data, separators=(",", ":"), default=np.generic.item)
    return np.frombuffer(text.encode(), np.uint8)


def _parsed(text: NDArray[Any]) -> Any:
    return json.loads(text.tobytes())
