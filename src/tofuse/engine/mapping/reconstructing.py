"""Reconstruction of a recording: adapt the configuration, track, finish, self-calibrate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import POSES_BY, Frame, Recording
from tofuse.engine.loops import PriorLoop
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.color_frames import ColorFrames
from tofuse.engine.mapping.config import Config, ViewKind, kind_of
from tofuse.engine.mapping.frame_log import FrameLog
from tofuse.engine.mapping.mapper import Mapper, prior_loops
from tofuse.engine.mapping.methods import configured
from tofuse.engine.mapping.self_calibration import self_calibrated
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.results import Reconstruction
from tofuse.engine.sensor import CameraErrors
from tofuse.engine.stopwatch import current, timing
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import Tracker
from tofuse.engine.views import PreparedView

# Number of frames read and prepared in advance; each takes a multiple of its images' size.
_PREFETCHED_FRAMES = 4
# Opposite to gravity, in the world frame of ARKit's poses.
_ARKIT_UP = np.array([0.0, 1.0, 0.0])


class TrackedFrames(Protocol):
    """Stores the tracked frames of a job, or provides those of an interrupted one."""

    def tracker(self, tracker: Tracker) -> Tracker:
        """Return the tracker to use in place of another one."""
        ...

    def finish(self, tracker: Tracker, log: FrameLog) -> None:
        """Take the tracker from `tracker`, and the log of all frames, after tracking."""
        ...


def reconstruct(
    recording: Recording,
    config: Config | str = "default",
    *,
    seed: int = 0,
    threads: int | None = None,
    loops: Sequence[PriorLoop | Sequence[Any]] = (),
    progress: Progress | None = None,
    tracked_frames: TrackedFrames | None = None,
) -> Reconstruction:
    """Reconstruct a recording: trajectory, pose graph, fused cloud, diagnostics.

    Frames that can't be read are skipped and counted.

    Parameters
    ----------
    recording
        The recording, from `tofuse.open`.
    config
        A configuration or the name of one ("default", "thesis").
    seed
        The result is reproducible for each seed.
    threads
        Number of threads; None: all cores. The result does not depend on it.
    loops
        Given loops, in frame indices.
    progress
        Receives stages, frames and notes.
    tracked_frames
        Stores the tracked frames, or provides those of an interrupted job with the same recording,
        configuration and seed.

    Raises
    ------
    InputError
        If no frame can be read, or none has enough valid points for a pose; if a loop is of frames
        that don't exist; or if a filter can't learn from the recording.
    """
    progress = progress or Silent()
    loops = prior_loops(loops, set(recording.indices.tolist()))

    def reconstruct_with(config: Config, tracked_frames: TrackedFrames | None) -> Reconstruction:
        # BLAS results depend on its number of threads; those of our kernels don't.
        with threadpool_limits(1):
            mapper = _track(recording, config, seed, threads, loops, progress, tracked_frames)
            result = mapper.finish()
        return _with_facts(result, recording, config)

    with current().running():
        config = configured(config, view_kind(recording))
        config = adapted(config, recording, threads, progress)
        result = reconstruct_with(config, tracked_frames)
        if not config.self_calibration:
            return result
        return self_calibrated(result, config, lambda c: reconstruct_with(c, None), progress)


def reconstruct_with_views(
    recording: Recording, config: Config, *, threads: int | None = None, progress: Progress
) -> tuple[Reconstruction, Sequence[PosedView[PreparedView]]]:
    """Reconstruct a recording without surface and self-calibration; returns its views as well.

    The views are those that refinement works on: corrected, filtered, and spaced by motion.
    """
    config = adapted(config, recording, threads, progress)
    with threadpool_limits(1):
        mapper = _track(recording, config, 0, threads, (), progress, surface=False)
        result = mapper.finish()
    return _with_facts(result, recording, config), mapper.views


def _track(
    recording: Recording,
    config: Config,
    seed: int,
    threads: int | None,
    loops: Sequence[PriorLoop | Sequence[Any]],
    progress: Progress,
    tracked_frames: TrackedFrames | None = None,
    *,
    surface: bool = True,
) -> Mapper:
    """Push all frames to a new mapper."""
    progress.stage("tracking", len(recording))
    tracker = config.odometry.start(seed, config.search)
    if tracked_frames is not None:
        tracker = tracked_frames.tracker(tracker)
    mapper = Mapper(
        config,
        seed=seed,
        threads=threads,
        loops=loops,
        progress=progress,
        tracker=tracker,
        surface=surface,
        colors=ColorFrames(recording, CameraErrors.made_with(config.to_dict())),
    )
    with mapper.watch.running(), timing("reading"):
        unreadable = push_frames(mapper, recording, config.window)
    if len(unreadable) == len(recording):
        raise InputError(
            f"has {quantities.count(len(recording), 'frame')}, none of which can be read "
            f"(first: {unreadable[0]})",
            where=recording.path,
            remedy="check that the files are complete, or use --format",
        )
    if tracked_frames is not None:
        tracked_frames.finish(tracker, mapper.log)
    return mapper


def _with_facts(result: Reconstruction, recording: Recording, config: Config) -> Reconstruction:
    """Add facts about the recording, and the device's vertical if no sensor measured it."""
    result = with_recording_facts(result, recording_facts(recording))
    if result.up is None and config.priors:
        result = replace(result, up=device_up(recording, result))
    return result


