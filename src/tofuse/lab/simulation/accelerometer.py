"""A simulated accelerometer on the camera: gravity, motion, bias and noise."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.lab.simulation.scene import Sequence

GRAVITY = 9.81
RATE_HZ = 100.0
# Of a phone's: noise per sample, and bias, constant over a recording, m/s^2.
_NOISE, _ZERO = 0.03, 0.08


def accelerations(sequence: Sequence, start: float, end: float, seed: int) -> dict[str, Float64]:
    """Columns of an imu.csv: `timestamp` (s) and `ax`, `ay`, `az` (m/s^2, the camera's axes).

    At rest it measures g upwards. Rooms have z up.
    """
    rng = np.random.default_rng([seed, 11])
    times = np.arange(start, end + 0.5 / RATE_HZ, 1 / RATE_HZ)
    zero = _ZERO * rng.standard_normal(3)
    h = 0.5 / RATE_HZ
    out = np.empty((len(times), 3))
    for k, t in enumerate(times):
        before, here, after = (sequence.T_room_camera(t + d) for d in (-h, 0.0, h))
        felt = (before[:3, 3] - 2 * here[:3, 3] + after[:3, 3]) / h**2
        felt[2] += GRAVITY
        out[k] = here[:3, :3].T @ felt
    out += zero + _NOISE * rng.standard_normal(out.shape)
    return {"timestamp": times, "ax": out[:, 0], "ay": out[:, 1], "az": out[:, 2]}
