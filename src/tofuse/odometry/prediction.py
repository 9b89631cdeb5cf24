"""How well a motion predicts the next one: what directions that nothing held are known by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.registration.projective import UNITS

Float64 = NDArray[np.float64]

# Dimensions of held motion from which a rms is told; below, motions are known by a share.
_LEAST_HELD = 30.0
_SHARE = 0.5
# In units of 1 cm and 1 degree: no prediction is taken to be better.
_LEAST = 0.1


def prediction_sigma(poses: Float64, unobservable: Sequence[Float64]) -> tuple[float, float]:
    """Rms by which a motion differed from the one before, m and rad, where it was measured.

    Parameters
    ----------
    poses
        (N, 4, 4) T_world_camera of frames in a row.
    unobservable
        Of each frame, (k, 6) unit directions that its data did not hold.

    Returns
    -------
    sigma of translation (m) and of rotation (rad), of each component. Where hardly any direction
    was ever held, it is half of the typical motion.
    """
    if len(poses) < 3:
        return 0.1, 0.1
    motions = se3.inverse(poses[:-1]) @ poses[1:]
    surprise = se3.log(se3.inverse(motions[:-1]) @ motions[1:]) / UNITS
    squares, held = np.zeros(2), np.zeros(2)
    for d, weak in zip(surprise, unobservable[2:], strict=True):
        P = np.eye(6)
        if len(weak):
            scaled = weak / UNITS
            q, _ = np.linalg.qr(scaled.T)
            P -= q @ q.T
        seen = P @ d
        squares += [seen[:3] @ seen[:3], seen[3:] @ seen[3:]]
        held += [np.trace(P[:3, :3]), np.trace(P[3:, 3:])]
    typical = np.sqrt((se3.log(motions) / UNITS).reshape(-1, 2, 3) ** 2).mean((0, 2))
    rms = np.where(held >= _LEAST_HELD, np.sqrt(squares / np.maximum(held, 1)), _SHARE * typical)
    rms = np.maximum(rms, _LEAST)
    return float(rms[0] * UNITS[0]), float(rms[1] * UNITS[3])


def runs(unobservable: Sequence[Float64]) -> NDArray[np.intp]:
    """For how many frames in a row, this one included, some direction was degenerate; (N,)."""
    weak = np.array([len(u) > 0 for u in unobservable], np.intp)
    count = np.cumsum(weak)
    last_constrained = np.maximum.accumulate(np.where(weak == 0, count, 0))
    return np.asarray(count - last_constrained, np.intp)


def growth(run: int, frames: int) -> float:
    """How many times the error of one prediction the motion over some frames is off by.

    The velocity is what is extrapolated. Where nothing measures it, it does a random walk, and
    after n frames the position is off by the root of the sum of squares 1 to n: as much as if the
    k-th of n independent motions were off by k times the error of one prediction.

    Parameters
    ----------
    run
        For how many frames in a row, the last of these included, a direction was degenerate.
    frames
        Over how many frames the motion is.
    """
    first = max(run - frames, 0)
    k = np.arange(first + 1, max(run, first + frames) + 1, dtype=float)
    return float(np.sqrt((k * k).sum()))


def with_prediction(
    information: Float64, unobservable: Float64, sigma: tuple[float, float]
) -> Float64:
    """Information (6, 6) of a registration and of the prediction where the data held nothing.

    Parameters
    ----------
    unobservable
        (k, 6) unit directions, m and rad.
    sigma
        Of the prediction, m and rad.
    """
    if not len(unobservable):
        return information
    q, _ = np.linalg.qr((unobservable / UNITS).T)
    variance = (np.repeat(sigma, 3) / UNITS) ** 2
    known = q @ np.linalg.inv(q.T @ (variance[:, None] * q)) @ q.T
    return np.asarray(information + known / np.outer(UNITS, UNITS), np.float64)
