"""From a recording to a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.arrays import Float32, Float64
from tofuse.corrections.noise import Noise
from tofuse.errors import InputError, UnreadableFrameError
from tofuse.files.ply import read_ply
from tofuse.filters.confidence import Confidence
from tofuse.geometry import se3
from tofuse.pipeline.checkpoint import NotKept, Stages
from tofuse.pipeline.config import Config, ViewKind, from_method, kind_of
from tofuse.pipeline.learn import learnt
from tofuse.pipeline.mapper import Mapper
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.self_calibration import self_calibrated
from tofuse.pipeline.state_checks import check_tracked
from tofuse.posegraph.loops import GivenLoop
from tofuse.recordings.frames import Frame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.phones import ARKIT_UP, POSES_BY
from tofuse.recordings.recording import Recording
from tofuse.results.types import Reconstruction
from tofuse.sensor.noise import NOISE, NoiseModel

_TRACKING = "tracking"
# So many frames are read and prepared in advance; each takes some of its images' size.
_AHEAD = 6


def reconstruct(
    recording: Recording,
    config: Config | str = "default",
    *,
    seed: int = 0,
    threads: int | None = None,
    loops: Sequence[GivenLoop] = (),
    progress: Progress | None = None,
    stages: Stages | None = None,
) -> Reconstruction:
    """Reconstruct a recording: trajectory, pose graph, fused cloud, diagnostics.

    Frames that can't be read are skipped and counted.

    Parameters
    ----------
    recording
        What `tofuse.open` gives.
    config
        A configuration or the name of one ("default", "thesis").
    seed
        One seed, one result.
    threads
        How many threads to use; None: all cores. The result does not depend on it.
    loops
        Loops known beforehand, in frame indices.
    stages
        Keeps what there is after each stage, and knows what a stopped job had: of the same
        recording, configuration and seed.

    Raises
    ------
    InputError
        If no frame can be read, or none has enough valid points for a pose; or if a filter can't
        learn what it has to.
    """
    progress = progress or Silent()
    config = from_method(config, view_kind(recording)) if isinstance(config, str) else config
    config = learnt(fitted(config, recording), recording, threads, progress)

    def once(by: Config, stages: Stages) -> Reconstruction:
        return _once(recording, by, seed, threads, loops, progress, stages)

    result = once(config, stages or NotKept())
    if not config.self_calibration:
        return result
    return self_calibrated(result, config, lambda by: once(by, NotKept()), progress)


def _once(
    recording: Recording,
    config: Config,
    seed: int,
    threads: int | None,
    loops: Sequence[GivenLoop],
    progress: Progress,
    stages: Stages,
) -> Reconstruction:
    """Reconstruct a recording; see `reconstruct`."""
    progress.stage("tracking", len(recording))
    # BLAS sums differ with its number of threads; ours don't.
    with threadpool_limits(1):
        tracked = stages.load(_TRACKING)
        if tracked is None:
            tracked = Tracked(Mapper(config, seed=seed, threads=threads, loops=loops))
        else:
            check_tracked(tracked, recording)
        if tracked.done:
            progress.note(f"goes on after frame {tracked.done} of a run that was stopped")
        tracked.mapper.go_on(threads, progress)
        if tracked.done < len(recording):
            push_frames(tracked, recording, config.window, stages)
            tracked.mapper.end()
            _save(tracked, stages)
        if len(tracked.unreadable) == len(recording):
            raise InputError(
                f"none of the {len(recording)} frames can be read (first: {tracked.unreadable[0]})",
                where=recording.path,
                remedy="check that the files are complete, or give --format",
            )
        result = tracked.mapper.finish(stages)
    result = described(result, describe(recording))
    if result.up is None and config.outside:
        result = replace(result, up=device_up(recording, result))
    return result


def described(result: Reconstruction, recording: dict[str, Any]) -> Reconstruction:
    """Say what a result, and those of its components, were made of."""
    components = tuple(
        c if c.result is None else replace(c, result=described(c.result, recording))
        for c in result.components
    )
    return replace(result, recording=recording, components=components)


@dataclass(eq=False)
class Tracked:
    """How far tracking has come: the mapper, how many frames it saw, and why some can't be read."""

    mapper: Mapper
    done: int = 0
    unreadable: list[str] = field(default_factory=list)


def push_frames(tracked: Tracked, recording: Recording, window: int, stages: Stages) -> None:
    """Give the mapper the frames of a recording that it has not seen.

    Parameters
    ----------
    window
        How many frames the filters look at, the current one included.
    stages
        Is offered what there is, whenever it is due.
    """
    mapper, odometry, gravity = tracked.mapper, recording.odometry, recording.gravity
    recent: dict[int, Frame] = {}
    first = tracked.done
    if mapper.threads > 1:
        frames = recording.read_with(mapper.prepare, _AHEAD, first=first)
    else:
        frames = ((item, None) for item in recording.read_all(_AHEAD, first=first))
    for k in range(first, len(recording)):
        with mapper.watch.timing("reading"):
            item, prepared = next(frames)
        index, time = int(recording.indices[k]), float(recording.timestamps[k])
        if k and part_start(recording, index) != part_start(
            recording, int(recording.indices[k - 1])
        ):
            mapper.interrupt()
        if isinstance(item, UnreadableFrameError):
            tracked.unreadable.append(str(item))
            mapper.skip(index, time, str(item))
        else:
            T = None if odometry is None or not np.isfinite(odometry[k]).all() else odometry[k]
            down = None if gravity is None or not np.isfinite(gravity[k]).all() else gravity[k]
            past = past_frames(recording, index, window - 1, recent)
            recent = {f.index: f for f in [*past, item]}
            mapper.push(item, T_odometry=T, gravity=down, history=past, prepared=prepared)
        tracked.done = k + 1
        if tracked.done < len(recording) and stages.due():
            _save(tracked, stages)


