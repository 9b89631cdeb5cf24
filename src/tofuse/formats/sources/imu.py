"""The direction of gravity in each frame, from an accelerometer fixed to the camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.normal import robust_sigma
from tofuse.engine.times import nearest

ACCELERATION = ("ax", "ay", "az")
GRAVITY = ("gravity_x", "gravity_y", "gravity_z")
# A sample is assigned to the nearest frame in time, within this distance in s.
_MAX_GAP_S = 0.25
# Largest relative deviation of the measured acceleration from its median.
_MAX_DEVIATION = 0.5
# Error of the fused direction of phones, and the smallest error of any direction, rad.
_FUSED_SIGMA, _MIN_SIGMA = 0.01, 0.002


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
    sample_times = np.asarray(imu["timestamp"], float)
    finite = np.isfinite(samples).all(1) & np.isfinite(sample_times)
    samples, sample_times = samples[finite], sample_times[finite]
    out = np.full((len(times), 4), np.nan)
    if not len(sample_times):
        return out
    frame_index = nearest(times, sample_times, _MAX_GAP_S)
    assigned = frame_index >= 0
    count = np.bincount(frame_index[assigned], minlength=len(times))
    mean = np.zeros((len(times), 3))
    np.add.at(mean, frame_index[assigned], samples[assigned])
    mean /= np.maximum(count, 1)[:, None]
    length = np.linalg.norm(mean, axis=1)
    valid = (count > 0) & (length > 0)
    if not valid.any():
        return out
    typical = float(np.median(length[valid]))
    deviation = np.abs(length / typical - 1)
    spread = robust_sigma(deviation[valid])
    valid &= deviation < _MAX_DEVIATION
    out[valid, :3] = mean[valid] / length[valid, None]
    out[valid, 3] = (
        _FUSED_SIGMA if fused else np.sqrt(spread**2 + deviation[valid] ** 2 + _MIN_SIGMA**2)
    )
    return out
