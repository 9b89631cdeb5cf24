"""Extrinsic calibration of a rig from recordings of any scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from threadpoolctl import threadpool_limits

from tofuse.apps.rigs.inputs import Calibration, Camera, open_cameras
from tofuse.apps.rigs.moving_rig import calibrate_moving
from tofuse.apps.rigs.static_rig import calibrate_static, is_static
from tofuse.engine.compute import threads as using_threads
from tofuse.engine.errors import InputError
from tofuse.engine.progress import Progress, Silent

Motion = Literal["auto", "still", "moving"]


def calibrate(
    recordings: Sequence[str | Path],
    *,
    names: Sequence[str] | None = None,
    motion: Motion = "auto",
    format: str | None = None,  # noqa: A002
    topic: str | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Estimate the poses of a rig's cameras from one recording of each.

    Parameters
    ----------
    recordings
        One recording per camera; the first camera defines the frame of the rig.
    names
        Names of the cameras; those of the files or folders by default.
    motion
        Whether the rig moves; "auto" detects it.
    format
        Format of the recordings; detected by default.
    topic
        Topic of the depth images in all bags; detected by default.
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
        return calibrate_cameras(open_cameras(recordings, format, names, topic), motion, progress)


def calibrate_cameras(
    cameras: Sequence[Camera], motion: Motion = "auto", progress: Progress | None = None
) -> Calibration:
    """Calibrate opened cameras; see `calibrate`."""
    progress = progress or Silent()
    progress.stage("opening")
    method = calibrate_moving if moves(cameras, motion) else calibrate_static
    calibration = method(cameras, progress)
    images = {camera.name: camera.first_image for camera in cameras}
    placed = tuple(replace(c, first_image=images[c.name]) for c in calibration.rig.cameras)
    return replace(calibration, rig=replace(calibration.rig, cameras=placed))


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
