"""Paths of cameras and objects: poses as functions of time, with continuous velocity."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3

Path = Callable[[float], Float64]


def look_at(position: ArrayLike, target: ArrayLike) -> Float64:
    """T_room_camera (4, 4) of a camera at `position` facing `target`, in a room with z up."""
    p = np.asarray(position, float)
    z = np.asarray(target, float) - p
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    return se3.pose(np.stack([x, np.cross(z, x), z], 1), p)


def still(T: Float64) -> Path:
    """Constant pose T (4, 4)."""
    return lambda _t: T.copy()


def turn_angle(t: float, seconds: float) -> float:
    """Angle in rad of a full turn by hand: exactly 2 pi at `seconds`, at nearly even speed.

    The speed deviates from its mean by 2 % at most. The angle continues before 0 and after the end.
    """
    u = t / seconds
    return float(2 * np.pi * u + 0.02 / 3 * np.sin(3 * 2 * np.pi * u))


def camera_turn(T_room_camera: Float64, seconds: float, axis_offset_m: float = 0.0) -> Path:
    """Rotate the camera about its own vertical (y) axis, to the right.

    `axis_offset_m` is the distance of the optical centre in front of the stand's axis.
    """
    arm = se3.translation((0, 0, axis_offset_m))
    stand = T_room_camera @ se3.inverse(arm)

    def path(t: float) -> Float64:
        return stand @ rotation([0, turn_angle(t, seconds), 0]) @ arm

    return path


def object_turn(seconds: float) -> Path:
    """Rotate an object about the z axis of its frame, which is at the room's origin."""
    return lambda t: rotation([0, 0, turn_angle(t, seconds)])


def rotation(w: ArrayLike) -> Float64:
    """Rotation (4, 4) by a rotation vector (3,) in rad."""
    return se3.pose(se3.so3_exp(w))


def smooth_step(u: float) -> float:
    """Minimum-jerk profile from 0 at u = 0 to 1 at u = 1."""
    u = min(max(u, 0.0), 1.0)
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


def out_and_back(T_room_camera: Float64, length_m: float, seconds: float) -> Path:
    """Translate along the camera's +x axis by `length_m` and back, faster on the way out."""
    out = 0.38 * seconds

    def path(t: float) -> Float64:
        progress = smooth_step(t / out) - smooth_step((t - out) / (seconds - out))
        return T_room_camera @ se3.translation((length_m * progress, 0, 0))

    return path


def sway(T_room_camera: Float64, twist: ArrayLike, seconds: float) -> Path:
    """Move along a twist (tx ty tz rx ry rz) and back within `seconds`, as a sine."""
    xi = np.asarray(twist, float)
    return lambda t: T_room_camera @ se3.exp(xi * (0.5 - 0.5 * np.cos(2 * np.pi * t / seconds)))
