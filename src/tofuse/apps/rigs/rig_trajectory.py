"""The trajectory of a moving rig: one pose per instant.

Each camera is tracked separately. The covariance-weighted mean of their rig poses is refined: views
of all cameras are compared, those of one instant as one rigid body.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.apps.rigs.hand_eye import Track, median_pose
from tofuse.apps.rigs.inputs import Camera, measured_image
from tofuse.apps.rigs.joint import SurfaceDistances, disagreements_of
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured
from tofuse.engine.mapping import reconstructing
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.refinement import joint_alignment, pairwise_measurements, propagate_poses
from tofuse.engine.stored_views import SampledView, Spacing, pair_equations
from tofuse.engine.times import nearest
from tofuse.formats.rigs import RigSource

# Spacing of views, as for a single camera, and their number of points.
_SPACING = Spacing()
_POINTS = 1500
# Variances, m^2 and rad^2, of a pose without a covariance; and the fraction of them that is added
# to each pose, as even the first pose of a track has an error.
_DEFAULT_VARIANCES, _MIN_FRACTION = np.array([0.1**2] * 6), 1e-4
# More neighbours than for one camera, as each camera observes the same places as the others.
_OPTIONS = pair_equations.RefineOptions(neighbours=16)


@dataclass(frozen=True, eq=False)
class RigTrajectory:
    """The trajectory of a rig.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_rig of the instants; NaN where no camera has a pose.
    T_rig_frame
        (F, 4, 4) pose of each image in the rig's frame at its instant: the pose of its camera, and
        the motion since then, as free-running cameras take images at different times.
    disagreement
        Distances between the surfaces of pairs of cameras, at any time.
    measured
        Relative poses of view pairs, by the index of their frames.
    tracked
        Relative poses from the cameras' own trajectories, for instants that were not refined.
    """

    poses: Float64
    T_rig_frame: Float64
    disagreement: SurfaceDistances
    measured: tuple[Measured, ...]
    tracked: tuple[Measured, ...] = ()


def track_rig(cameras: Sequence[Camera], recording: Recording, progress: Progress) -> RigTrajectory:
    """Track each camera of a `RigSource`, and refine the poses of the rig.

    Raises
    ------
    InputError
        If no camera has a trajectory.
    """
    source = RigSource.of(recording)
    _, first, instant = np.unique(
        source.instant[recording.indices], return_index=True, return_inverse=True
    )
    poses, information = _rig_estimates(cameras, source, recording.timestamps, progress)
    mean = _weighted_means(_in_one_world(poses[:, first]), information[:, first])
    posed = np.flatnonzero(np.isfinite(mean[:, 0, 0]))
    if not len(posed):
        raise InputError(
            "no camera has a pose at the instants that all of them saw",
            where="the rig",
            remedy="calibrate the clocks again",
        )
    mean = np.asarray(se3.inverse(mean[posed[0]]) @ mean, np.float64)
    # Motion within an instant, independent of the cameras' world frames.
    motion = _weighted_means(se3.inverse(poses[:, first[instant]]) @ poses, information)
    motion = np.where(np.isfinite(motion[:, :1, :1]), motion, np.eye(4))
    T_rig_frame = motion @ source.T_rig_camera[recording.indices]
    progress.stage("refining the rig")
    trajectory = refined(cameras, recording, mean, T_rig_frame, instant)
    total = (information * np.isfinite(poses[..., :1, :1])).sum(0)
    tracked = _tracking_edges(source, recording, trajectory, instant, total)
    return replace(trajectory, tracked=tuple(tracked))


def _tracking_edges(
    source: RigSource,
    recording: Recording,
    trajectory: RigTrajectory,
    instant: Intp,
    information: Float64,
) -> Iterator[Measured]:
    """Yield edges from the first pose to instants that were not refined.

    Their `information` (F, 6, 6) is the sum of that of the cameras' own trajectories.
    """
    used = {index for edge in trajectory.measured for index in (edge.i, edge.j)}
    poses = trajectory.poses[instant]
    posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    refined_instants = instant[np.isin(recording.indices, list(used))]
    for k in posed[1:]:
        if instant[k] not in refined_instants and not source.camera[recording.indices[k]]:
            T = se3.inverse(poses[posed[0]]) @ poses[k]
            first, index = recording.indices[posed[0]], recording.indices[k]
            yield Measured(int(first), int(index), T, information[k])


def _rig_estimates(
    cameras: Sequence[Camera], source: RigSource, times: Float64, progress: Progress
) -> tuple[Float64, Float64]:
    """Return T_world_rig (C, F, 4, 4) at times (F,) by each camera that has a trajectory.

    Each is in a world frame of its own, and NaN where unknown. Also the information (C, F, 6, 6) of
    right perturbations.
    """
    default = np.diag(_DEFAULT_VARIANCES)
    poses, information = [], []
    for stated, camera in zip(source.rig.cameras, cameras, strict=True):
        progress.stage(f"tracking {camera.name}")
        result = reconstructing.reconstruct(camera.recording, progress=Silent())
        own_times = result.timestamps + stated.time_offset_s
        track = Track.of(own_times, result.trajectory)
        if len(track.times) < 2:
            progress.note(f"{camera.name} has no trajectory")
            continue
        records = np.array(result.diagnostics.frames, object)[result.has_pose]
        covariances = [
            default if r.covariance is None else r.covariance + default * _MIN_FRACTION
            for r in records
        ]
        # Transform the covariances from the camera's frame to the rig's.
        A = se3.adjoint(stated.T_rig_camera)
        by_pose = np.linalg.inv(A @ np.stack(covariances) @ A.T)
        T, valid = track.at(times)
        poses.append(np.where(valid[:, None, None], T @ se3.inverse(stated.T_rig_camera), np.nan))
        information.append(by_pose[nearest(own_times[result.has_pose], times)])
    if not poses:
        raise InputError("no camera has a trajectory", where="the rig")
    return np.stack(poses), np.stack(information)


def _in_one_world(poses: Float64) -> Float64:
    """Return estimates (C, N, 4, 4) in the first one's world; NaN without a common pose."""
    out = poses.copy()
    for k in range(1, len(poses)):
        common = np.isfinite(poses[[0, k], :, 0, 0]).all(0)
        out[k] = np.nan
        if common.any():
            out[k] = median_pose(poses[0, common] @ se3.inverse(poses[k, common])) @ poses[k]
    return out


