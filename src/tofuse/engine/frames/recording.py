"""A recording: lazily read frames, with timestamps, poses and metadata."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, Intp, UInt8
from tofuse.engine.compute import job_pool
from tofuse.engine.errors import InputError, UnreadableFrameError, shown
from tofuse.engine.frames.frames import Frame, RangeFrame

R = TypeVar("R")
S = TypeVar("S", bound=np.generic)

# Key of a source's metadata: the system of the device that `reference` is of, such as ARKit.
POSES_BY = "poses_by"


class Source(Protocol):
    """The result of opening a path: metadata at once, frames on demand.

    Attributes
    ----------
    timestamps
        (N,) seconds, one for each frame.
    reference
        (N, 4, 4) T_world_camera that came with the recording, NaN where unknown; or None. Used only
        for comparison.
    odometry
        (N, 4, 4) T_world_camera from odometry, NaN where unknown; or None.
    gravity
        (N, 4) unit vector along gravity in the camera's frame, and its standard deviation in rad
        (`sources.imu`), NaN where unknown; or None.
    warnings
        Notes for the user on how the recording was read so far, one line each.
    metadata
        Properties for `inspect` and reports (sensor, ambiguity_m, confidence_max ...).
    """

    timestamps: Float64
    reference: Float64 | None
    odometry: Float64 | None
    gravity: Float64 | None
    metadata: dict[str, Any]

    @property
    def warnings(self) -> list[str]:
        """Notes for the user; some count frames, and change while these are read."""
        ...

    def read(self, index: int) -> Frame:
        """Read frame `index`; raise UnreadableFrameError if it can't be read."""
        ...


class DerivedSource:
    """A source that is another one, except for what a subclass or its user sets."""

    timestamps: Float64
    reference: Float64 | None
    odometry: Float64 | None
    gravity: Float64 | None
    metadata: dict[str, Any]
    warnings: list[str]

    def __init__(self, source: Source) -> None:
        self.source = source

    def __getattr__(self, name: str) -> Any:
        # Not self.source, which would end up here again while a copy is made and has none yet.
        return getattr(object.__getattribute__(self, "source"), name)

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        return self.source.read(index)


@dataclass
class ArraySource:
    """A source over frames in memory."""

    frames: Sequence[Frame]
    reference: Float64 | None = None
    odometry: Float64 | None = None
    warnings: list[str] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)
    gravity: Float64 | None = None

    def __post_init__(self) -> None:
        self.timestamps = np.array([f.timestamp for f in self.frames], float)

    def read(self, index: int) -> Frame:
        """Return frame `index`."""
        return self.frames[index]


