"""The trajectory of a moving rig: one pose per instant.

Each camera is tracked separately. The covariance-weighted mean of their rig poses is refined: views
of all cameras are compared, those of one instant as one rigid body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.apps.rigs.hand_eye import Track, median_pose
from tofuse.apps.rigs.inputs import Camera, measured_image
from tofuse.apps.rigs.joint import disagreements_of
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured
from tofuse.engine.mapping import reconstructing
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.refinement import joint_alignment, pairwise_measurements, propagate_poses
from tofuse.engine.results import Reconstruction
from tofuse.engine.stored_views import SampledView, Spacing, pair_equations
from tofuse.formats.rigs import RigCamera, RigSource

# Median distance between the surfaces of two cameras, m, and number of pixels, by pair a < b.
SurfaceDistances = dict[tuple[int, int], tuple[float, int]]

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
        See `MovingRig`.
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
    source = recording.source
    assert isinstance(source, RigSource)
    _, first, instant = np.unique(
        source.instant[recording.indices], return_index=True, return_inverse=True
    )
    rig_estimates = [
        estimate.at(recording.timestamps) for estimate in _tracks(cameras, source, progress)
    ]
    mean = _mean_trajectory([estimate.subset(first) for estimate in rig_estimates])
    # Motion within an instant, independent of the cameras' world frames.
    motions = [
        _RigEstimate(
            se3.inverse(estimate.poses[first][instant]) @ estimate.poses, estimate.information
        )
        for estimate in rig_estimates
    ]
    motion = _weighted_means(motions)
    motion = np.where(np.isfinite(motion[:, :1, :1]), motion, np.eye(4))
    T_rig_frame = motion @ source.T_rig_camera[recording.indices]
    if not np.isfinite(mean[:, 0, 0]).any():
        raise InputError(
            "no camera has a pose at the instants that all of them saw",
            where="the rig",
            remedy="calibrate the clocks again",
        )
    progress.stage("refining the rig")
    trajectory = refined(cameras, recording, mean, T_rig_frame, instant)
    used = {index for edge in trajectory.measured for index in (edge.i, edge.j)}
    tracked = _tracking_edges(source, recording, rig_estimates, trajectory.poses, instant, used)
    return replace(trajectory, tracked=tuple(tracked))


def _tracking_edges(
    source: RigSource,
    recording: Recording,
    rig_estimates: Sequence[_RigEstimate],
    poses: Float64,
    instant: Intp,
    used: set[int],
) -> list[Measured]:
    """Return edges from the first pose to instants that were not refined.

    Their information is the sum of that of the cameras' own trajectories.
    """
    posed = np.flatnonzero(np.isfinite(poses[instant][:, 0, 0]))
    refined = {int(instant[k]) for k in posed if int(recording.indices[k]) in used}
    information = sum(
        estimate.information * np.isfinite(estimate.poses[:, :1, :1]) for estimate in rig_estimates
    )
    edges = []
    for k in posed[1:]:
        row = int(instant[k])
        if row in refined or source.camera[recording.indices[k]]:
            continue
        T = se3.inverse(poses[instant[posed[0]]]) @ poses[row]
        ends = int(recording.indices[posed[0]]), int(recording.indices[k])
        edges.append(Measured(*ends, T, np.asarray(information, np.float64)[k]))
    return edges


@dataclass(frozen=True, eq=False)
class _RigEstimate:
    """A camera's estimate of the rig: T_world_rig (N, 4, 4), NaN where unknown, and information.

    `information` is (N, 6, 6), of right perturbations.
    """

    poses: Float64
    information: Float64

    def subset(self, rows: Intp) -> _RigEstimate:
        """Return the estimate at a subset of rows."""
        return _RigEstimate(self.poses[rows], self.information[rows])


@dataclass(frozen=True, eq=False)
class _Tracked:
    """The trajectory of a camera at the rig's times, and the information of its poses."""

    track: Track
    information: Float64
    T_rig_camera: Float64

    @classmethod
    def of(cls, result: Reconstruction, stated: RigCamera) -> _Tracked:
        posed = result.has_pose
        track = Track.of(result.timestamps + stated.time_offset_s, result.trajectory)
        default = np.diag(_DEFAULT_VARIANCES)
        C = np.stack(
            [
                default
                if record.covariance is None
                else record.covariance + default * _MIN_FRACTION
                for record, has_pose in zip(result.diagnostics.frames, posed, strict=True)
                if has_pose
            ]
            or [default]
        )
        # Transform the covariance from the camera's frame to the rig's.
        A = se3.adjoint(stated.T_rig_camera)
        return cls(track, np.linalg.inv(A @ C @ A.T), stated.T_rig_camera)

    def at(self, times: Float64) -> _RigEstimate:
        T, valid = self.track.at(times)
        T = T @ se3.inverse(self.T_rig_camera)
        nearest = np.abs(self.track.times[None] - times[:, None]).argmin(1)
        return _RigEstimate(np.where(valid[:, None, None], T, np.nan), self.information[nearest])


