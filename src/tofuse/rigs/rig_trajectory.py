"""The trajectory of a moving rig: one pose for each instant.

Each camera is tracked separately. The mean of their poses of the rig, weighted by covariances, is
refined: views of all cameras are compared, and those of one instant move as one body.
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
from tofuse.posegraph.joint_alignment import Bodies, RefineOptions, refine
from tofuse.posegraph.refinement import followed, pairwise_measurements
from tofuse.posegraph.submaps import fell
from tofuse.posegraph.view_store import KeptView, Spacing
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
# Variances, m and rad, of a pose without a covariance; and the fraction of them that is added to
# each pose, as even the first one of a track has an error.
_UNKNOWN, _AT_LEAST = np.array([0.1**2] * 6), 1e-4
# Each camera sees the places of all others.
_OPTIONS = RefineOptions(neighbours=16)


@dataclass(frozen=True, eq=False)
class RigTrajectory:
    """The trajectory of a rig.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_rig of the instants; NaN where no camera has a pose.
    T_rig_frame
        (F, 4, 4) pose of each frame in the rig's frame at its instant: that of its camera, and the
        motion since, as free-running cameras take images at different times.
    disagreement
        See `MovingRig`.
    measured
        Measurements of pairs of views, by the index of their frames.
    tracked
        Measurements of the cameras' own trajectories, for instants that were not refined.
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
    said = [s.at(recording.timestamps) for s in _tracks(cameras, source, progress)]
    mean = _mean_path([s.some(first) for s in said])
    # What moves in an instant is not for the worlds of the cameras to say.
    since = [_Said(se3.inverse(s.poses[first][at]) @ s.poses, s.information) for s in said]
    moved = _means(since)
    moved = np.where(np.isfinite(moved[:, :1, :1]), moved, np.eye(4))
    T_rig_frame = moved @ source.T_rig_camera[recording.indices]
    if not np.isfinite(mean[:, 0, 0]).any():
        raise InputError(
            "no camera has a pose at the instants that all of them saw",
            where="the rig",
            remedy="calibrate the clocks anew",
        )
    progress.stage("refining the rig")
    found = refined(cameras, recording, mean, T_rig_frame, at)
    used = {index for edge in found.measured for index in (edge.i, edge.j)}
    more = _of_tracking(source, recording, said, found.poses, at, used)
    return replace(found, tracked=tuple(more))


def _of_tracking(
    source: RigSource,
    recording: Recording,
    said: Sequence[_Said],
    poses: Float64,
    instant: Intp,
    used: set[int],
) -> list[Measured]:
    """How sure the pose of the rig is at instants that took no part in the refinement.

    As sure as all cameras' own trajectories are of it, seen from the first pose.
    """
    known = np.flatnonzero(np.isfinite(poses[instant][:, 0, 0]))
    taken = {int(instant[k]) for k in known if int(recording.indices[k]) in used}
    information = sum(s.information * np.isfinite(s.poses[:, :1, :1]) for s in said)
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
class _Said:
    """What a camera says of the rig: poses (N, 4, 4), NaN where nothing, and their information.

    `information` is (N, 6, 6), of right perturbations.
    """

    poses: Float64
    information: Float64

    def some(self, rows: Intp) -> _Said:
        """Only some of it."""
        return _Said(self.poses[rows], self.information[rows])


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
        # That of the rig, which the camera is fixed to.
        A = se3.adjoint(stated.T_rig_camera)
        return cls(track, np.linalg.inv(A @ C @ A.T), stated.T_rig_camera)

    def at(self, times: Float64) -> _Said:
        T, known = self.track.at(times)
        T = T @ se3.inverse(self.T_rig_camera)
        near = np.abs(self.track.times[None] - times[:, None]).argmin(1)
        return _Said(np.where(known[:, None, None], T, np.nan), self.information[near])


def _tracks(cameras: Sequence[Camera], source: RigSource, progress: Progress) -> list[_Tracked]:
    """The cameras that have a trajectory, each in a world of its own."""
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


