"""The trajectory of a moving rig: one pose for each instant.

Each camera is tracked separately. The mean of their estimates of the rig's pose, weighted by
covariances, is refined: views of all cameras are compared, those of one instant as one rigid body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.errors import InputError, UnreadableFrameError
from tofuse.geometry import se3
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.reconstruct import reconstruct
from tofuse.posegraph.build import Measured
from tofuse.posegraph.joint_alignment import Bodies, refine
from tofuse.posegraph.pair_equations import RefineOptions
from tofuse.posegraph.refinement import followed, pairwise_measurements
from tofuse.posegraph.submaps import support_fell
from tofuse.posegraph.view_store import SampledView, Spacing
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.recordings.rig import RigCamera
from tofuse.recordings.rig_source import RigSource
from tofuse.results.types import Reconstruction
from tofuse.rigs.hand_eye import Track
from tofuse.rigs.inputs import Camera
from tofuse.rigs.joint import disagreements_of

# Median distance between the surfaces of two cameras, m, and compared pixels, by pair a < b.
Apart = dict[tuple[int, int], tuple[float, int]]

# Spacing of views, as for a single camera, and their points.
_SPACING = Spacing()
_POINTS = 1500
# Variances, m^2 and rad^2, of a pose without a covariance; and the fraction of them that is added
# to each pose, as even the first one of a track has an error.
_UNKNOWN, _AT_LEAST = np.array([0.1**2] * 6), 1e-4
# More neighbours than for one camera, as each camera sees the places of all others.
_OPTIONS = RefineOptions(neighbours=16)


@dataclass(frozen=True, eq=False)
class RigTrajectory:
    """The trajectory of a rig.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_rig of the instants; NaN where no camera has a pose.
    T_rig_frame
        (F, 4, 4) pose of each image in the rig's frame at its instant: that of its camera, and the
        motion since, as free-running cameras take images at different times.
    disagreement
        See `MovingRig`.
    measured
        Measurements of pairs of views, by the index of their frames.
    tracked
        Measurements from the cameras' own trajectories, for instants that were not refined.
    """

    poses: Float64
    T_rig_frame: Float64
    disagreement: Apart
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
    _, first, at = np.unique(
        source.instant[recording.indices], return_index=True, return_inverse=True
    )
    rig_estimates = [s.at(recording.timestamps) for s in _tracks(cameras, source, progress)]
    mean = _mean_path([s.some(first) for s in rig_estimates])
    # Motion within an instant, independent of the cameras' world frames.
    since = [
        _RigEstimate(se3.inverse(s.poses[first][at]) @ s.poses, s.information)
        for s in rig_estimates
    ]
    moved = _means(since)
    moved = np.where(np.isfinite(moved[:, :1, :1]), moved, np.eye(4))
    T_rig_frame = moved @ source.T_rig_camera[recording.indices]
    if not np.isfinite(mean[:, 0, 0]).any():
        raise InputError(
            "no camera has a pose at the instants that all of them saw",
            where="the rig",
            remedy="calibrate the clocks again",
        )
    progress.stage("refining the rig")
    found = refined(cameras, recording, mean, T_rig_frame, at)
    used = {index for edge in found.measured for index in (edge.i, edge.j)}
    more = _of_tracking(source, recording, rig_estimates, found.poses, at, used)
    return replace(found, tracked=tuple(more))


def _of_tracking(
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
    known = np.flatnonzero(np.isfinite(poses[instant][:, 0, 0]))
    taken = {int(instant[k]) for k in known if int(recording.indices[k]) in used}
    information = sum(s.information * np.isfinite(s.poses[:, :1, :1]) for s in rig_estimates)
    found = []
    for k in known[1:]:
        here = int(instant[k])
        if here in taken or source.camera[recording.indices[k]]:
            continue
        T = se3.inverse(poses[instant[known[0]]]) @ poses[here]
        ends = int(recording.indices[known[0]]), int(recording.indices[k])
        found.append(Measured(*ends, T, np.asarray(information, np.float64)[k]))
    return found


@dataclass(frozen=True, eq=False)
class _RigEstimate:
    """One camera's estimate of the rig: T_world_rig (N, 4, 4), NaN where unknown, and information.

    `information` is (N, 6, 6), of right perturbations.
    """

    poses: Float64
    information: Float64

    def some(self, rows: Intp) -> _RigEstimate:
        """Return only some rows."""
        return _RigEstimate(self.poses[rows], self.information[rows])


@dataclass(frozen=True, eq=False)
class _Tracked:
    """The trajectory of a camera at the rig's times, and the information of its poses."""

    track: Track
    information: Float64
    T_rig_camera: Float64

    @classmethod
    def of(cls, result: Reconstruction, stated: RigCamera) -> _Tracked:
        known = result.has_pose
        track = Track.of(result.timestamps + stated.time_offset_s, result.trajectory)
        unknown = np.diag(_UNKNOWN)
        C = np.stack(
            [
                unknown if record.covariance is None else record.covariance + unknown * _AT_LEAST
                for record, has in zip(result.diagnostics.frames, known, strict=True)
                if has
            ]
            or [unknown]
        )
        # Covariance of the rig's pose, from that of the camera's.
        A = se3.adjoint(stated.T_rig_camera)
        return cls(track, np.linalg.inv(A @ C @ A.T), stated.T_rig_camera)

    def at(self, times: Float64) -> _RigEstimate:
        T, known = self.track.at(times)
        T = T @ se3.inverse(self.T_rig_camera)
        near = np.abs(self.track.times[None] - times[:, None]).argmin(1)
        return _RigEstimate(np.where(known[:, None, None], T, np.nan), self.information[near])