def refined(
    cameras: Sequence[Camera],
    recording: Recording,
    poses: Float64,
    T_rig_frame: Float64,
    instant: Intp,
) -> RigTrajectory:
    """Refine T_world_rig poses (N, 4, 4) of the instants with views of all cameras.

    They stay unchanged if the support of the views would fall. `instant` (F,) is by frame.
    """
    source = RigSource.of(recording)
    selected = _spaced_instants(cameras, recording, poses, instant)
    views, frames = [], []
    for frame in np.flatnonzero(np.isin(instant, selected)):
        image = measured_image(recording, int(frame))
        if image is not None:
            camera = cameras[int(source.camera[recording.indices[frame]])]
            views.append(SampledView.of(camera.surface(image), _POINTS))
            frames.append(int(frame))
    used, body = np.unique(instant[frames], return_inverse=True)
    if len(used) < 2:
        return RigTrajectory(poses, T_rig_frame, {}, ())
    bodies = joint_alignment.Bodies(body, T_rig_frame[frames])
    initial = bodies.view_poses(poses[used])
    refinement = joint_alignment.refine(
        views, np.asarray(se3.inverse(initial[0]) @ initial), _OPTIONS, bodies=bodies
    )
    count = len(views)
    view_camera = source.camera[recording.indices[frames]]
    gain = refinement.after.of_views(count) - refinement.before.of_views(count)
    fell = not len(refinement.pairs) or joint_alignment.support_fell(gain)
    view_poses = initial if fell else refinement.poses
    disagreement = disagreements_of(views, view_camera, view_poses, refinement.pairs)
    if fell:
        return RigTrajectory(poses, T_rig_frame, disagreement, ())
    after = bodies.body_poses(initial[0] @ refinement.poses)
    posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    out = poses.copy()
    out[posed] = propagate_poses(poses[posed], np.searchsorted(posed, used), after)
    measured = pairwise_measurements([int(recording.indices[k]) for k in frames], refinement)
    out = np.asarray(se3.inverse(out[posed[0]]) @ out, np.float64)
    return RigTrajectory(out, T_rig_frame, disagreement, measured)


def _spaced_instants(
    cameras: Sequence[Camera], recording: Recording, poses: Float64, instant: Intp
) -> Intp:
    """Return instants spaced by the motion of the rig, at most as many as can be refined."""
    posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    frame = measured_image(recording, int(np.flatnonzero(instant == posed[0])[0]))
    depth = 1.0 if frame is None else float(np.median(frame.z[frame.valid]))
    stretch, max_instants = 1.0, max(2, _SPACING.max_views // len(cameras))
    while True:
        selected = [posed[0]]
        for k in posed[1:]:
            motion = se3.inverse(poses[selected[-1]]) @ poses[k]
            if _SPACING.is_exceeded(motion, depth, stretch):
                selected.append(k)
        if len(selected) <= max_instants:
            return np.array(selected, np.intp)
        stretch *= 2


def _weighted_means(poses: Float64, information: Float64) -> Float64:
    """Return the (N, 4, 4) information-weighted mean over cameras; NaN where all are unknown."""
    valid = np.isfinite(poses[..., 0, 0])
    information = information * valid[..., None, None]
    rows = np.flatnonzero(valid.any(0))
    reference = poses[valid.argmax(0)[rows], rows]
    deviations = se3.log(
        se3.inverse(reference) @ np.where(valid[:, rows, None, None], poses[:, rows], reference)
    )
    weighted = (information[:, rows] @ deviations[..., None]).sum(0)
    step = np.linalg.solve(information[:, rows].sum(0), weighted)[..., 0]
    out = np.full(poses.shape[1:], np.nan)
    out[rows] = reference @ se3.exp(step)
    return out
