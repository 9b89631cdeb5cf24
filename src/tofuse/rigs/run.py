"""Reconstruction with a rig: one model, and one rig pose for each instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.arrays import Float64, Intp
from tofuse.errors import InputError
from tofuse.files.trajectory import write_tum
from tofuse.geometry import se3
from tofuse.kernels.threads import threads as using_threads
from tofuse.odometry.given import GivenPoses
from tofuse.pipeline.config import Config
from tofuse.pipeline.priors import with_odometry
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.reconstruct import reconstruct
from tofuse.pipeline.run_options import Options, resolve
from tofuse.posegraph.accuracy import UNOBSERVED_ERROR_FACTOR
from tofuse.posegraph.build import Measured
from tofuse.posegraph.nearby import Nearby
from tofuse.posegraph.refinement import AlreadyRefined, NoRefinement
from tofuse.posegraph.view_store import SampledView
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.recordings.rig import Disagreement, Rig
from tofuse.recordings.rig_folder import recordings_of, rig_from
from tofuse.recordings.rig_source import RigSource
from tofuse.results.folder import OutputFolder
from tofuse.results.output import write_result
from tofuse.results.types import Reason, Reconstruction
from tofuse.results.verdict import ranked, verdict_of
from tofuse.rigs.calibrate import Motion, cameras_of, moves
from tofuse.rigs.check import CameraMotion, compare
from tofuse.rigs.inputs import Camera
from tofuse.rigs.joint import View, disagreements, refine_together
from tofuse.rigs.rig_trajectory import track_rig

# No loops are searched: poses of the rig are final.
_NO_LOOPS = Nearby(min_gap=1_000_000)
TRAJECTORY = "rig_trajectory.txt"
# Reason codes that concern only the tracking of a single camera.
_OF_TRACKING = frozenset({"jumped", "weak_registration", "not_converged", "repeated_images"})
# Minimum variances of a camera's pose, m^2 and rad^2: 0.1 mm and 0.005 degrees.
_AT_LEAST = np.array([1e-4**2] * 3 + [np.radians(0.005) ** 2] * 3)
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
        The rig, with the distances between the surfaces of its cameras in these images.
    """

    result: Reconstruction
    times: Float64
    poses: Float64
    rig: Rig


def run_rig(
    rig_file: Path,
    inputs: Sequence[str | Path],
    options: Options,
    *,
    progress: Progress | None = None,
) -> RigResult:
    """Reconstruct the recordings of a rig's cameras, and write the output folder.

    Raises
    ------
    InputError
        If the rig or a recording can't be used.
    OutputError
        If the result can't be written.
    """
    progress = progress or Silent()
    names = list(recordings_of(rig_file))
    with using_threads(options.threads), threadpool_limits(1):
        progress.stage("opening")
        cameras = cameras_of(names, inputs, options.format)
        recordings = [camera.recording for camera in cameras]
        rig = rig_from(rig_file, recordings)
        source = RigSource(rig, recordings)
        whole = Recording.of(source, " ".join(map(str, inputs)), "rig")
        recording = _selected(whole, source, options)
        config = resolve(options)
        with OutputFolder(options.out, overwrite=options.overwrite) as folder:
            found = reconstruct_rig(
                rig, cameras, recording, config, seed=options.seed or 0, progress=progress
            )
            progress.stage("writing")
            _write(found, recording, folder)
    return found