def _tracks(cameras: Sequence[Camera], source: RigSource, progress: Progress) -> list[_Tracked]:
    """Return the cameras that have a trajectory, each in a world frame of its own."""
    found = []
    for stated, camera in zip(source.rig.cameras, cameras, strict=True):
        progress.stage(f"tracking {camera.name}")
        result = reconstruct(camera.recording, progress=Silent())
        tracked = _Tracked.of(result, stated)
        if len(tracked.track.times) < 2:
            progress.note(f"{camera.name} has no trajectory")
            continue
        found.append(tracked)
    if not found:
        raise InputError("no camera has a trajectory", where="the rig")
    return found


def _mean_path(rig_estimates: Sequence[_RigEstimate]) -> Float64:
    """Return (N, 4, 4) T_world_rig, the mean of the estimates in the first one's world frame."""
    first, stacked = rig_estimates[0], [rig_estimates[0]]
    for other in rig_estimates[1:]:
        both = np.isfinite(first.poses[:, 0, 0]) & np.isfinite(other.poses[:, 0, 0])
        if both.any():
            T = _median_pose(first.poses[both] @ se3.inverse(other.poses[both]))
            stacked.append(_RigEstimate(T @ other.poses, other.information))
    mean = _means(stacked)
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
    chosen = _chosen(cameras, recording, poses, instant)
    views, frames = [], []
    for frame in np.flatnonzero(np.isin(instant, chosen)):
        image = _image(recording, int(frame))
        if image is not None:
            camera = cameras[int(source.camera[recording.indices[frame]])]
            views.append(SampledView.of(camera.surface(image), _POINTS))
            frames.append(int(frame))
    used, of = np.unique(instant[frames], return_inverse=True)
    if len(used) < 2:
        return RigTrajectory(poses, T_rig_frame, {}, ())
    bodies = Bodies(of, T_rig_frame[frames])
    start = bodies.view_poses(poses[used])
    done = refine(views, np.asarray(se3.inverse(start[0]) @ start), _OPTIONS, bodies=bodies)
    count = len(views)
    of_view = source.camera[recording.indices[frames]]
    if not len(done.pairs) or support_fell(
        done.after.of_views(count) - done.before.of_views(count)
    ):
        apart = disagreements_of(views, of_view, start, done.pairs)
        return RigTrajectory(poses, T_rig_frame, apart, ())
    after = bodies.body_poses(start[0] @ done.poses)
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    out = poses.copy()
    out[known] = followed(poses[known], np.searchsorted(known, used), after)
    apart = disagreements_of(views, of_view, done.poses, done.pairs)
    measured = pairwise_measurements([int(recording.indices[k]) for k in frames], done)
    out = np.asarray(se3.inverse(out[known[0]]) @ out, np.float64)
    return RigTrajectory(out, T_rig_frame, apart, measured)


def _chosen(cameras: Sequence[Camera], recording: Recording, poses: Float64, instant: Intp) -> Intp:
    """Return instants spaced by the motion of the rig, with no more views than are refined."""
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    frame = _image(recording, int(np.flatnonzero(instant == known[0])[0]))
    depth = 1.0
    if frame is not None:
        depth = float(np.median(frame.z[frame.valid]))
    stretch, max_instants = 1.0, max(2, _SPACING.most // len(cameras))
    while True:
        chosen = [known[0]]
        for k in known[1:]:
            motion = se3.inverse(poses[chosen[-1]]) @ poses[k]
            turned = se3.angle(motion) >= _SPACING.angle * stretch
            far = np.linalg.norm(motion[:3, 3]) >= _SPACING.distance * stretch * depth
            if turned or far:
                chosen.append(k)
        if len(chosen) <= max_instants:
            return np.array(chosen, np.intp)
        stretch *= 2


def _image(recording: Recording, k: int) -> RangeFrame | None:
    """Return image `k` of the recording; None if it can't be read, or is empty."""
    try:
        frame = recording[k]
    except UnreadableFrameError:
        return None
    return frame if isinstance(frame, RangeFrame) and len(frame) else None


def _median_pose(poses: Float64) -> Float64:
    """Return the component-wise median of nearby poses, in their tangent space."""
    centre = poses[len(poses) // 2]
    for _ in range(10):
        centre = centre @ se3.exp(np.median(se3.log(se3.inverse(centre) @ poses), axis=0))
    return np.asarray(se3.orthonormalise(centre), np.float64)


def _means(rig_estimates: Sequence[_RigEstimate]) -> Float64:
    """Return the (N, 4, 4) information-weighted mean over cameras; NaN where all are unknown."""
    poses = np.stack([s.poses for s in rig_estimates])
    known = np.isfinite(poses[..., 0, 0])
    information = np.stack([s.information for s in rig_estimates]) * known[..., None, None]
    rows = np.flatnonzero(known.any(0))
    at = poses[known.argmax(0)[rows], rows]
    away = se3.log(se3.inverse(at) @ np.where(known[:, rows, None, None], poses[:, rows], at))
    weighed = (information[:, rows] @ away[..., None]).sum(0)
    step = np.linalg.solve(information[:, rows].sum(0), weighed)[..., 0]
    out = np.full(poses.shape[1:], np.nan)
    out[rows] = at @ se3.exp(step)
    return out