def _tracks(cameras: Sequence[Camera], source: RigSource, progress: Progress) -> list[_Tracked]:
    """Return the trajectories of the cameras that have one, each in its own world frame."""
    tracks = []
    for stated, camera in zip(source.rig.cameras, cameras, strict=True):
        progress.stage(f"tracking {camera.name}")
        result = reconstructing.reconstruct(camera.recording, progress=Silent())
        tracked = _Tracked.of(result, stated)
        if len(tracked.track.times) < 2:
            progress.note(f"{camera.name} has no trajectory")
            continue
        tracks.append(tracked)
    if not tracks:
        raise InputError("no camera has a trajectory", where="the rig")
    return tracks


def _mean_trajectory(rig_estimates: Sequence[_RigEstimate]) -> Float64:
    """Return (N, 4, 4) T_world_rig, the mean of the estimates in the first one's world frame."""
    first, stacked = rig_estimates[0], [rig_estimates[0]]
    for other in rig_estimates[1:]:
        common = np.isfinite(first.poses[:, 0, 0]) & np.isfinite(other.poses[:, 0, 0])
        if common.any():
            T = median_pose(first.poses[common] @ se3.inverse(other.poses[common]))
            stacked.append(_RigEstimate(T @ other.poses, other.information))
    mean = _weighted_means(stacked)
    rows = np.flatnonzero(np.isfinite(mean[:, 0, 0]))
    return np.asarray(se3.inverse(mean[rows[0]]) @ mean, np.float64) if len(rows) else mean


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
    source = recording.source
    assert isinstance(source, RigSource)
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
    if not len(refinement.pairs) or joint_alignment.support_fell(
        refinement.after.of_views(count) - refinement.before.of_views(count)
    ):
        disagreement = disagreements_of(views, view_camera, initial, refinement.pairs)
        return RigTrajectory(poses, T_rig_frame, disagreement, ())
    after = bodies.body_poses(initial[0] @ refinement.poses)
    posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    out = poses.copy()
    out[posed] = propagate_poses(poses[posed], np.searchsorted(posed, used), after)
    disagreement = disagreements_of(views, view_camera, refinement.poses, refinement.pairs)
    measured = pairwise_measurements([int(recording.indices[k]) for k in frames], refinement)
    out = np.asarray(se3.inverse(out[posed[0]]) @ out, np.float64)
    return RigTrajectory(out, T_rig_frame, disagreement, measured)


def _spaced_instants(
    cameras: Sequence[Camera], recording: Recording, poses: Float64, instant: Intp
) -> Intp:
    """Return instants spaced by the motion of the rig, at most as many as can be refined."""
    posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    frame = measured_image(recording, int(np.flatnonzero(instant == posed[0])[0]))
    depth = 1.0
    if frame is not None:
        depth = float(np.median(frame.z[frame.valid]))
    stretch, max_instants = 1.0, max(2, _SPACING.max_views // len(cameras))
    while True:
        selected = [posed[0]]
        for k in posed[1:]:
            motion = se3.inverse(poses[selected[-1]]) @ poses[k]
            rotated = se3.angle(motion) >= _SPACING.angle * stretch
            translated = np.linalg.norm(motion[:3, 3]) >= _SPACING.distance * stretch * depth
            if rotated or translated:
                selected.append(k)
        if len(selected) <= max_instants:
            return np.array(selected, np.intp)
        stretch *= 2


def _weighted_means(rig_estimates: Sequence[_RigEstimate]) -> Float64:
    """Return the (N, 4, 4) information-weighted mean over cameras; NaN where all are unknown."""
    poses = np.stack([estimate.poses for estimate in rig_estimates])
    valid = np.isfinite(poses[..., 0, 0])
    information = (
        np.stack([estimate.information for estimate in rig_estimates]) * valid[..., None, None]
    )
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
