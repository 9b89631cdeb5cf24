"""A simulated accelerometer on the camera: gravity, motion, bias and noise."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.lab.world import Sequence

GRAVITY = 9.81
RATE_HZ = 100.0
# Of a phone: noise per sample, and scale of the bias (constant over a recording), m/s^2.
_NOISE, _BIAS = 0.03, 0.08


def accelerations(sequence: Sequence, start: float, end: float, seed: int) -> dict[str, Float64]:
    """Columns of an imu.csv: `timestamp` (s) and `ax`, `ay`, `az` (m/s^2, the camera's axes).

    Specific force: at rest g upwards, which is z in rooms.
    """
    rng = np.random.default_rng([seed, 11])
    times = np.arange(start, end + 0.5 / RATE_HZ, 1 / RATE_HZ)
    bias = _BIAS * rng.standard_normal(3)
    h = 0.5 / RATE_HZ
    out = np.empty((len(times), 3))
    for k, t in enumerate(times):
        previous, pose, following = (sequence.T_room_camera(t + d) for d in (-h, 0.0, h))
        specific_force = (previous[:3, 3] - 2 * pose[:3, 3] + following[:3, 3]) / h**2
        specific_force[2] += GRAVITY
        out[k] = pose[:3, :3].T @ specific_force
    out += bias + _NOISE * rng.standard_normal(out.shape)
    return {"timestamp": times, "ax": out[:, 0], "ay": out[:, 1], "az": out[:, 2]}