def _selected(whole: Recording, source: RigSource, options: Options) -> Recording:
    """Return the recording of the instants that the options select."""
    count = int(source.instant[-1]) + 1
    chosen = np.arange(count)[slice(options.start, options.end, options.every)]
    if not len(chosen):
        raise InputError(
            f"has {count} instants, of which the selection leaves none",
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
    """Estimate a rig pose for each instant, and fuse the images of all cameras.

    Parameters
    ----------
    rig, cameras
        The calibrated rig, and its opened cameras in the same order.
    recording
        Of a `RigSource`.
    config, seed
        As in `reconstruct`.
    motion
        Whether the rig moves; "auto" detects it.
    """
    progress = progress or Silent()
    source = recording.source
    assert isinstance(source, RigSource)
    instants, first = np.unique(source.instant[recording.indices], return_index=True)
    times = recording.timestamps[first]
    poses = np.tile(np.eye(4), (len(instants), 1, 1))
    T_rig_frame = source.T_rig_camera[recording.indices]
    knocked: list[CameraMotion] = []
    measured: tuple[Measured, ...] = ()
    tracked: tuple[Measured, ...] = ()
    if moves(cameras, motion):
        found = track_rig(cameras, recording, progress)
        poses, T_rig_frame, apart = found.poses, found.T_rig_frame, found.disagreement
        measured, tracked = found.measured, found.tracked
    else:
        knocked, apart = _checked(rig, cameras, recording)
    at = np.searchsorted(instants, source.instant[recording.indices])
    of_frames = poses[at] @ T_rig_frame
    given = replace(
        config,
        odometry=GivenPoses(),
        loops=_NO_LOOPS,
        refinement=NoRefinement(),
        priors=(),
        self_calibration=False,
    )
    moved = bool(measured or tracked)
    fixed = _fixed(rig, source, recording, at, of_frames, follow=not moved)
    sure = replace(given, refinement=AlreadyRefined(measured, (*tracked, *fixed)))
    result = reconstruct(with_odometry(recording, of_frames), sure, seed=seed, progress=progress)
    names = [camera.name for camera in rig.cameras]
    of_rig = {"cameras": names, "of_frames": source.camera[recording.indices].tolist()}
    result = replace(
        _as_rig(result, names, source.camera, moves=moved),
        config=given.to_dict(),
        recording={**result.recording, "rig": of_rig},
    )
    between = tuple(
        Disagreement(names[a], names[b], median, pixels)
        for (a, b), (median, pixels) in sorted(apart.items())
    )
    return RigResult(_marked(result, knocked), times, poses, replace(rig, disagreement=between))


def _fixed(
    rig: Rig,
    source: RigSource,
    recording: Recording,
    instant: Intp,
    T_world_frame: Float64,
    *,
    follow: bool,
) -> list[Measured]:
    """Return the edges of an instant's frames to that of the first camera, with their covariance.

    Calibration errors are equal at all instants: if the rig is static (`follow`), later frames are
    tied to the first ones of their cameras.
    """
    # The bound on the errors is enlarged for systematic ones, which these covariances include.
    covariances = [
        c.covariance / UNOBSERVED_ERROR_FACTOR**2 + np.diag(_AT_LEAST) for c in rig.cameras
    ]
    covariances[0] = np.diag(_AT_LEAST)
    known = np.flatnonzero(np.isfinite(T_world_frame[:, 0, 0]))
    cameras = source.camera[recording.indices]
    found: list[Measured] = []
    first: dict[int, int] = {}
    seen: dict[int, int] = {}
    for k in known:
        c = int(cameras[k])
        i = first.setdefault(0 if follow else int(instant[k]), int(k))
        C = covariances[c]
        if follow and c in seen:
            C, i = np.diag(_AT_LEAST), seen[c]
        seen.setdefault(c, int(k))
        if i != k:
            T = se3.inverse(T_world_frame[i]) @ T_world_frame[k]
            ends = int(recording.indices[i]), int(recording.indices[k])
            found.append(Measured(*ends, T, np.asarray(np.linalg.inv(C), np.float64)))
    return found


def _as_rig(
    result: Reconstruction, names: Sequence[str], cameras: Intp, *, moves: bool
) -> Reconstruction:
    """Return the result without diagnostics that concern only single-camera tracking.

    `cameras` are those of all frames, as positions in `names`.
    """
    d = result.diagnostics
    reasons = ranked([r for r in d.reasons if r.code not in _OF_TRACKING])
    worst = d.accuracy.worst
    if not moves and worst is not None:
        name = names[cameras[worst.frame]]
        reasons = ranked([_of_calibration(r, worst.frame, name) for r in reasons])
    d = replace(d, reasons=reasons, verdict=verdict_of(reasons), refinement=None, cloud_before=None)
    return replace(result, diagnostics=d)


def _of_calibration(reason: Reason, worst: int, name: str) -> Reason:
    """Return the reason; if poses of static cameras are uncertain, the calibration is.

    `worst` is the least certain frame, and `name` its camera.
    """
    if reason.code != "uncertain_poses":
        return reason
    text = reason.text.replace(f"Frame {worst} is", f"Camera {name!r} is")
    text += (
        " The bound follows from the covariances in rig.json, which include systematic errors such "
        "as multipath."
    )
    return replace(reason, code="uncertain_rig", text=text)


def _checked(
    rig: Rig, cameras: Sequence[Camera], recording: Recording
) -> tuple[list[CameraMotion], dict[tuple[int, int], tuple[float, int]]]:
    """Return the cameras that differ from the calibration, by aligning their views from there.

    Also the distances between the surfaces of each two at the calibrated poses, see `Placed`.
    """
    source = recording.source
    assert isinstance(source, RigSource)
    first = np.flatnonzero(source.instant == source.instant[recording.indices[0]])
    views = []
    for index in first:
        frame = source.read(int(index))
        if isinstance(frame, RangeFrame):
            c = int(source.camera[index])
            views.append(View(c, 0, SampledView.of(cameras[c].surface(frame), _POINTS)))
    stated = np.stack([camera.T_rig_camera for camera in rig.cameras])
    placed = refine_together(views, stated)
    found = tuple(
        replace(camera, T_rig_camera=T, covariance=C[:6, :6])
        for camera, T, C in zip(rig.cameras, placed.poses, placed.covariance, strict=True)
    )
    knocked = [moved for moved in compare(rig, Rig(found)) if moved.moved]
    return knocked, disagreements(views, stated)


def _marked(result: Reconstruction, knocked: Sequence[CameraMotion]) -> Reconstruction:
    """Return the result with a reason for the cameras that differ from the calibration."""
    if not knocked:
        return result
    d = result.diagnostics
    changes = ", ".join(
        f"{m.name} by {1000 * m.distance_m:.0f} mm and {np.degrees(m.angle_rad):.1f} degrees"
        for m in knocked
    )
    text = f"Camera poses differ from those of the rig: {changes}."
    everything = ((d.frames[0].index, d.frames[-1].index),)
    reasons = ranked((*d.reasons, Reason("rig_changed", everything, text)))
    verdict = verdict_of(reasons)
    return replace(result, diagnostics=replace(d, reasons=reasons, verdict=verdict))


def _write(found: RigResult, recording: Recording, folder: OutputFolder) -> None:
    from tofuse.report.extras import ReportExtras
    from tofuse.viewer.view_file import write_report_and_view

    def report(result: Reconstruction, here: Path) -> None:
        source = recording.source
        assert isinstance(source, RigSource)
        cameras = ", ".join(camera.name for camera in source.rig.cameras)
        write_report_and_view(result, here, ReportExtras(f"rig of {cameras}", rig=found.rig))
        if result is found.result:
            known = np.isfinite(found.poses[:, 0, 0])
            write_tum(here / TRAJECTORY, found.times[known], found.poses[known])

    write_result(found.result, folder, report)
