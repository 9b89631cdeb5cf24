"""One model, and one pose for each instant, from all cameras of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from tofuse.errors import InputError
from tofuse.files.trajectory import write_tum
from tofuse.geometry import se3
from tofuse.kernels.threads import threads as using_threads
from tofuse.odometry.given import GivenPoses
from tofuse.pipeline.config import Config
from tofuse.pipeline.priors import with_odometry
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.reconstruct import reconstruct
from tofuse.pipeline.run import Options, resolve
from tofuse.posegraph.nearby import Nearby
from tofuse.posegraph.refinement import NoRefinement
from tofuse.posegraph.views import KeptView
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.recordings.rig import Rig, read_rig
from tofuse.recordings.rig_source import RigSource
from tofuse.results.folder import OutputFolder
from tofuse.results.output import write_result
from tofuse.results.types import Reason, Reconstruction
from tofuse.results.verdict import ranked, verdict_of
from tofuse.rigs.calibrate import Motion, cameras_of, moves
from tofuse.rigs.check import Moved, compare
from tofuse.rigs.hand_eye import Track
from tofuse.rigs.inputs import Camera
from tofuse.rigs.joint import View, refine_together

Float64 = NDArray[np.float64]

# No place is looked for again: poses of the rig are final.
_NO_LOOPS = Nearby(min_gap=1_000_000)
TRAJECTORY = "rig_trajectory.txt"
# Of a view that tells whether its camera is where the rig says.
_POINTS = 6000


@dataclass(frozen=True, eq=False)
class RigResult:
    """What a rig recorded.

    Attributes
    ----------
    result
        The model of all cameras; its frames are instant by instant, camera by camera.
    times, poses
        (N,) of the instants, and (N, 4, 4) T_world_rig; NaN where no camera has a pose.
    """

    result: Reconstruction
    times: Float64
    poses: Float64


def run_rig(
    rig_file: Path,
    inputs: Sequence[str | Path],
    options: Options,
    *,
    motion: Motion = "auto",
    progress: Progress | None = None,
) -> RigResult:
    """Reconstruct what the cameras of a rig recorded, and write the output folder.

    Raises
    ------
    InputError, OutputError
        If nothing could be written.
    """
    progress = progress or Silent()
    rig = read_rig(rig_file)
    with using_threads(options.threads), threadpool_limits(1):
        progress.stage("opening")
        cameras = cameras_of(rig, inputs, options.format)
        source = RigSource(rig, [camera.recording for camera in cameras])
        whole = Recording.of(source, " ".join(map(str, inputs)), "rig")
        recording = _selected(whole, source, options)
        config = resolve(options)
        with OutputFolder(options.out, overwrite=options.overwrite) as folder:
            found = reconstruct_rig(
                rig, cameras, recording, config, motion=motion, seed=options.seed or 0,
                progress=progress,
            )  # fmt: skip
            progress.stage("writing")
            _write(found, recording, folder)
    return found


def _selected(whole: Recording, source: RigSource, options: Options) -> Recording:
    """The instants that the options select."""
    count = int(source.instant[-1]) + 1
    chosen = np.arange(count)[slice(options.start, options.end, options.every)]
    if not len(chosen):
        raise InputError(
            f"instants {options.start} to {options.end} of {count} select nothing",
            where="the rig",
            remedy="change --start, --end or --every",
        )
    return replace(whole, indices=np.flatnonzero(np.isin(source.instant, chosen)))


def reconstruct_rig(
    rig: Rig,
    cameras: Sequence[Camera],
    recording: Recording,
    config: Config,
    *,
    motion: Motion = "auto",
    seed: int = 0,
    progress: Progress | None = None,
) -> RigResult:
    """Give each instant a pose, and fuse the images of all cameras.

    Parameters
    ----------
    recording
        Of a `RigSource`.
    """
    progress = progress or Silent()
    source = recording.source
    assert isinstance(source, RigSource)
    instants, first = np.unique(source.instant[recording.indices], return_index=True)
    times = recording.timestamps[first]
    poses = np.tile(np.eye(4), (len(instants), 1, 1))
    knocked: list[Moved] = []
    if moves(cameras, motion):
        poses = _walked(rig, cameras, times, progress)
    else:
        knocked = _knocked(rig, cameras, recording)
    at = np.searchsorted(instants, source.instant[recording.indices])
    of_frames = poses[at] @ source.T_rig_camera[recording.indices]
    given = replace(
        config,
        odometry=GivenPoses(),
        loops=_NO_LOOPS,
        refinement=NoRefinement(),
        outside=(),
        self_calibration=False,
    )
    result = reconstruct(with_odometry(recording, of_frames), given, seed=seed, progress=progress)
    told = {
        "cameras": [camera.name for camera in rig.cameras],
        "of_frames": source.camera[recording.indices].tolist(),
    }
    result = replace(result, recording={**result.recording, "rig": told})
    return RigResult(_marked(result, knocked), times, poses)


def _knocked(rig: Rig, cameras: Sequence[Camera], recording: Recording) -> list[Moved]:
    """Cameras that are not where the rig says, as far as their views can be aligned from there."""
    source = recording.source
    assert isinstance(source, RigSource)
    first = np.flatnonzero(source.instant == source.instant[recording.indices[0]])
    views = []
    for index in first:
        frame = source.read(int(index))
        if isinstance(frame, RangeFrame):
            c = int(source.camera[index])
            views.append(View(c, 0, KeptView.of(cameras[c].surface(frame), _POINTS)))
    stated = np.stack([camera.T_rig_camera for camera in rig.cameras])
    placed = refine_together(views, stated)
    found = tuple(
        replace(camera, T_rig_camera=T, covariance=C[:6, :6])
        for camera, T, C in zip(rig.cameras, placed.poses, placed.covariance, strict=True)
    )
    return [moved for moved in compare(rig, Rig(found)) if moved.moved]


def _marked(result: Reconstruction, knocked: Sequence[Moved]) -> Reconstruction:
    """The result with what the images say against the rig."""
    if not knocked:
        return result
    d = result.diagnostics
    said = ", ".join(
        f"{m.name} by {1000 * m.distance_m:.0f} mm and {np.degrees(m.angle_rad):.1f} degrees"
        for m in knocked
    )
    text = f"Cameras are not where the rig says: {said}."
    everything = ((d.frames[0].index, d.frames[-1].index),)
    reasons = ranked((*d.reasons, Reason("rig_changed", everything, text)))
    verdict = verdict_of(reasons)
    return replace(result, diagnostics=replace(d, reasons=reasons, verdict=verdict))


def _walked(rig: Rig, cameras: Sequence[Camera], times: Float64, progress: Progress) -> Float64:
    """T_world_rig (N, 4, 4) at some times, from what all cameras say of how the rig moved.

    Each camera is tracked by itself. The rig's pose is the mean of what they say, once the world
    of each is brought to that of the first.
    """
    said: list[Float64] = []
    for stated, camera in zip(rig.cameras, cameras, strict=True):
        progress.stage(f"tracking {camera.name}")
        result = reconstruct(camera.recording, progress=Silent())
        track = Track.of(result.timestamps + stated.time_offset_s, result.trajectory)
        if len(track.times) < 2:
            progress.note(f"{camera.name} has no trajectory")
            continue
        T, known = track.at(times)
        T = T @ se3.inverse(stated.T_rig_camera)
        said.append(np.where(known[:, None, None], T, np.nan))
    if not said:
        raise InputError("no camera has a trajectory", where="the rig")
    stacked = [said[0]]
    for other in said[1:]:
        both = np.isfinite(said[0][:, 0, 0]) & np.isfinite(other[:, 0, 0])
        if both.any():
            stacked.append(_middle(said[0][both] @ se3.inverse(other[both])) @ other)
    mean = _means(stacked)
    rows = np.flatnonzero(np.isfinite(mean[:, 0, 0]))
    return np.asarray(se3.inverse(mean[rows[0]]) @ mean, np.float64) if len(rows) else mean


def _middle(poses: Float64) -> Float64:
    """Mean of poses that are near each other, by medians."""
    middle = poses[len(poses) // 2]
    for _ in range(10):
        middle = middle @ se3.exp(np.median(se3.log(se3.inverse(middle) @ poses), axis=0))
    return np.asarray(se3.orthonormalise(middle), np.float64)


def _means(said: Sequence[Float64]) -> Float64:
    """(N, 4, 4) mean over cameras of the poses of each instant; NaN where there is none."""
    out = np.full_like(said[0], np.nan)
    for k in range(len(out)):
        known = [T[k] for T in said if np.isfinite(T[k, 0, 0])]
        if known:
            away = [se3.log(se3.inverse(known[0]) @ T) for T in known]
            out[k] = known[0] @ se3.exp(np.mean(away, axis=0))
    return out


def _write(found: RigResult, recording: Recording, folder: OutputFolder) -> None:
    from tofuse.report.extras import ReportExtras
    from tofuse.report.html import write_report
    from tofuse.report.pictures import draw
    from tofuse.viewer.kept import NAME, write_kept

    def report(result: Reconstruction, here: Path) -> None:
        pictures = draw(result.diagnostics.samples)
        source = recording.source
        assert isinstance(source, RigSource)
        cameras = ", ".join(camera.name for camera in source.rig.cameras)
        extras = ReportExtras(title=f"rig of {cameras}", pictures=pictures)
        write_report(result, here / "report.html", extras)
        write_kept(result, pictures, here / NAME)
        if result is found.result:
            known = np.isfinite(found.poses[:, 0, 0])
            write_tum(here / TRAJECTORY, found.times[known], found.poses[known])

    write_result(found.result, folder, report)
