"""The direction of gravity in each frame, from an accelerometer fixed to the camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.normal import robust_sigma

ACCELERATION = ("ax", "ay", "az")
GRAVITY = ("gravity_x", "gravity_y", "gravity_z")
# A sample is assigned to the nearest frame in time, within this distance in s.
_MAX_GAP_S = 0.25
# Largest relative deviation of the measured acceleration from its median.
_PLAUSIBLE = 0.5
# Error of the fused direction of phones, and the smallest error of any direction, rad.
_FUSED, _MIN_SIGMA = 0.01, 0.002


def gravity_at(times: Float64, imu: Mapping[str, Float64]) -> Float64 | None:
    """Return the direction of gravity in each frame, with its standard deviation.

    The accelerations of a hand-held camera change the length of the measured vector when they are
    vertical, and its direction when they are horizontal: about as much, so that the variation of
    the length predicts the error of the direction. Constant acceleration is not distinguished from
    gravity.

    Parameters
    ----------
    times
        (N,) timestamps of the frames, s.
    imu
        Columns by name: `timestamp` (s), and either the acceleration `ax`, `ay`, `az`, which is g
        upwards at rest (m/s^2 or any unit), or gravity as estimated by a phone, `gravity_x`,
        `gravity_y`, `gravity_z`, downwards; both in the axes of the depth camera.

    Returns
    -------
    (N, 4): a unit vector and its standard deviation in rad, NaN without samples near the frame's
    time; None if the columns are missing.
    """
    fused = all(name in imu for name in GRAVITY)
    names = GRAVITY if fused else ACCELERATION
    if "timestamp" not in imu or not all(name in imu for name in names) or not len(times):
        return None
    samples = np.stack([imu[name] for name in names], 1) * (1.0 if fused else -1.0)
    at = np.asarray(imu["timestamp"], float)
    good = np.isfinite(samples).all(1) & np.isfinite(at)
    samples, at = samples[good], at[good]
    out = np.full((len(times), 4), np.nan)
    if not len(at):
        return out
    owner = _nearest(np.asarray(times, float), at)
    near = np.abs(at - times[owner]) <= _MAX_GAP_S
    count = np.bincount(owner[near], minlength=len(times))
    mean = np.zeros((len(times), 3))
    np.add.at(mean, owner[near], samples[near])
    mean /= np.maximum(count, 1)[:, None]
    length = np.linalg.norm(mean, axis=1)
    known = (count > 0) & (length > 0)
    if not known.any():
        return out
    typical = float(np.median(length[known]))
    off = np.abs(length / typical - 1)
    spread = robust_sigma(off[known])
    known &= off < _PLAUSIBLE
    out[known, :3] = mean[known] / length[known, None]
    out[known, 3] = _FUSED if fused else np.sqrt(spread**2 + off[known] ** 2 + _MIN_SIGMA**2)
    return out


def _nearest(times: Float64, at: Float64) -> Intp:
    """(S,) index of the nearest of the times (N,) to each of `at` (S,); ties go to the earlier."""
    order = np.argsort(times, kind="stable")
    ordered = times[order]
    midpoints = 0.5 * (ordered[1:] + ordered[:-1])
    return order[np.searchsorted(midpoints, at, side="left")]
