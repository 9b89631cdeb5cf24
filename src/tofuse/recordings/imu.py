"""Which way is down in each frame, as an accelerometer beside the camera tells."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tofuse.arrays import Float64, Intp

ACCELERATION = ("ax", "ay", "az")
GRAVITY = ("gravity_x", "gravity_y", "gravity_z")
# A sample belongs to the frame that is nearest in time, if it is no further than this, s.
_REACH_S = 0.25
# Of the lengths of what was measured, the largest share that a still camera's may vary by.
_PLAUSIBLE = 0.5
# A fused direction, as phones give it, and the least error of any, rad.
_FUSED, _LEAST = 0.01, 0.002


def gravity_at(times: Float64, imu: Mapping[str, Float64]) -> Float64 | None:
    """Direction in which things fall in the frame of each camera, and how well it is known.

    A camera that is moved by hand is accelerated to and fro. Along the vertical that changes the
    length of what is measured, across it the direction: about as much, so that one tells of the
    other. Acceleration that lasts is not told from gravity.

    Parameters
    ----------
    times
        (N,) of the frames, s.
    imu
        Columns by name: `timestamp` (s), and either `ax`, `ay`, `az`, which at rest is g upwards
        (m/s^2 or any unit), or `gravity_x`, `gravity_y`, `gravity_z`, downwards, where a phone
        has worked that out by itself; both along the axes of the depth camera.

    Returns
    -------
    (N, 4): a unit vector and its standard deviation in rad, NaN where nothing was measured near
    the frame's time; None where the columns are not there, or make no sense.
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
    near = np.abs(at - times[owner]) <= _REACH_S
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
    spread = 1.4826 * float(np.median(off[known]))
    known &= off < _PLAUSIBLE
    out[known, :3] = mean[known] / length[known, None]
    out[known, 3] = _FUSED if fused else np.sqrt(spread**2 + off[known] ** 2 + _LEAST**2)
    return out


def _nearest(times: Float64, at: Float64) -> Intp:
    """(S,) which of the times each of `at` is nearest to, the earlier one of two."""
    order = np.argsort(times, kind="stable")
    ordered = times[order]
    middle = 0.5 * (ordered[1:] + ordered[:-1])
    return order[np.searchsorted(middle, at, side="left")]