def with_recording_facts(result: Reconstruction, recording: dict[str, Any]) -> Reconstruction:
    """Add facts about the recording to a result, and to those of its components."""
    components = tuple(
        c if c.result is None else replace(c, result=with_recording_facts(c.result, recording))
        for c in result.components
    )
    return replace(result, recording=recording, components=components)


def push_frames(mapper: Mapper, recording: Recording, window: int) -> list[str]:
    """Push the frames of a recording to the mapper; returns the errors of unreadable ones.

    Parameters
    ----------
    mapper, recording
        The mapper and the recording.
    window
        Number of frames that the filters use, the current one included.
    """
    odometry, gravity = recording.odometry, recording.gravity
    recent: dict[int, Frame] = {}
    unreadable = []
    if mapper.threads > 1:
        frames = recording.read_with(mapper.prepare, _PREFETCHED_FRAMES)
    else:
        frames = ((item, None) for item in recording.read_all(_PREFETCHED_FRAMES))
    for k in range(len(recording)):
        item, prepared = next(frames)
        index, time = int(recording.indices[k]), float(recording.timestamps[k])
        if k and part_start(recording, index) != part_start(
            recording, int(recording.indices[k - 1])
        ):
            mapper.interrupt()
        if isinstance(item, UnreadableFrameError):
            unreadable.append(str(item))
            mapper.skip(index, time, str(item))
            continue
        T = None if odometry is None or not np.isfinite(odometry[k]).all() else odometry[k]
        down = None if gravity is None or not np.isfinite(gravity[k]).all() else gravity[k]
        past = past_frames(recording, index, window - 1, recent)
        recent = {f.index: f for f in [*past, item]}
        mapper.push(item, T_odometry=T, gravity=down, history=past, prepared=prepared)
    return unreadable


def view_kind(recording: Recording) -> ViewKind:
    """Return the kind of the recording's views: that of the first one that can be read."""
    frame = recording.first_readable()
    return "range" if frame is None else kind_of(frame)


def past_frames(
    recording: Recording, index: int, count: int, cached: Mapping[int, Frame] = MappingProxyType({})
) -> list[Frame]:
    """Return readable frames just before a frame, oldest first.

    They are neighbours in the source, whether or not the recording's selection contains them, and
    belong to the same one of several joined recordings.

    Parameters
    ----------
    recording, index
        The recording, and the index of the frame.
    count
        Maximum number of frames.
    cached
        Frames in memory, by index: they are not read again.
    """
    first = part_start(recording, index)
    past = []
    for k in range(max(first, index - count), index):
        try:
            past.append(cached[k] if k in cached else recording.source.read(k))
        except UnreadableFrameError:
            continue
    return past


def part_start(recording: Recording, index: int) -> int:
    """Return the first frame index of the joined part that contains frame `index`."""
    parts = recording.metadata.get("parts", ())
    starts = accumulate((part["frames"] for part in parts), initial=0)
    return max(start for start in starts if start <= index)


def recording_facts(recording: Recording) -> dict[str, Any]:
    """Return facts about a recording as plain data, the `input` of `run.json`."""
    return {
        "path": recording.path,
        "format": recording.format,
        "frames": len(recording),
        "warnings": list(recording.warnings),
    }


def device_up(recording: Recording, result: Reconstruction) -> Float64 | None:
    """Return the upward unit vector (3,) in the result's world, from the poses of a phone.

    None if the recording has no such poses, or none for a frame with a pose in the result.
    """
    if recording.metadata.get(POSES_BY) != "ARKit" or recording.reference is None:
        return None
    rows = {record.index: k for k, record in enumerate(result.diagnostics.frames)}
    candidates = [
        result.trajectory[rows[index], :3, :3] @ T_device_camera[:3, :3].T @ _ARKIT_UP
        for index, T_device_camera in zip(
            recording.indices.tolist(), recording.reference, strict=True
        )
        if index in rows
    ]
    vectors = np.array(candidates, float).reshape(-1, 3)
    vectors = vectors[np.isfinite(vectors).all(1)]
    if not len(vectors):
        return None
    up: Float64 = np.median(vectors, axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 0.1 else None
