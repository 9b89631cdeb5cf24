"""Reconstruction with a rig: one model, and one rig pose for each instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.jobs import Options, resolve
from tofuse.apps.results import folders, write_result
from tofuse.apps.rigs.calibrating import moves
from tofuse.apps.rigs.checking import CameraMotion, compare
from tofuse.apps.rigs.inputs import Camera, disagreement_rows, open_cameras
from tofuse.apps.rigs.joint import RigView, SurfaceDistances, disagreements, refine_together
from tofuse.apps.rigs.rig_trajectory import RigTrajectory, track_rig
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.compute import threads as using_threads
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.fusion import Textured
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured
from tofuse.engine.loops import Nearby
from tofuse.engine.mapping import Config, adaptation, reconstructing
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.quality import pose_accuracy
from tofuse.engine.refinement import AlreadyRefined, NoRefinement
from tofuse.engine.results import Reason, Reconstruction, verdicts
from tofuse.engine.stored_views import SampledView
from tofuse.engine.tracking import given
from tofuse.formats.poses import write_tum
from tofuse.formats.recordings import Opening, unzipped
from tofuse.formats.rigs import FILE_NAME, Rig, RigSource, read_rig, recordings_of

# No loops are searched: poses of the rig are final.
_NO_LOOPS = Nearby(min_gap=1_000_000)
TRAJECTORY = "rig_trajectory.txt"
# Reason codes that apply only to single-camera tracking.
_TRACKING_REASONS = frozenset({"jumped", "weak_registration", "not_converged", "repeated_images"})
# Minimum variances of a camera's pose, m^2 and rad^2: 0.1 mm and 0.005 degrees.
_MIN_VARIANCES = np.array([1e-4**2] * 3 + [np.radians(0.005) ** 2] * 3)
# Number of points of a view when the calibration is checked.
_POINTS = 6000


@dataclass(frozen=True, eq=False)
class RigResult:
    """Reconstruction of a rig's recordings.

    Attributes
    ----------
    result
        The model of all cameras; its frames are ordered by instant, then by camera.
    times, poses
        (N,) times of the instants in s, and (N, 4, 4) T_world_rig; NaN where no camera has a pose.
    rig
        The rig, with the distances between the surfaces measured by its cameras in these images.
    """

    result: Reconstruction
    times: Float64
    poses: Float64
    rig: Rig


def run_rig(
    rig_file: Path | None, inputs: Sequence[str | Path], options: Options, *, progress: Progress
) -> RigResult:
    """Reconstruct the recordings of a rig's cameras, and write the output folder.

    Without a `rig_file` the only input is a folder with one, beside the recordings.

    Raises
    ------
    InputError
        If the rig or a recording can't be used.
    OutputError
        If the result can't be written.
    """
    opening = Opening(
        tuple(map(Path, inputs)), rig_file, format=options.format, topic=options.topic
    )
    if rig_file is None:
        rig_file = unzipped(inputs[0]) / FILE_NAME
        inputs = list(recordings_of(rig_file).values())
    with using_threads(options.threads), threadpool_limits(1):
        progress.stage("opening")
        rig = read_rig(rig_file)
        rig.check_count(len(inputs), rig_file)
        names = [camera.name for camera in rig.cameras]
        cameras = open_cameras(inputs, options.format, names, options.topic)
        source = RigSource(rig, [camera.recording for camera in cameras])
        full_recording = Recording.of(source, " ".join(map(str, opening.paths)), "rig")
        recording = _selected(full_recording, source, options)
        config = resolve(options)
        with folders.OutputFolder(options.out, overwrite=options.overwrite) as folder:
            result = reconstruct_rig(
                cameras, recording, config, seed=options.seed or 0, progress=progress
            )
            described = {**result.result.recording, "opening": opening.to_dict()}
            result = replace(result, result=replace(result.result, recording=described))
            texture = options.make_texture(
                recording, result.result, config, options.threads, progress
            )
            progress.stage("writing")
            _write(result, folder, texture, share=options.share)
    return result


def _selected(full_recording: Recording, source: RigSource, options: Options) -> Recording:
    """Return the recording of the instants that the options select."""
    count = int(source.instant[-1]) + 1
    chosen = np.arange(count)[slice(options.start, options.end, options.every)]
    if not len(chosen):
        raise InputError(
            f"has {count} instants, of which the selection leaves none",
            where="the rig",
            remedy="change --start, --end or --every",
        )
    return replace(full_recording, indices=np.flatnonzero(np.isin(source.instant, chosen)))


def reconstruct_rig(
    cameras: Sequence[Camera],
    recording: Recording,
    config: Config,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> RigResult:
    """Estimate a rig pose for each instant, and fuse the images of all cameras.

    Parameters
    ----------
    cameras
        The opened cameras of the rig, in its order.
    recording
        Of a `RigSource`.
    config, seed
        As in `reconstruct`.
    """
    progress = progress or Silent()
    source = RigSource.of(recording)
    rig = source.rig
    instants, first = np.unique(source.instant[recording.indices], return_index=True)
    displaced: list[CameraMotion] = []
    if moves(cameras, "auto"):
        trajectory = track_rig(cameras, recording, progress)
    else:
        poses = np.tile(np.eye(4), (len(instants), 1, 1))
        displaced, distances = _check_calibration(cameras, recording)
        trajectory = RigTrajectory(poses, source.T_rig_camera[recording.indices], distances, ())
    instant = np.searchsorted(instants, source.instant[recording.indices])
    frame_poses = trajectory.poses[instant] @ trajectory.T_rig_frame
    is_moving = bool(trajectory.measured or trajectory.tracked)
    edges = _calibration_edges(recording, instant, frame_poses, follow=not is_moving)
    refined = AlreadyRefined(trajectory.measured, (*trajectory.tracked, *edges))
    fusion_config = replace(
        config,
        odometry=given.GivenPoses(),
        loops=_NO_LOOPS,
        refinement=NoRefinement(),
        priors=(),
        self_calibration=False,
    )
    result = reconstructing.reconstruct(
        adaptation.with_odometry(recording, frame_poses),
        replace(fusion_config, refinement=refined),
        seed=seed,
        progress=progress,
    )
    names = [camera.name for camera in rig.cameras]
    rig_fields = {"cameras": names, "of_frames": source.camera[recording.indices].tolist()}
    result = replace(
        _with_reasons_of_rig(result, names, source.camera, displaced, moves=is_moving),
        config=fusion_config.to_dict(),
        recording={**result.recording, "rig": rig_fields},
    )
    measured_rig = replace(rig, disagreement=disagreement_rows(names, trajectory.disagreement))
    return RigResult(result, recording.timestamps[first], trajectory.poses, measured_rig)


def _calibration_edges(
    recording: Recording, instant: Intp, T_world_frame: Float64, *, follow: bool
) -> list[Measured]:
    """Return edges from the first camera's frame of each instant to the others, with information.

    Calibration errors are the same at all instants: if the rig is static (`follow`), later frames
    are tied to the first frame of their camera.
    """
    source = RigSource.of(recording)
    # The bound on the errors is enlarged for systematic ones, which these covariances include.
    covariances = [
        c.covariance / pose_accuracy.COVARIANCE_FACTOR + np.diag(_MIN_VARIANCES)
        for c in source.rig.cameras
    ]
    covariances[0] = np.diag(_MIN_VARIANCES)
    posed = np.flatnonzero(np.isfinite(T_world_frame[:, 0, 0]))
    cameras = source.camera[recording.indices]
    edges: list[Measured] = []
    first: dict[int, int] = {}  # frame of each instant, or if static of all instants
    first_of_camera: dict[int, int] = {}
    for k in map(int, posed):
        c = int(cameras[k])
        C, i = covariances[c], first.setdefault(0 if follow else int(instant[k]), k)
        if follow and c in first_of_camera:
            C, i = np.diag(_MIN_VARIANCES), first_of_camera[c]
        first_of_camera.setdefault(c, k)
        if i != k:
            T = se3.inverse(T_world_frame[i]) @ T_world_frame[k]
            ends = int(recording.indices[i]), int(recording.indices[k])
            edges.append(Measured(*ends, T, np.asarray(np.linalg.inv(C), np.float64)))
    return edges


def _with_reasons_of_rig(
    result: Reconstruction,
    names: Sequence[str],
    cameras: Intp,
    displaced: Sequence[CameraMotion],
    *,
    moves: bool,
) -> Reconstruction:
    """Return the result with reasons for a rig instead of a single camera.

    `cameras` (F,) are the cameras of all frames, as indices into `names`; `displaced` those that
    differ from the calibration, or can't be compared with it.
    """
    d = result.diagnostics
    reasons = [r for r in d.reasons if r.code not in _TRACKING_REASONS]
    worst = d.accuracy.worst
    if not moves and worst is not None:
        name = names[cameras[worst.frame]]
        reasons = [_calibration_reason(r, worst.frame, name) for r in reasons]
    whole = ((d.frames[0].index, d.frames[-1].index),)
    unrelated = ", ".join(m.name for m in displaced if not m.moved)
    if unrelated and all(reason.code != "uncertain_rig" for reason in reasons):
        text = f"No surface is seen by {unrelated} and another camera: their poses are unchecked."
        reasons.append(Reason("uncertain_rig", whole, text))
    changes = ", ".join(
        f"{m.name} by {1000 * m.distance_m:.0f} mm and {np.degrees(m.angle_rad):.1f} degrees"
        for m in displaced
        if m.moved
    )
    if changes:
        text = f"Camera poses differ from those of the rig: {changes}."
        reasons.append(Reason("rig_changed", whole, text))
    ranked = verdicts.ranked(reasons)
    d = replace(d, reasons=ranked, verdict=verdicts.verdict_of(ranked))
    return replace(result, diagnostics=replace(d, refinement=None, cloud_before=None))


def _calibration_reason(reason: Reason, worst: int, name: str) -> Reason:
    """Return the reason, attributing uncertain poses of static cameras to the calibration.

    `worst` is the frame with the largest uncertainty, and `name` its camera.
    """
    if reason.code != "uncertain_poses":
        return reason
    text = (
        reason.text.replace(f"Frame {worst} is", f"Camera {name!r} is")
        + " The bound follows from the covariances in rig.json, which include systematic errors "
        "such as multipath."
    )
    return replace(reason, code="uncertain_rig", text=text, remedy="")


def _check_calibration(
    cameras: Sequence[Camera], recording: Recording
) -> tuple[list[CameraMotion], SurfaceDistances]:
    """Return the cameras that differ from the calibration, or see nothing that others see.

    Also the distances between the surfaces of each pair at the calibrated poses, see `JointPoses`.
    """
    source = RigSource.of(recording)
    first = np.flatnonzero(source.instant == source.instant[recording.indices[0]])
    views = []
    for index in first:
        frame = source.read(int(index))
        if isinstance(frame, RangeFrame):
            c = int(source.camera[index])
            views.append(RigView(c, 0, SampledView.of(cameras[c].surface(frame), _POINTS)))
    rig = source.rig
    calibrated = np.stack([camera.T_rig_camera for camera in rig.cameras])
    refined = refine_together(views, calibrated)
    recalibrated = tuple(
        replace(camera, T_rig_camera=T, covariance=C[:6, :6])
        for camera, T, C in zip(rig.cameras, refined.poses, refined.covariance, strict=True)
    )
    displaced = [
        motion for motion in compare(rig, Rig(recalibrated)) if motion.moved or motion.reason
    ]
    return displaced, disagreements(views, calibrated)


def _write(
    rig_result: RigResult,
    folder: folders.OutputFolder,
    texture: Textured | None,
    *,
    share: bool,
) -> None:
    from tofuse.apps.report import ReportExtras, write_report

    def report(result: Reconstruction, target: Path) -> None:
        cameras = ", ".join(camera.name for camera in rig_result.rig.cameras)
        is_main = result is rig_result.result
        extras = ReportExtras(
            f"rig of {cameras}",
            rig=rig_result.rig,
            texture=texture if is_main else None,
            share=share and is_main,
        )
        write_report(result, target / "report.html", extras)
        if is_main:
            posed = np.isfinite(rig_result.poses[:, 0, 0])
            write_tum(target / TRAJECTORY, rig_result.times[posed], rig_result.poses[posed])

    write_result(rig_result.result, folder, report, texture, share)
