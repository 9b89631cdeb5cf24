"""Calibration of a moving rig: cameras are tracked separately, and their trajectories aligned.

The cameras need not overlap at any instant. Views of the same place at different times are used in
a joint refinement of all views, once the trajectories are in one world frame. Where the motion does
not determine that, as of a rig that only turns about the vertical, registered views do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tofuse.apps.rigs.hand_eye import (
    HandEye,
    Track,
    clock_of,
    combined,
    common_poses,
    hand_eye,
    median_pose,
)
from tofuse.apps.rigs.inputs import Calibration, Camera, disagreement_rows
from tofuse.apps.rigs.joint import SurfaceDistances, disagreements_of
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError, RegistrationError
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import reconstructing
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.refinement import joint_alignment, propagate_poses, refined_by_halves
from tofuse.engine.search import are_distinct_poses, register_pair
from tofuse.engine.stored_views import SampledView, pair_equations
from tofuse.engine.times import nearest
from tofuse.engine.views import PreparedView
from tofuse.formats.rigs import Rig, RigCamera

# Number of views of each camera that are refined jointly, and of their points.
_VIEWS, _POINTS = 70, 1500
# Number of views of each camera that are registered with those of another one.
_REGISTERED = 4
# Clock differences above this, s, are reported.
_MAX_CLOCK_DIFFERENCE_S = 0.5
# Maximum sigma of a placed camera: fraction of the depth, and rad.
_MAX_SIGMA_FRACTION, _MAX_SIGMA_RAD = 0.05, float(np.radians(4.0))
_OPTIONS = pair_equations.RefineOptions(neighbours=16)


def calibrate_moving(cameras: Sequence[Camera], progress: Progress) -> Calibration:
    """Track each camera, fit the trajectories to each other, and refine all views jointly.

    Raises
    ------
    InputError
        If the first camera has no trajectory.
    """
    tracks = []
    for camera in cameras:
        progress.stage(f"tracking {camera.name}")
        result = reconstructing.reconstruct(camera.recording, progress=Silent())
        tracks.append(Track.of(result.timestamps, result.trajectory))
    if len(tracks[0].times) < 2:
        raise InputError(
            "has no trajectory",
            where=cameras[0].recording.path,
            remedy="pass the camera with the best tracking first",
        )
    progress.stage("fitting trajectories")
    fits: dict[int, HandEye] = {}
    reasons: dict[int, str] = {}
    notes: list[str] = []
    for k in range(1, len(cameras)):
        try:
            offset = _initial_offset(cameras, tracks, k, notes)
            fit = hand_eye(tracks[0], tracks[k], offset)
            fits[k] = _common_world(cameras, tracks, k, fit)
        except RegistrationError as error:
            reasons[k] = str(error)
    progress.stage("refining")
    joint = _JointViews.of(cameras, tracks, fits)
    refined = joint.refined()
    for k in list(fits):
        offset = fits[k].time_offset_s
        fits[k] = hand_eye(refined[0], refined[k], offset)
        if joint.improved:
            common_fit = hand_eye(refined[0], refined[k], offset, common_world=True)
            fits[k] = combined(fits[k], common_fit, joint.systematic(k, common_fit))
        reason = _too_uncertain(fits[k], joint.depth)
        if reason:
            reasons[k] = reason
            del fits[k]
    rows = [RigCamera(cameras[0].name, cameras[0].recording.path, np.eye(4), np.zeros((6, 6)))]
    rows += [
        RigCamera(
            cameras[k].name, cameras[k].recording.path, fit.T_a_b, fit.covariance, fit.time_offset_s
        )
        for k, fit in sorted(fits.items())
    ]
    placed = {0, *fits}
    distances = {ends: d for ends, d in joint.disagreement().items() if set(ends) <= placed}
    pairs = disagreement_rows([camera.name for camera in cameras], distances)
    unplaced = {cameras[k].name: reason for k, reason in sorted(reasons.items())}
    return Calibration(Rig(tuple(rows), pairs, unplaced), "a walk", tuple(notes))


def _initial_offset(
    cameras: Sequence[Camera], tracks: Sequence[Track], k: int, notes: list[str]
) -> float:
    """Return the initial offset to add to the timestamps of camera k.

    Raises
    ------
    RegistrationError
        If neither rotations nor timestamps determine it.
    """
    lag = clock_of(tracks[0], tracks[k]) if len(tracks[k].times) > 1 else None
    if lag is not None and lag.certain:
        if abs(lag.seconds) > _MAX_CLOCK_DIFFERENCE_S:
            notes.append(
                f"the clock of {cameras[k].name} differs by {lag.seconds:.3f} s from that of "
                f"{cameras[0].name}, by their rotations"
            )
        return lag.seconds
    if len(tracks[k].times) < 2:
        raise RegistrationError("has no trajectory", remedy="check its tracking with `tofuse run`")
    first, last = tracks[0].times[[0, -1]]
    if min(last, tracks[k].times[-1]) - max(first, tracks[k].times[0]) <= 0:
        raise RegistrationError(
            f"its timestamps begin {tracks[k].times[0] - first:+.1f} s after those of "
            f"{cameras[0].name} and don't overlap with them, and its rotation differs",
            remedy="record all cameras at the same time, and rotate the rig",
        )
    if lag is not None and lag.correlation < 0.5:
        raise RegistrationError(
            f"its rotation differs from that of {cameras[0].name}",
            remedy="record all cameras at the same time, fixed to each other",
        )
    notes.append(
        f"{cameras[k].name}: the rotation of the rig does not determine its clock; its timestamps "
        f"are assumed to be those of {cameras[0].name}"
    )
    return 0.0


def _common_world(
    cameras: Sequence[Camera], tracks: Sequence[Track], k: int, fit: HandEye
) -> HandEye:
    """Return a fit from which all views can be refined: by registered views if it is uncertain.

    The refinement is local. It would find an agreement, but not the right one, from any pose along
    a direction that the motion does not determine.

    Raises
    ------
    RegistrationError
        If the registrations do not agree either.
    """
    first, second = (
        [(tracks[c].poses[p], view) for p, view in _views(cameras[c], tracks[c], _REGISTERED)]
        for c in (0, k)
    )
    reason = _too_uncertain(fit, float(np.median([view.depth for _, view in first])))
    if not reason:
        return fit
    worlds = [
        T_first @ found.T_target_source @ se3.inverse(T_second)
        for T_first, target in first
        for T_second, source in second
        if (found := register_pair(source, target)) is not None and found.believed
    ]
    alike = ([b for b in worlds if not are_distinct_poses(a, b)] for a in worlds)
    agreeing = max(alike, key=len, default=[])
    if len(agreeing) < max(2, len(worlds) // 2 + 1):
        raise RegistrationError(reason)
    T_world_other = median_pose(np.stack(agreeing))
    _, T_first, T_second = common_poses(tracks[0], tracks[k], fit.time_offset_s)
    T_a_b = median_pose(se3.inverse(T_first) @ T_world_other @ T_second)
    return replace(fit, T_a_b=T_a_b, T_world_other=T_world_other)


def _views(camera: Camera, track: Track, count: int) -> Iterator[tuple[int, PreparedView]]:
    """Yield some views along a track, with the rows of their poses."""
    rows = evenly_spaced(np.arange(len(track.times)), count)
    frames = nearest(camera.recording.timestamps, track.times[rows])
    for p, k in zip(rows, frames, strict=True):
        frame = camera.image(int(k))
        if frame is not None:
            yield p, camera.surface(frame)


def _too_uncertain(fit: HandEye, depth: float) -> str:
    """Return why a pose is too uncertain; empty if it is not."""
    position, rotation = se3.largest_sigmas(fit.covariance).tolist()
    if position <= _MAX_SIGMA_FRACTION * depth and rotation <= _MAX_SIGMA_RAD:
        return ""
    return (
        f"the motion does not constrain its pose ({1000 * position:.0f} mm, "
        f"{np.degrees(rotation):.1f} deg); rotate the rig about two axes"
    )


class _JointViews:
    """Views of all cameras in the world of the first one.

    `rows` are the rows of the views' poses in the tracks of their cameras.
    """

    def __init__(
        self,
        tracks: dict[int, Track],
        camera: Sequence[int] = (),
        rows: Sequence[int] = (),
        views: Sequence[SampledView] = (),
    ) -> None:
        self.tracks, self._views = tracks, views
        self._camera, self._rows = np.array(camera, np.intp), np.array(rows, np.intp)
        self.improved = False
        self.depth = float(np.median([v.depth for v in views])) if views else 1.0
        self._halves: list[tuple[dict[int, Track], ...]] = []
        self._pairs = np.zeros((0, 2), np.intp)
        self._poses = np.zeros((0, 4, 4))

    @classmethod
    def of(
        cls, cameras: Sequence[Camera], tracks: Sequence[Track], fits: dict[int, HandEye]
    ) -> _JointViews:
        """Prepare views of the calibrated cameras."""
        world = {0: tracks[0]}
        for k, fit in sorted(fits.items()):
            world[k] = replace(tracks[k], poses=fit.T_world_other @ tracks[k].poses)
        camera, rows, views = [], [], []
        for k, track in world.items():
            for p, view in _views(cameras[k], track, _VIEWS):
                camera.append(k)
                rows.append(p)
                views.append(SampledView.of(view, _POINTS))
        return cls(world, camera, rows, views)

    def refined(self) -> dict[int, Track]:
        """Return the tracks in one world, after a joint refinement if that improved them."""
        ends = zip(self._camera, self._rows, strict=True)
        self._poses = np.stack([self.tracks[k].poses[row] for k, row in ends])
        first, count = self._poses[0], len(self._views)
        start = np.asarray(se3.inverse(first) @ self._poses)
        refinement = joint_alignment.refine(self._views, start, _OPTIONS)
        before, after = refinement.before.of_views(count), refinement.after.of_views(count)
        self._pairs = refinement.pairs
        # The cameras are in one world frame only if views of each and the first were compared.
        compared = {tuple(sorted(ends)) for ends in self._camera[self._pairs].tolist()}
        connected = all((0, k) in compared for k in self.tracks if k)
        if after.mean() < before.mean() or not connected:
            return dict(self.tracks)
        self.improved, self._poses = True, first @ refinement.poses
        refined = joint_alignment.RefinedViews(self._views, refinement, _OPTIONS)
        self._halves = [
            tuple(self._propagated(first @ poses) for poses in pair)
            for pair in refined_by_halves(refined)
        ]
        return self._propagated(self._poses)

    def _propagated(self, poses: Float64) -> dict[int, Track]:
        """Return the tracks that follow the refined poses of all views."""
        return {
            k: replace(
                track, poses=propagate_poses(track.poses, self._rows[of_camera], poses[of_camera])
            )
            for k, track in self.tracks.items()
            for of_camera in [self._camera == k]
        }

    def systematic(self, k: int, fit: HandEye) -> Float64:
        """Return the covariance (6, 6) of camera k from halves of the images (`split_half`).

        Distortions common to all views deform the common world, and cause no residuals.
        """
        C = np.zeros((6, 6))
        for halves in self._halves:
            xi_first, xi_second = (
                se3.log(
                    se3.inverse(fit.T_a_b)
                    @ hand_eye(tracks[0], tracks[k], fit.time_offset_s, common_world=True).T_a_b
                )
                for tracks in halves
            )
            C -= 0.5 * (np.outer(xi_first, xi_second) + np.outer(xi_second, xi_first))
        values, vectors = np.linalg.eigh(C)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, np.float64)

    def disagreement(self) -> SurfaceDistances:
        """Return the distances between the surfaces of pairs of cameras, at any time."""
        return disagreements_of(self._views, self._camera, self._poses, self._pairs)
