"""Priors of external sensors, used if they agree with tracking.

Gravity comes from an accelerometer; poses from an odometry file next to the images, or from the
recording device, such as a phone (`recordings.phones`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import POSES_BY, Recording, Source
from tofuse.engine.graph import external_sensors
from tofuse.engine.mapping.config import Config

Prior = Literal["auto", "none", "device"]


def with_prior(recording: Recording, config: Config, prior: Prior) -> tuple[Recording, Config]:
    """Return the recording and the configuration with the chosen priors.

    Parameters
    ----------
    recording, config
        The recording and its configuration.
    prior
        "none": no external sensor; "device": gravity if known, and the poses of the odometry or of
        the device; "auto": those of the configuration, and if it uses gravity, also the poses of
        the device.

    Raises
    ------
    InputError
        If the prior is "device" and the recording has no poses of its device.
    """
    if prior not in get_args(Prior):
        raise InputError(f"is {prior!r}", where="--prior", remedy="use auto, none or device")
    if prior == "none":
        return recording, replace(config, priors=())
    if any(isinstance(sensor, external_sensors.OdometryEdges) for sensor in config.priors):
        return recording, config
    uses_gravity = any(
        isinstance(sensor, external_sensors.GravityEdges) for sensor in config.priors
    )
    poses = recording.reference if POSES_BY in recording.metadata else None
    if prior == "auto" and (not uses_gravity or poses is None):
        return recording, config
    if recording.odometry is None:
        if poses is None:
            raise InputError(
                "is device, and the recording has no poses of its device",
                where="--prior",
                remedy="put an odometry.txt next to the images, or use --prior auto",
            )
        recording = with_odometry(recording, poses)
    gravity = () if uses_gravity else (external_sensors.GravityEdges(),)
    return recording, replace(
        config, priors=(*config.priors, *gravity, external_sensors.OdometryEdges())
    )


@dataclass
class _WithOdometry:
    """A source with its odometry replaced."""

    source: Source
    odometry: Float64 | None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)


def with_odometry(recording: Recording, poses: Float64) -> Recording:
    """Return the recording with poses (N, 4, 4) as its odometry."""
    source_poses = np.full((len(recording.source.timestamps), 4, 4), np.nan)
    source_poses[recording.indices] = poses
    source: Any = _WithOdometry(recording.source, source_poses)
    return replace(recording, source=source)