def _save(tracked: Tracked, stages: Stages) -> None:
    with tracked.mapper.watch.timing("keeping"):
        stages.save(_TRACKING, tracked)


def fitted(config: Config, recording: Recording) -> Config:
    """Return the configuration with what it leaves to the recording filled in.

    Levels of confidence are put on the recording's own scale, and its noise model is chosen.

    Raises
    ------
    InputError
        If the recording has a noise.json that makes no sense.
    """
    corrections = tuple(
        replace(c, model=_known_noise(recording)) if isinstance(c, Noise) and not c.model else c
        for c in config.corrections
    )
    config = replace(config, corrections=corrections)
    highest = recording.metadata.get("confidence_max")
    if not isinstance(highest, int | float) or not 1 <= highest <= 255:
        return config
    scaled = (
        tuple(f.on_scale(round(highest)) if isinstance(f, Confidence) else f for f in filters)
        for filters in (config.filters, config.model_filters)
    )
    filters, model_filters = scaled
    return replace(config, filters=filters, model_filters=model_filters)


def _known_noise(recording: Recording) -> NoiseModel | None:
    """Noise that the recording states, or its camera's family is known for."""
    model = noise_model_for(recording)
    return None if model == NOISE["unknown"] else model


def view_kind(recording: Recording) -> ViewKind:
    """Return the kind of the recording's views: that of the first one that can be read."""
    frame = recording.first_readable()
    return "range" if frame is None else kind_of(frame)


def past_frames(
    recording: Recording, index: int, count: int, known: Mapping[int, Frame] = MappingProxyType({})
) -> list[Frame]:
    """Return the `count` readable frames of the source just before frame `index`, oldest first.

    They are the recording's own neighbours, whatever was selected of it, and of several joined
    recordings those of the same one; `known` are frames that need not be read again.
    """
    first = part_start(recording, index)
    past = []
    for k in range(max(first, index - count), index):
        try:
            past.append(known[k] if k in known else recording.source.read(k))
        except UnreadableFrameError:
            continue
    return past


def part_start(recording: Recording, index: int) -> int:
    """Return the first frame of the recording, of several joined ones, that frame `index` is of."""
    joined = recording.metadata.get("parts", ())
    starts = accumulate((part["frames"] for part in joined), initial=0)
    return max(start for start in starts if start <= index)


def describe(recording: Recording) -> dict[str, Any]:
    """Return plain facts about a recording, the `input` of `run.json`."""
    return {
        "path": recording.path,
        "format": recording.format,
        "frames": len(recording),
        "warnings": list(recording.warnings),
    }


def device_up(recording: Recording, result: Reconstruction) -> Float64 | None:
    """Return the unit vector (3,) against gravity in the result's world, as a phone's poses say.

    None where the poses of the recording come from no such device, or share no frame with these.
    """
    if recording.metadata.get(POSES_BY) != "ARKit" or recording.reference is None:
        return None
    rows = {record.index: k for k, record in enumerate(result.diagnostics.frames)}
    ups = [
        result.trajectory[rows[index], :3, :3] @ T_device_camera[:3, :3].T @ ARKIT_UP
        for index, T_device_camera in zip(
            recording.indices.tolist(), recording.reference, strict=True
        )
        if index in rows
    ]
    known = np.array(ups, float).reshape(-1, 3)
    known = known[np.isfinite(known).all(1)]
    if not len(known):
        return None
    up: Float64 = np.median(known, axis=0)
    length = float(np.linalg.norm(up))
    return up / length if length > 0.1 else None


def reference_in_world(recording: Recording, result: Reconstruction) -> Float64 | None:
    """Return the reference poses (N, 4, 4) in the result's world, NaN where there is none.

    The world is the first frame with a pose; where that has no reference, the first frame with
    both decides.
    """
    reference = recording.reference
    if reference is None:
        return None
    both = np.flatnonzero(np.isfinite(reference[:, 0, 0]) & result.has_pose)
    if len(both) == 0:
        return None
    k = both[0]
    T_world_reference = result.trajectory[k] @ se3.inverse(reference[k])
    return np.where(np.isfinite(reference), T_world_reference @ reference, np.nan)


def truth_points(recording: Recording, count: int = 100_000) -> Float32 | None:
    """Return points (K, 3) on the true surfaces of a simulated recording, in its world frame."""
    path = Path(recording.path) / "truth" / "surface.ply"
    if not path.is_file():
        return None
    truth = read_ply(path)
    if truth.faces is None or len(truth.faces) == 0:
        return truth.points.astype(np.float32)
    corners = truth.points[truth.faces].astype(float)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    rng = np.random.default_rng(0)
    chosen = corners[rng.choice(len(corners), count, p=area / area.sum())]
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    points = chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0])
    return points.astype(np.float32)
