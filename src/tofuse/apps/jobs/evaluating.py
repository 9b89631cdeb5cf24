"""`tofuse evaluate`: compare a trajectory with a reference, and with the images at its poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.inspection import difference
from tofuse.apps.results import folders, run_json
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounds
from tofuse.engine.errors import InputError, signals_as_themselves
from tofuse.engine.frames import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.parts import check_number
from tofuse.engine.quality import map_agreement, trajectory_errors
from tofuse.engine.quantities import percent
from tofuse.engine.results import Reconstruction
from tofuse.engine.sensor import CameraErrors, Corrector
from tofuse.engine.times import MAX_GAP_S
from tofuse.formats.files import reading
from tofuse.formats.poses import Clock, TimedPoses, associated_poses, read_poses
from tofuse.formats.recordings import open_recording, read_reference

_MIN_INLIERS = 0.5  # most points of images of the same place agree; real ones by 80 % and more

Poses = str | Path | Float64 | Reconstruction | Recording


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Errors of a trajectory relative to a reference.

    Attributes
    ----------
    error
        Absolute and relative errors.
    ate_interval_m
        Bounds of the true ATE; None if the error of the reference is unknown.
    consistency
        Map consistency of the recording's images at these poses; None without a recording.
    notes
        What suggests that the two trajectories are not comparable as they were read: in sentences.
    """

    error: trajectory_errors.TrajectoryError
    ate_interval_m: tuple[float, float] | None = None
    consistency: map_agreement.Consistency | None = None
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as plain data, angles in degrees."""
        data: dict[str, Any] = self.error.to_dict()
        if self.ate_interval_m is not None:
            data["ate_interval_m"] = list(self.ate_interval_m)
        if self.consistency is not None:
            data["map_consistency"] = self.consistency.to_dict()
        data["notes"] = list(self.notes)
        return data

    def __repr__(self) -> str:
        e = self.error
        return (
            f"Evaluation: ATE {e.ate_rms_m:.4f} m, {np.degrees(e.rotation_rms_rad):.3f} deg rms "
            f"over {quantities.count(e.associated, 'pose')}"
        )


@signals_as_themselves()
def evaluate(
    estimate: Poses,
    reference: Poses,
    *,
    recording: Recording | str | Path | None = None,
    reference_error_m: float | None = None,
    config: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Compare a trajectory with a reference.

    Parameters
    ----------
    estimate, reference
        A file or folder of any supported format (a result, a recording with a reference), a
        result or a recording in memory, or (N, 4, 4) T_world_camera of the frames of the recording,
        NaN where there is none.
    recording
        Provides the timestamps of frames if the poses have none, and images whose map consistency
        is measured.
    reference_error_m
        Rms error of the reference, m.
    config
        Configuration of the result that the poses belong to: images are compared with its
        self-calibrated camera, if any. By default read from an estimate that is a result.

    Raises
    ------
    InputError
        If a file can't be read, or nothing can be associated.
    """
    if reference_error_m is not None:
        check_number(reference_error_m, Bounds(0), "reference_error_m")
    if recording is not None and not isinstance(recording, Recording):
        recording = open_recording(recording)
    names = [
        str(source) if isinstance(source, str | Path) else name
        for source, name in ((estimate, "estimate"), (reference, "reference"))
    ]
    of_estimate, _ = _result_of(estimate), _result_of(reference)
    (times, poses), (reference_times, reference_poses) = _associable(
        estimate, reference, recording, of_estimate, names
    )
    poses, reference_poses = _about_cloud(poses, reference_poses, estimate, of_estimate)
    frame_times = None if recording is None else recording.timestamps
    try:
        error = trajectory_errors.evaluate_trajectory(
            times, poses, reference_times, reference_poses, frame_times
        )
    except InputError as cause:
        raise InputError(cause.problem, where=", ".join(names), remedy=cause.remedy) from cause
    interval = None
    if reference_error_m is not None and error.associated > 1:
        interval = error.ate_within(reference_error_m)
    notes = []
    if error.mostly_unmatched:
        notes.append(
            f"only {error.associated} of {error.estimated} estimated poses have a reference pose "
            f"within {1000 * MAX_GAP_S:.0f} ms: check that both files have the same clock "
            f"({trajectory_errors.spans(times, reference_times)})"
        )
    if text := difference(poses[error.pairs[:, 0]], reference_poses[error.pairs[:, 1]]):
        notes.append(text)
    consistency = None
    if recording is not None:
        frame_poses = associated_poses(recording.timestamps, times, poses)
        correctors = _correctors(estimate, of_estimate, config)
        consistency = map_agreement.map_consistency(recording, frame_poses, correctors=correctors)
        if consistency.inlier_ratio < _MIN_INLIERS:
            notes.append(
                f"only {percent(consistency.inlier_ratio)} of the points of the images agree at "
                f"these poses: they are far off, or {recording.path} is another recording"
            )
    return Evaluation(error, interval, consistency, tuple(notes))


@dataclass(frozen=True)
class _Result:
    """The result that poses are read from: its folder, checked `run.json`, times of frames."""

    folder: Path
    run: dict[str, Any]
    clock: Clock