def _mean_path(said: Sequence[_Said]) -> Float64:
    """(N, 4, 4) T_world_rig, the mean of what the cameras say, in the world of the first one."""
    first, stacked = said[0], [said[0]]
    for other in said[1:]:
        both = np.isfinite(first.poses[:, 0, 0]) & np.isfinite(other.poses[:, 0, 0])
        if both.any():
            T = _middle(first.poses[both] @ se3.inverse(other.poses[both]))
            stacked.append(_Said(T @ other.poses, other.information))
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
    """Refine poses (N, 4, 4) of the instants with views of all cameras.

    Only if the views then support each other at least as well. `instant` is that of each frame.
    """
    source = recording.source
    assert isinstance(source, RigSource)
    chosen = _chosen(cameras, recording, poses, instant)
    views, frames = [], []
    for frame in np.flatnonzero(np.isin(instant, chosen)):
        image = _image(recording, int(frame))
        if image is not None:
            camera = cameras[int(source.camera[recording.indices[frame]])]
            views.append(KeptView.of(camera.surface(image), _POINTS))
            frames.append(int(frame))
    used, of = np.unique(instant[frames], return_inverse=True)
    if len(used) < 2:
        return RigTrajectory(poses, T_rig_frame, {}, ())
    bodies = Bodies(of, T_rig_frame[frames])
    start = bodies.views(poses[used])
    done = refine(views, np.asarray(se3.inverse(start[0]) @ start), _OPTIONS, bodies=bodies)
    count = len(views)
    of_view = source.camera[recording.indices[frames]]
    if not len(done.pairs) or fell(done.after.of_views(count) - done.before.of_views(count)):
        apart = disagreements_of(views, of_view, start, done.pairs)
        return RigTrajectory(poses, T_rig_frame, apart, ())
    after = bodies.poses(start[0] @ done.poses)
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    out = poses.copy()
    out[known] = followed(poses[known], np.searchsorted(known, used), after)
    apart = disagreements_of(views, of_view, done.poses, done.pairs)
    measured = pairwise_measurements([int(recording.indices[k]) for k in frames], done)
    out = np.asarray(se3.inverse(out[known[0]]) @ out, np.float64)
    return RigTrajectory(out, T_rig_frame, apart, measured)


def _chosen(cameras: Sequence[Camera], recording: Recording, poses: Float64, instant: Intp) -> Intp:
    """Instants spaced by the motion of the rig, of no more views than are refined together."""
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    frame = _image(recording, int(np.flatnonzero(instant == known[0])[0]))
    depth = 1.0
    if frame is not None:
        depth = float(np.median(frame.z[frame.valid]))
    stretch, most = 1.0, max(2, _SPACING.most // len(cameras))
    while True:
        chosen = [known[0]]
        for k in known[1:]:
            motion = se3.inverse(poses[chosen[-1]]) @ poses[k]
            turned = se3.angle(motion) >= _SPACING.angle * stretch
            far = np.linalg.norm(motion[:3, 3]) >= _SPACING.distance * stretch * depth
            if turned or far:
                chosen.append(k)
        if len(chosen) <= most:
            return np.array(chosen, np.intp)
        stretch *= 2


def _image(recording: Recording, k: int) -> RangeFrame | None:
    """Image `k` of the recording; None if it can't be read, or is empty."""
    try:
        frame = recording[k]
    except UnreadableFrameError:
        return None
    return frame if isinstance(frame, RangeFrame) and len(frame) else None


def _middle(poses: Float64) -> Float64:
    """Mean of poses that are near each other, by medians."""
    middle = poses[len(poses) // 2]
    for _ in range(10):
        middle = middle @ se3.exp(np.median(se3.log(se3.inverse(middle) @ poses), axis=0))
    return np.asarray(se3.orthonormalise(middle), np.float64)


def _means(said: Sequence[_Said]) -> Float64:
    """(N, 4, 4) mean over cameras, by what they know; NaN where none says anything."""
    poses = np.stack([s.poses for s in said])
    known = np.isfinite(poses[..., 0, 0])
    information = np.stack([s.information for s in said]) * known[..., None, None]
    rows = np.flatnonzero(known.any(0))
    at = poses[known.argmax(0)[rows], rows]
    away = se3.log(se3.inverse(at) @ np.where(known[:, rows, None, None], poses[:, rows], at))
    weighed = (information[:, rows] @ away[..., None]).sum(0)
    step = np.linalg.solve(information[:, rows].sum(0), weighed)[..., 0]
    out = np.full(poses.shape[1:], np.nan)
    out[rows] = at @ se3.exp(step)
    return out
