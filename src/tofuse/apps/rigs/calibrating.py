"""Extrinsic calibration of a rig from recordings of any scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from threadpoolctl import threadpool_limits

from tofuse.apps.rigs.checking import CameraMotion, compare_in_scene
from tofuse.apps.rigs.inputs import Calibration, Camera, open_cameras
from tofuse.apps.rigs.moving_rig import calibrate_moving
from tofuse.apps.rigs.static_rig import calibrate_static, is_static
from tofuse.engine.compute import threads as using_threads
from tofuse.engine.errors import InputError
from tofuse.engine.progress import Progress, Silent
from tofuse.formats.rigs import Rig

Motion = Literal["auto", "still", "moving"]


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
        return calibrate_cameras(open_cameras(recordings, format), motion, progress)


def calibrate_cameras(
    cameras: Sequence[Camera], motion: Motion = "auto", progress: Progress | None = None
) -> Calibration:
    """Calibrate opened cameras; see `calibrate`."""
    progress = progress or Silent()
    progress.stage("opening")
    return (calibrate_moving if moves(cameras, motion) else calibrate_static)(cameras, progress)


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
        calibration = calibrate_cameras(cameras, motion, progress)
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
