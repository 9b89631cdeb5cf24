"""The sequence of frames: checks of the next one, and a log of the results of all."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.alignment import Link
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError, InputWarning
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.graph import external_sensors
from tofuse.engine.loops import TrackedComponent
from tofuse.engine.mapping.config import ViewKind, kind_of
from tofuse.engine.results import FrameRecord
from tofuse.engine.stored_views import ViewStore
from tofuse.engine.times import check_seconds
from tofuse.engine.tracking import Step
from tofuse.engine.views import PreparedView

_FAR_M = 100.0  # no depth camera measures as far
_TIMES = 5  # before the latest, whose intervals show their unit


class FrameSequence:
    """Checks the order and the kind of frames as they arrive, and detects repeated images.

    Attributes
    ----------
    kind
        Kind of the frames so far; None before the first.
    """

    def __init__(self) -> None:
        self.kind: ViewKind | None = None
        self._index: int | None = None
        self._previous: RangeFrame | None = None  # uncorrected
        self._times: list[float] | None = []  # None once the user was warned of them

    def check_kind(self, frame: Frame) -> bool:
        """Return whether it is the first frame; InputError for another kind than those before."""
        kind = kind_of(frame)
        if self.kind and kind != self.kind:
            raise InputError(
                f"is a {kind} view among {self.kind} views",
                where=f"frame {frame.index}",
                remedy="pass images only, or clouds only",
            )
        return self.kind is None

    def check_order(self, index: int) -> None:
        """Raise InputError if the index of the next frame is not larger than the last one."""
        if self._index is not None and index <= self._index:
            raise InputError(
                f"comes after frame {self._index}",
                where=f"frame {index}",
                remedy="number the frames in the order in which they are pushed",
            )

    def check_time(self, frame: Frame) -> None:
        """Warn, once, of a time that does not ascend, or not as that of a camera in seconds."""
        if self._times is None or not frame.timestamp:  # 0 is that of frames without time
            return
        problem = ""
        if self._times and frame.timestamp <= self._times[-1]:
            problem = f" is {frame.timestamp:.10g}, after {self._times[-1]:.10g}"
        self._times = [*self._times[-_TIMES:], frame.timestamp]
        try:
            if not problem and len(self._times) > 1:
                check_seconds(np.array(self._times))
        except InputError as error:
            problem = f"s {error.problem}"
        if problem:
            self._times = None
            warnings.warn(
                f"frame {frame.index}: timestamp{problem}; motion is predicted by times: pass "
                "seconds that ascend, and leave out frames that repeat",
                InputWarning,
                stacklevel=4,
            )

    def accept(self, index: int, kind: ViewKind | None = None) -> None:
        """Record a frame that passed all checks; its kind is None if it could not be read."""
        self._index = index
        self.kind = self.kind or kind

    def interrupt(self) -> None:
        """Begin another recording, whose clock and images are others than those before."""
        self._previous = None
        self._times = None if self._times is None else []

    def is_repeated(self, frame: Frame) -> bool:
        """Whether an image equals the previous one: the camera is stuck, as noise never repeats."""
        if not isinstance(frame, RangeFrame):
            return False
        previous, self._previous = self._previous, frame
        if previous is None:
            return False
        before, now = previous.depth, frame.depth
        # Images that differ nearly always do in some rows, too.
        some = np.s_[:: len(now) // 8 + 1]
        equal = np.array_equal(before[some], now[some]) and np.array_equal(before, now)
        return equal and len(frame) > 0


@dataclass(frozen=True, eq=False)
class Entry:
    """One frame.

    Attributes
    ----------
    record
        Its record in the result.
    step
        Its tracking result; None if it could not be read.
    recording
        Number of its recording, if several are joined.
    T_odometry, gravity
        Measurements of external sensors: (4, 4), (4,).
    moving_fraction
        Fraction of its pixels on moving objects.
    """

    record: FrameRecord
    step: Step | None
    recording: int
    T_odometry: Float64 | None = None
    gravity: Float64 | None = None
    moving_fraction: float = 0.0

    @property
    def has_pose(self) -> bool:
        """Whether it has a pose in its component."""
        return self.step is not None and self.step.T_component_camera is not None


def record_of(frame: Frame, step: Step, mean_depth_m: float) -> FrameRecord:
    """Return the record of a tracked frame, whose mean depth was another one as it was read."""
    r = step.registration
    return FrameRecord(
        frame.index,
        frame.timestamp,
        step.status,
        step.reason,
        valid_share=len(frame) / frame.valid.size if frame.valid.size else 0.0,
        inlier_share=None if r is None else r.inlier_ratio,
        rms_m=None if r is None else r.rms_m,
        unobservable=np.zeros((0, 6)) if r is None else r.unobservable,
        mean_depth_m=mean_depth_m,
    )


@dataclass(eq=False)
class FrameLog:
    """All frames so far.

    Attributes
    ----------
    entries
        One per frame.
    interruptions
        Positions at which another recording begins.
    repeated
        Indices of the frames whose image equals the one before in every pixel.
    """

    entries: list[Entry] = field(default_factory=list)
    interruptions: list[int] = field(default_factory=list)
    repeated: list[int] = field(default_factory=list)
    _steps: dict[int, Step] = field(default_factory=dict, init=False, repr=False)

    def add(
        self,
        record: FrameRecord,
        step: Step | None,
        T_odometry: Float64 | None = None,
        gravity: Float64 | None = None,
    ) -> None:
        """Add the next frame, without its images."""
        moving = 0.0
        if step is not None:
            moving = step.moving_fraction
            r = step.registration
            r = None if r is None else replace(r, errors=())
            step = replace(step, registration=r, surface=None, moving=None)
            self._steps[record.index] = step
        number = len(self.interruptions)
        self.entries.append(Entry(record, step, number, T_odometry, gravity, moving))

    def check_posed(self) -> None:
        """Raise InputError if no frame has a pose."""
        if not self.entries:
            raise InputError("has no frames", where="mapper", remedy="push frames first")
        if not self.posed:
            entries = self.entries
            remedy = "check it with `tofuse inspect`, and the limits of depth and the filters"
            depths = [e.record.mean_depth_m or 0.0 for e in entries]
            if np.nanmedian(depths) > _FAR_M:
                mean = f"{np.nanmedian(depths):.0f} m"
                remedy = f"depth must be in m; here it is {mean} on average: use --factor"
            raise InputError(
                f"has {quantities.count(len(entries), 'frame')}, none with enough valid points "
                f"for a pose (first: {entries[0].record.reason})",
                where="the recording",
                remedy=remedy,
            )

    @property
    def posed(self) -> list[Entry]:
        """Frames with a pose in any component."""
        return [entry for entry in self.entries if entry.has_pose]

    @property
    def links(self) -> list[Link]:
        """All links between components found during tracking."""
        return [link for e in self.posed if e.step is not None for link in e.step.links]

    def of(self, frames: Collection[int]) -> FrameLog:
        """Return the part of the log that consists of these frame indices."""
        kept = set(frames)
        rows = [k for k, e in enumerate(self.entries) if e.record.index in kept]
        starts = [int(np.searchsorted(rows, position)) for position in self.interruptions]
        return FrameLog(
            [self.entries[k] for k in rows],
            sorted({position for position in starts if 0 < position < len(rows)}),
            [index for index in self.repeated if index in kept],
        )

    def of_component(self, component: int) -> FrameLog:
        """Return the part of the log in one component of the tracker."""
        members = [
            e.record.index
            for e in self.posed
            if e.step is not None and e.step.component == component
        ]
        return self.of(members)

    def step_of(self, frame: int) -> Step:
        """Return the tracking result of a frame with a pose."""
        return self._steps[frame]

    def numbered(self, numbers: Mapping[int, int]) -> FrameLog:
        """Return the log with final component numbers in its records, by the tracker's numbers."""
        entries = [
            replace(e, record=replace(e.record, component=numbers[e.step.component]))
            if e.step is not None and e.has_pose
            else e
            for e in self.entries
        ]
        return FrameLog(entries, self.interruptions, self.repeated)

    def tracked_components(self, views: ViewStore[PreparedView]) -> list[TrackedComponent]:
        """Return the components as tracked, in the order in which they began."""
        members: dict[int, list[Entry]] = {}
        for entry in self.posed:
            assert entry.step is not None
            members.setdefault(entry.step.component, []).append(entry)
        components = []
        for component, entries in members.items():
            poses = [e.step.T_component_camera for e in entries if e.step is not None]
            components.append(
                TrackedComponent(
                    component,
                    np.array([e.record.index for e in entries], np.intp),
                    np.array([e.record.timestamp for e in entries]),
                    np.array(poses),
                    tuple(v for v in views.views if v.component == component),
                    np.array([e.recording for e in entries], np.intp),
                    _odometry(entries),
                )
            )
        return components

    def sensor_data(self, ids: Sequence[int]) -> external_sensors.SensorData:
        """Return the measurements of external sensors for frames by index."""
        by_index = {e.record.index: e for e in self.entries}
        entries = [by_index[index] for index in ids]
        gravity = np.full((len(ids), 4), np.nan)
        for row, entry in zip(gravity, entries, strict=True):
            if entry.gravity is not None:
                row[:] = entry.gravity
        times = np.array([e.record.timestamp for e in entries])
        parts = np.array([e.recording for e in entries], np.intp)
        degenerate = np.array([len(e.record.unobservable) > 0 for e in entries], bool)
        return external_sensors.SensorData(
            np.array(ids, np.intp), times, _odometry(entries), gravity, parts, degenerate
        )


def _odometry(entries: Sequence[Entry]) -> Float64:
    """Return the poses (P, 4, 4) of odometry, NaN where there are none."""
    poses = np.full((len(entries), 4, 4), np.nan)
    for pose, entry in zip(poses, entries, strict=True):
        if entry.T_odometry is not None:
            pose[:] = entry.T_odometry
    return poses


def poses_in_world(log: FrameLog, T_world_component: Mapping[int, Float64]) -> dict[int, Float64]:
    """Return (4, 4) T_world_camera by frame index; the first one is the identity.

    Parameters
    ----------
    log
        All frames.
    T_world_component
        (4, 4) by component; frames of other components are omitted.
    """
    poses: dict[int, Float64] = {}
    T_first: Float64 | None = None
    for entry in log.posed:
        step = entry.step
        if step is None or step.T_component_camera is None:
            continue
        if step.component not in T_world_component:
            continue
        T = T_world_component[step.component] @ step.T_component_camera
        if T_first is None:
            T_first = se3.inverse(T)
        poses[entry.record.index] = np.asarray(T_first @ T, np.float64)
    return poses
