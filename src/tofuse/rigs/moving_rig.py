"""Calibration of a moving rig: cameras are tracked separately, and their trajectories aligned.

No two cameras need to overlap at any instant. Views of the same place at different times are used
in a joint refinement of all views, once the trajectories are in one world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.errors import InputError, RegistrationError
from tofuse.geometry import se3
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.reconstruct import reconstruct
from tofuse.posegraph.joint_alignment import refine
from tofuse.posegraph.pair_equations import RefineOptions
from tofuse.posegraph.pose_priors import Priors
from tofuse.posegraph.refinement import followed
from tofuse.posegraph.split_half import refined_by_halves
from tofuse.posegraph.view_store import SampledView
from tofuse.results.types import Reconstruction
from tofuse.rigs.hand_eye import HandEye, Track, clock_of, combined, hand_eye
from tofuse.rigs.inputs import Camera
from tofuse.rigs.joint import disagreements_of

# Views of each camera that are refined jointly, and their points.
_VIEWS, _POINTS = 70, 1500
# Largest difference of clocks of one rig, s, unless the rotations of the cameras correlate.
_SAME_CLOCK_S = 0.5
# Largest sigma of a placed camera: fraction of the depth, and rad.
_MAX_SIGMA_FRACTION, _MAX_SIGMA_RAD = 0.05, float(np.radians(4.0))
_OPTIONS = RefineOptions(neighbours=16)


@dataclass(frozen=True, eq=False)
class MovingRig:
    """The calibration of a moving rig.

    Attributes
    ----------
    results
        The reconstruction of each camera by itself.
    tracks
        Trajectories of the cameras in one world, by camera; of those not placed, in their own.
    fits
        Calibration of each camera but the first relative to the first, by camera.
    reasons
        Why a camera is not placed, by camera.
    disagreement
        By pair of cameras (a, b), a < b: median distance between their surfaces, at any time, in
        m, and the number of compared pixels.
    notes
        Messages for the user.
    """

    results: tuple[Reconstruction, ...]
    tracks: dict[int, Track]
    fits: dict[int, HandEye]
    reasons: dict[int, str]
    disagreement: dict[tuple[int, int], tuple[float, int]]
    notes: tuple[str, ...]


def calibrate_moving(cameras: Sequence[Camera], progress: Progress) -> MovingRig:
    """Track each camera, fit the trajectories to each other, and refine all views together.

    Raises
    ------
    InputError
        If the first camera has no trajectory.
    """
    results, tracks = [], []
    for camera in cameras:
        progress.stage(f"tracking {camera.name}")
        result = reconstruct(camera.recording, progress=Silent())
        results.append(result)
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
            offset = _clock(cameras, tracks, k, notes)
            fits[k] = hand_eye(tracks[0], tracks[k], offset)
        except RegistrationError as error:
            reasons[k] = str(error)
    progress.stage("refining")
    together = _Together.of(cameras, tracks, fits)
    moved = together.refined()
    for k in list(fits):
        offset = fits[k].time_offset_s
        fits[k] = hand_eye(moved[0], moved[k], offset)
        if together.kept:
            common = hand_eye(moved[0], moved[k], offset, one_world=True)
            more = together.systematic(k, common)
            fits[k] = combined(fits[k], replace(common, covariance=common.covariance + more))
        why = _too_uncertain(fits[k], together.depth)
        if why:
            reasons[k] = why
            del fits[k]
    placed = {0, *fits}
    return MovingRig(
        tuple(results),
        {k: moved.get(k, tracks[k]) for k in range(len(cameras))},
        fits,
        reasons,
        {ends: found for ends, found in together.disagreement().items() if set(ends) <= placed},
        tuple(notes),
    )


def _clock(cameras: Sequence[Camera], tracks: Sequence[Track], k: int, notes: list[str]) -> float:
    """Return the initial offset to add to the timestamps of camera k.

    Raises
    ------
    RegistrationError
        If neither rotations nor timestamps determine it.
    """
    lag = clock_of(tracks[0], tracks[k]) if len(tracks[k].times) > 1 else None
    if lag is not None and lag.certain:
        if abs(lag.seconds) > _SAME_CLOCK_S:
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


def _too_uncertain(fit: HandEye, depth: float) -> str:
    """Return why a pose is too uncertain; empty if it is not."""
    position, rotation = (
        float(np.sqrt(max(np.linalg.eigvalsh(fit.covariance[part, part])[-1], 0)))
        for part in (slice(3), slice(3, 6))
    )
    if position <= _MAX_SIGMA_FRACTION * depth and rotation <= _MAX_SIGMA_RAD:
        return ""
    return (
        f"the motion does not constrain its pose ({1000 * position:.0f} mm, "
        f"{np.degrees(rotation):.1f} deg); rotate the rig about two axes"
    )


@dataclass(frozen=True, eq=False)
class _Kept:
    """Views of one camera, and the positions of their poses in its track."""

    at: Intp
    views: tuple[SampledView, ...]


class _Together:
    """Views of all cameras in the world of the first one."""

    def __init__(
        self, tracks: dict[int, Track], kept: dict[int, _Kept], fits: dict[int, HandEye]
    ) -> None:
        self.tracks, self._kept = tracks, kept
        self.kept = False
        self._fits = fits
        views = [v for k in sorted(kept) for v in kept[k].views]
        self.depth = float(np.median([v.depth for v in views])) if views else 1.0
        self._halves: list[tuple[dict[int, Track], ...]] = []
        self._pairs = np.zeros((0, 2), np.intp)
        self._poses = np.zeros((0, 4, 4))

    @classmethod
    def of(
        cls, cameras: Sequence[Camera], tracks: Sequence[Track], fits: dict[int, HandEye]
    ) -> _Together:
        """Prepare views of the calibrated cameras."""
        world = {0: tracks[0]}
        for k, fit in fits.items():
            world[k] = replace(tracks[k], poses=fit.T_world_other @ tracks[k].poses)
        kept = {}
        for k, track in world.items():
            at, views = [], []
            for p in np.unique(np.linspace(0, len(track.times) - 1, _VIEWS).round().astype(int)):
                row = int(np.searchsorted(cameras[k].recording.timestamps, track.times[p]))
                frame = cameras[k].image(row)
                if frame is not None:
                    at.append(p)
                    views.append(SampledView.of(cameras[k].surface(frame), _POINTS))
            kept[k] = _Kept(np.array(at, np.intp), tuple(views))
        return cls(world, kept, fits)

    def refined(self) -> dict[int, Track]:
        """Return the tracks in one world, after a joint refinement if that improved them."""
        order = sorted(self._kept)
        views = [v for k in order for v in self._kept[k].views]
        poses = np.concatenate([self.tracks[k].poses[self._kept[k].at] for k in order])
        first = poses[0]
        done = refine(views, np.asarray(se3.inverse(first) @ poses), _OPTIONS)
        count = len(views)
        before, after = done.before.of_views(count), done.after.of_views(count)
        camera = np.repeat(order, [len(self._kept[k].views) for k in order])
        # One world only where views of both cameras of a pair were compared.
        across = {tuple(sorted(ends)) for ends in camera[done.pairs].tolist()}
        joined = all((0, k) in across for k in order if k)
        self._pairs, self._poses = done.pairs, first @ done.poses
        self._camera = camera
        if after.mean() < before.mean() or not joined:
            self._poses = poses
            return dict(self.tracks)
        self.kept = True
        self._halves = [
            tuple(self._moved(first @ poses) for poses in pair)
            for pair in refined_by_halves(views, done, _OPTIONS, Priors.none())
        ]
        return self._moved(self._poses)

    def _moved(self, poses: Float64) -> dict[int, Track]:
        """Return the tracks that follow the refined poses of all views."""
        start, moved = 0, {}
        for k in sorted(self._kept):
            own = self._kept[k]
            new = poses[start : start + len(own.views)]
            start += len(own.views)
            moved[k] = replace(self.tracks[k], poses=followed(self.tracks[k].poses, own.at, new))
        return moved

    def systematic(self, k: int, fit: HandEye) -> Float64:
        """Return the covariance (6, 6) of camera k shown by halves of the images (`split_half`).

        Distortions that all views share bend the common world, and leave no residuals.
        """
        C = np.zeros((6, 6))
        for halves in self._halves:
            one, other = (
                se3.log(
                    se3.inverse(fit.T_a_b)
                    @ hand_eye(tracks[0], tracks[k], fit.time_offset_s, one_world=True).T_a_b
                )
                for tracks in halves
            )
            C -= 0.5 * (np.outer(one, other) + np.outer(other, one))
        values, vectors = np.linalg.eigh(C)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, np.float64)

    def disagreement(self) -> dict[tuple[int, int], tuple[float, int]]:
        """See `MovingRig`."""
        views = [v for k in sorted(self._kept) for v in self._kept[k].views]
        return disagreements_of(views, self._camera, self._poses, self._pairs)
