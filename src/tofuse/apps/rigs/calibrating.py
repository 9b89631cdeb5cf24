"""Extrinsic calibration of a rig from recordings of any scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.rigs.checking import CameraMotion, compare_in_scene
from tofuse.apps.rigs.inputs import Camera, open_cameras
from tofuse.apps.rigs.moving_rig import MovingRig, calibrate_moving
from tofuse.apps.rigs.static_rig import StaticRig, calibrate_static, is_static
from tofuse.engine.compute import threads as using_threads
from tofuse.engine.errors import InputError
from tofuse.engine.progress import Progress, Silent
from tofuse.formats.rigs import Disagreement, Rig, RigCamera

Motion = Literal["auto", "still", "moving"]


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a rig calibration.

    Attributes
    ----------
    rig
        The placed cameras; those that could not be placed are in its `unplaced`.
    how
        "one instant", "n instants", or "a walk".
    notes
        Notes for the user.
    """

    rig: Rig
    how: str
    notes: tuple[str, ...] = ()


def calibrate(
    recordings: Sequence[str | Path],
    *,
    motion: Motion = "auto",
    format: str | None = None,  # noqa: A002
    threads: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Estimate the poses of a rig's cameras from one recording of each.

    Parameters
    ----------
    recordings
        One recording per camera; the first camera defines the frame of the rig.
    motion
        Whether the rig moves; "auto" detects it.
    format
        Format of the recordings; detected by default.
    threads
        Number of threads; None: all cores.
    progress
        Receives the names of the stages.

    Raises
    ------
    InputError
        If a recording can't be used, or no camera can be placed relative to the first one.
    """
    with using_threads(threads), threadpool_limits(1):
        cameras = open_cameras(recordings, format)
        return calibrate_cameras(cameras, recordings, motion, progress or Silent())


def calibrate_cameras(
    cameras: Sequence[Camera],
    paths: Sequence[str | Path],
    motion: Motion = "auto",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate opened cameras; see `calibrate`."""
    progress = progress or Silent()
    progress.stage("opening")
    if not moves(cameras, motion):
        return _from_static(cameras, paths, calibrate_static(cameras, progress))
    return _from_moving(cameras, paths, calibrate_moving(cameras, progress))


def check(
    rig: Rig,
    recordings: Sequence[str | Path],
    *,
    motion: Motion = "auto",
    format: str | None = None,  # noqa: A002
    threads: int | None = None,
    progress: Progress | None = None,
) -> tuple[Calibration, list[CameraMotion]]:
    """Recalibrate a rig, from one recording of each camera in the rig's order, and compare.

    Raises
    ------
    InputError
        If a recording can't be used, or their number differs from that of the cameras.
    """
    with using_threads(threads), threadpool_limits(1):
        cameras = cameras_of([c.name for c in rig.cameras], recordings, format)
        calibration = calibrate_cameras(cameras, recordings, motion, progress or Silent())
    return calibration, compare_in_scene(rig, calibration.rig)


def cameras_of(
    names: Sequence[str],
    recordings: Sequence[str | Path],
    format: str | None = None,  # noqa: A002
) -> list[Camera]:
    """Open the recordings of a rig's cameras, given in the order of their names.

    Raises
    ------
    InputError
        If their number differs from that of the cameras, or one can't be opened.
    """
    if len(recordings) != len(names):
        raise InputError(
            f"has {len(names)} cameras ({', '.join(names)}), "
            f"and {len(recordings)} recordings are given",
            where="the rig",
            remedy="pass one recording for each, in this order",
        )
    opened = open_cameras(recordings, format)
    return [replace(camera, name=name) for camera, name in zip(opened, names, strict=True)]


def moves(cameras: Sequence[Camera], motion: Motion) -> bool:
    """Whether the rig moves.

    Raises
    ------
    InputError
        If only some cameras move, so that they are not rigidly connected.
    """
    if motion != "auto":
        return motion == "moving"
    static = [is_static(camera) for camera in cameras]
    if any(static) and not all(static):
        names = [c.name for c, s in zip(cameras, static, strict=True) if s]
        raise InputError(
            f"{' and '.join(names)} stood still while other cameras moved",
            where="the rig",
            remedy="pass recordings of cameras that are fixed to each other, or set the motion "
            "with --motion still or --motion moving",
        )
    return not all(static)


def disagreement_rows(
    names: Sequence[str], distances: Mapping[tuple[int, int], tuple[float, int]]
) -> tuple[Disagreement, ...]:
    """Return the distances between the surfaces of pairs of cameras with their names, in order."""
    return tuple(
        Disagreement(names[a], names[b], median, pixels)
        for (a, b), (median, pixels) in sorted(distances.items())
    )


def _from_static(
    cameras: Sequence[Camera], paths: Sequence[str | Path], estimate: StaticRig
) -> Calibration:
    names = [camera.name for camera in cameras]
    refined = estimate.refined
    rows = tuple(
        RigCamera(
            names[c],
            str(paths[c]),
            refined.poses[k],
            refined.covariance[k][:6, :6],
            float(estimate.time_offsets[c]),
            -float(refined.offsets[k]),
            refined.random_covariance[k][:6, :6],
        )
        for k, c in enumerate(estimate.cameras)
    )
    pairs = disagreement_rows([names[c] for c in estimate.cameras], refined.disagreement)
    unplaced = {names[c]: reason for c, reason in sorted(estimate.placement.reasons.items())}
    how = "one instant" if estimate.instants == 1 else f"{estimate.instants} instants"
    return Calibration(Rig(rows, pairs, unplaced), how, estimate.notes)


def _from_moving(
    cameras: Sequence[Camera], paths: Sequence[str | Path], estimate: MovingRig
) -> Calibration:
    names = [camera.name for camera in cameras]
    rows = [RigCamera(names[0], str(paths[0]), np.eye(4), np.zeros((6, 6)))]
    rows += [
        RigCamera(names[k], str(paths[k]), fit.T_a_b, fit.covariance, fit.time_offset_s)
        for k, fit in sorted(estimate.fits.items())
    ]
    pairs = disagreement_rows(names, estimate.disagreement)
    unplaced = {names[k]: reason for k, reason in sorted(estimate.reasons.items())}
    return Calibration(Rig(tuple(rows), pairs, unplaced), "a walk", estimate.notes)