def _result_of(poses: Poses) -> _Result | None:
    """Return the result that poses are read from, whose files fit each other; None without one."""
    folder = None if not isinstance(poses, str | Path) else folders.result_of_poses(Path(poses))
    if folder is None:
        return None
    with run_json.opened(folder) as run:
        run_json.main_poses(folder, run)
        return _Result(folder, run, run_json.frame_clock(run))


def _correctors(
    estimate: Poses, result: _Result | None, config: Mapping[str, Any] | None
) -> tuple[Corrector, ...]:
    """Return the correctors of the result that the poses belong to; none without a result."""
    if config is not None:
        return CameraErrors.made_with(config)
    if isinstance(estimate, Reconstruction):
        return CameraErrors.made_with(estimate.config)
    if result is None:
        return ()
    with reading.damage_reported(result.folder / "run.json", "a run.json"):
        return CameraErrors.made_with(result.run["config"])


def _clock_of_recording(source: Poses) -> Clock | None:
    """Return the clock of the recording that poses are read from; None if they are of none."""
    if isinstance(source, str | Path):
        try:
            source = open_recording(source)
        except InputError:
            return None
    return (source.timestamps, source.indices) if isinstance(source, Recording) else None


def _poses(source: Poses, name: str, *, is_reference: bool = False) -> TimedPoses:
    if isinstance(source, str | Path):
        return read_reference(source) if is_reference else read_poses(source)
    if isinstance(source, Reconstruction):
        return TimedPoses(source.trajectory, timestamps=source.timestamps)
    if isinstance(source, Recording):
        if source.reference is None:
            remedy = "pass a recording with poses, or a file of them"
            raise InputError("has no reference poses", where=name, remedy=remedy)
        return TimedPoses(source.reference, timestamps=source.timestamps)
    poses = se3.check_poses(source, where=name)
    return TimedPoses(poses, frames=np.arange(len(poses)))


def _associable(
    estimate: Poses,
    reference: Poses,
    recording: Recording | None,
    of_estimate: _Result | None,
    names: Sequence[str],
) -> list[tuple[Float64, Float64]]:
    """Return times (N,) and poses (N, 4, 4) of the estimate and of the reference.

    Poses by frame have the times of the recording, or else those of the result or the recording
    that the poses are of.
    """
    timed = _poses(estimate, names[0]), _poses(reference, names[1], is_reference=True)
    by_frame = [poses.timestamps is None for poses in timed]
    clock = _clock(estimate, recording, of_estimate)
    if clock is None and sum(by_frame) == 1:
        clock = _clock_of_recording(reference if by_frame[0] else estimate)
        if clock is None:
            raise InputError(
                "has poses by frame, the other file by time",
                where=names[by_frame.index(True)],
                remedy="pass the recording, which has the times (--recording)",
            )
    are_arrays = isinstance(estimate, np.ndarray) and isinstance(reference, np.ndarray)
    if are_arrays and len(timed[0].poses) != len(timed[1].poses):
        raise InputError(
            f"hold {len(timed[0].poses)} and {len(timed[1].poses)} poses",
            where=", ".join(names),
            remedy="pass poses of the same frames, NaN where there is none",
        )
    sources = estimate, reference
    return [_timed(t, s, clock, name) for t, s, name in zip(timed, sources, names, strict=True)]


def _clock(
    estimate: Poses, recording: Recording | None, of_estimate: _Result | None
) -> Clock | None:
    """Return the times of frames, of the recording if it is given."""
    if recording is not None:
        return recording.timestamps, recording.indices
    if isinstance(estimate, Reconstruction):
        indices = np.array([frame.index for frame in estimate.diagnostics.frames], np.intp)
        return estimate.timestamps, indices
    is_result = of_estimate is not None and of_estimate.folder == Path(str(estimate))
    return of_estimate.clock if of_estimate is not None and is_result else None


def _about_cloud(
    poses: Float64, reference: Float64, estimate: Poses, of_estimate: _Result | None
) -> tuple[Float64, Float64]:
    """Return both poses about the cloud of the result: rotations have long lever arms at the origin
    of map coordinates."""
    if isinstance(estimate, Reconstruction):  # which is so already
        return poses, se3.about(-estimate.shift, reference)
    if of_estimate is None:
        return poses, reference
    shift = run_json.shift_of(of_estimate.run, of_estimate.folder / "run.json")
    return se3.about(-shift, poses), se3.about(-shift, reference)


def _timed(
    timed: TimedPoses, source: Poses, clock: Clock | None, name: str
) -> tuple[Float64, Float64]:
    """Return times (N,) and poses (N, 4, 4); those of an array are of the recording's frames."""
    if isinstance(source, str | Path | Reconstruction | Recording) or clock is None:
        return timed.timed(clock, name)
    if len(timed.poses) != len(clock[0]):
        raise InputError(
            f"holds {quantities.count(len(timed.poses), 'pose')}, and the recording "
            f"{quantities.count(len(clock[0]), 'frame')}",
            where=name,
            remedy="pass one for each frame, NaN where there is none",
        )
    return clock[0], timed.poses