@dataclass(frozen=True)
class Recording:
    """A sequence of frames, read lazily.

    ``len(recording)``, ``recording[k]`` and iteration give the selected frames, and
    ``recording[a:b:n]`` is a recording of fewer frames. Iteration reads
    ahead on another thread, and raises for an unreadable frame when its turn comes; `read_all`
    yields the error in its place instead. Pickled for another process, a recording of files is
    opened anew there.

    Attributes
    ----------
    source
        Source of the frames.
    path
        The opened path, for messages.
    format
        Name of the reader.
    indices
        (M,) indices of the selected frames in the source.
    opened
        The source as it was opened, and how to open it again; None if it is in memory.
    """

    source: Source
    path: str
    format: str
    indices: Intp
    opened: tuple[Source, Callable[[], Recording]] | None = None

    @classmethod
    def of(
        cls,
        source: Source,
        path: str | Path,
        format: str,  # noqa: A002
        opened: Callable[[], Recording] | None = None,
    ) -> Recording:
        """Make a recording of all frames of a source.

        Parameters
        ----------
        source
            Reads the frames.
        path
            Where they come from, for messages.
        format
            Name of the reader.
        opened
            Opens it again; None if it is in memory.
        """
        indices = np.arange(len(source.timestamps))
        again = None if opened is None else (source, opened)
        return cls(source, str(path), format, indices, again)

    def __reduce__(self) -> tuple[Any, ...]:
        if self.opened is None or self.opened[0] is not self.source:
            return Recording, (self.source, self.path, self.format, self.indices)
        return _opened_again, (self.opened[1], self.indices)

    def __repr__(self) -> str:
        return f"Recording: {quantities.count(len(self), 'frame')} of {self.path} ({self.format})"

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, k: int) -> Frame: ...

    @overload
    def __getitem__(self, k: slice) -> Recording: ...

    def __getitem__(self, k: int | slice) -> Frame | Recording:
        if isinstance(k, slice):
            return self.select(k.start or 0, k.stop, 1 if k.step is None else k.step)
        return self.source.read(int(self.indices[k]))

    def __iter__(self) -> Iterator[Frame]:
        for item in self.read_all():
            if isinstance(item, UnreadableFrameError):
                raise item
            yield item

    @property
    def timestamps(self) -> Float64:
        """(M,) seconds of the selected frames."""
        return self.source.timestamps[self.indices]

    @property
    def has_timestamps(self) -> bool:
        """Whether frames have times: readers take the frame numbers where there are none."""
        return not np.array_equal(self.timestamps, self.indices)

    @property
    def reference(self) -> Float64 | None:
        """(M, 4, 4) T_world_camera for comparison, NaN where unknown; or None."""
        return None if self.source.reference is None else self.source.reference[self.indices]

    @property
    def odometry(self) -> Float64 | None:
        """(M, 4, 4) T_world_camera of odometry, NaN where unknown; or None."""
        return None if self.source.odometry is None else self.source.odometry[self.indices]

    @property
    def gravity(self) -> Float64 | None:
        """(M, 4) direction of gravity and its sigma, see `Source`; or None."""
        return None if self.source.gravity is None else self.source.gravity[self.indices]

    @property
    def warnings(self) -> list[str]:
        """Notes for the user on how the recording was read, one line each."""
        return [shown(warning) for warning in self.source.warnings]

    @property
    def metadata(self) -> dict[str, Any]:
        """Properties of the recording."""
        return self.source.metadata

    def select(self, start: int = 0, end: int | None = None, every: int = 1) -> Recording:
        """Return the frames start, start + every, ... before `end`; negative counts from the end.

        Raises
        ------
        InputError
            If the selection is empty.
        """
        if every < 1:
            raise InputError(f"is {every}", where="every", remedy="use 1 or more")
        indices = self.indices[slice(start, end, every)]
        if len(indices) == 0:
            raise InputError(
                f"has {quantities.count(len(self), 'frame')}, of which the selection leaves none",
                where=self.path,
                remedy="change --start, --end or --every",
            )
        return replace(self, indices=indices)

    def sample(self, count: int) -> list[Frame | UnreadableFrameError]:
        """Read up to `count` evenly spaced frames, including the first and the last.

        Unreadable frames are replaced by their error.
        """
        items: list[Frame | UnreadableFrameError] = []
        for k in evenly_spaced(range(len(self)), count):
            try:
                items.append(self[k])
            except UnreadableFrameError as error:
                items.append(error)
        return items

    def readable(self, count: int) -> list[Frame]:
        """Read the readable frames among `count` evenly spaced ones; see `sample`."""
        return [item for item in self.sample(count) if not isinstance(item, UnreadableFrameError)]

    def images(self, count: int) -> list[RangeFrame]:
        """Read the readable images among `count` evenly spaced frames; InputError for clouds."""
        out: list[RangeFrame] = []
        for frame in self.readable(count):
            if not isinstance(frame, RangeFrame):
                raise InputError(
                    "contains clouds", where=self.path, remedy="pass a recording of depth images"
                )
            out.append(frame)
        return out

    def image(self, k: int) -> RangeFrame | None:
        """Read frame `k`; None if it can't be read, or is not an image."""
        try:
            frame = self[k]
        except UnreadableFrameError:
            return None
        return frame if isinstance(frame, RangeFrame) else None

    def origin(self, index: int) -> tuple[Source, int]:
        """Return the source that a frame is from, if that here is made of others, and its index."""
        source = self.source
        while (origin := getattr(source, "origin", None)) is not None:
            source, index = origin(index)
        return source, index

    def full_color(self, frame: RangeFrame) -> UInt8 | None:
        """Return the colour of a frame as recorded, if it is finer than at the depth's size."""
        source, index = self.origin(frame.index)
        read = getattr(source, "full_resolution_color", None)
        if read is None or frame.color_image is None:
            return None
        try:
            image: UInt8 | None = read(index)
        except InputError:
            return None
        return None if image is None or len(image) <= len(frame.color_image) else image

    def first_readable(self) -> Frame | None:
        """Return the first readable frame; None if there is none."""
        for k in range(len(self)):
            try:
                return self[k]
            except UnreadableFrameError:
                continue
        return None

    def read_all(self, ahead: int = 8) -> Iterator[Frame | UnreadableFrameError]:
        """Iterate over the frames, with errors in place of unreadable ones.

        Reads up to `ahead` frames in advance: on two other threads if the source allows it, else
        on one.
        """
        return (item for item, _ in self.read_with(lambda frame: None, ahead))

    def read_with(
        self, process: Callable[[Frame], R], ahead: int = 8
    ) -> Iterator[tuple[Frame | UnreadableFrameError, R | None]]:
        """Iterate as `read_all` does, with the result of a function of each frame.

        Parameters
        ----------
        process
            Called with each frame on the thread that read it, in no particular order. The result
            is None for frames that can't be read.
        ahead
            Maximum number of frames that are read in advance.
        """

        def read(index: int) -> tuple[Frame | UnreadableFrameError, R | None]:
            try:
                frame = self.source.read(index)
            except UnreadableFrameError as error:
                return error, None
            return frame, process(frame)

        workers = 2 if getattr(self.source, "concurrent", False) else 1
        pool = job_pool(workers, "tofuse-reader")
        indices = iter(self.indices.tolist())
        pending = deque(pool.submit(read, k) for k in islice(indices, max(1, ahead)))
        try:
            while pending:
                item = pending.popleft().result()
                pending.extend(pool.submit(read, k) for k in islice(indices, 1))
                yield item
        finally:
            pool.shutdown(cancel_futures=True)


def _opened_again(opened: Callable[[], Recording], indices: Intp) -> Recording:
    return replace(opened(), indices=indices)


@overload
def evenly_spaced(items: NDArray[S], count: int) -> NDArray[S]: ...


@overload
def evenly_spaced(items: Sequence[R], count: int) -> list[R]: ...


def evenly_spaced(items: Any, count: int) -> Any:
    """Return at most `count` of the items, evenly spaced, including the first and the last."""
    spaced = np.linspace(0, len(items) - 1, min(count, len(items))).round()
    positions = np.unique(spaced.astype(np.intp))
    return items[positions] if isinstance(items, np.ndarray) else [items[k] for k in positions]
