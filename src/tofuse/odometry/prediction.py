"""How well a motion predicts the next one: what degenerate directions are known by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.arrays import Bool, Float64, Intp
from tofuse.geometry import se3
from tofuse.registration.projective import UNITS, span

# Constrained dimensions from which an rms is measured; below, motions are known by a share.
_LEAST_CONSTRAINED = 30.0
_SHARE = 0.5
# In units of 1 cm and 1 degree: no prediction is taken to be better.
_LEAST = 0.1
# Directions of several frames are different ones above this share of the strongest.
_DISTINCT = 0.3
# Frames over which the growth of the error is measured, and the powers between which it is sought:
# of independent steps, and of a velocity that does a random walk. A smooth motion is lost faster
# over some frames, but its velocity stays bounded.
_AHEAD = 8
_POWERS = np.linspace(0.0, 2.0, 41)
# Where the recording does not show it.
_USUAL_POWER = 2.0


@dataclass(frozen=True)
class Prediction:
    """How well the motion before predicts the next ones of a recording.

    Where a degenerate direction is not measured for n frames, the camera is where its velocity took
    it. The variance of that grows as the sum of k^power over the frames k = 1 to n: as that of
    independent steps for a power of 0, as that of a velocity error that stays for about 1, and as
    that of a velocity that does a random walk for 2.

    Attributes
    ----------
    sigma
        Rms error of one prediction, of each component: m and rad.
    power
        Of the growth, of translation and of rotation.
    """

    sigma: tuple[float, float]
    power: tuple[float, float] = (_USUAL_POWER, _USUAL_POWER)

    @classmethod
    def of(cls, poses: Float64, unobservable: Sequence[Float64]) -> Prediction:
        """Measure it where the motion was constrained.

        Where hardly any direction was, sigma is half of the typical motion.

        Parameters
        ----------
        poses
            (N, 4, 4) T_world_camera of frames in a row.
        unobservable
            Of each frame, (k, 6) degenerate directions, m and rad.
        """
        if len(poses) < 3:
            return cls((0.1, 0.1))
        motions = se3.inverse(poses[:-1]) @ poses[1:]
        typical = np.sqrt((se3.log(motions) / UNITS).reshape(-1, 2, 3) ** 2).mean((0, 2))
        one, known = _errors(poses, motions, unobservable, 1)
        sigma = np.maximum(np.where(known, one, _SHARE * typical), _LEAST)
        power = (_USUAL_POWER, _USUAL_POWER)
        if len(poses) > _AHEAD + 1:
            later, known_later = _errors(poses, motions, unobservable, _AHEAD)
            ratio = np.divide(later, one, out=np.ones(2), where=one > 0)
            k = np.arange(1, _AHEAD + 1)[:, None]
            found = np.interp(ratio**2, (k**_POWERS).sum(0), _POWERS)
            found = np.where(known & known_later & (one > 0), found, _USUAL_POWER)
            power = (float(found[0]), float(found[1]))
        return cls((float(sigma[0] * UNITS[0]), float(sigma[1] * UNITS[3])), power)

    def at_worst(self) -> Prediction:
        """The same, with errors that grow as fast as those of a random walk."""
        return replace(self, power=(_USUAL_POWER, _USUAL_POWER))

    def error(self, run: int, frames: int) -> tuple[float, float]:
        """Sigma of each component of a motion in a degenerate direction, m and rad.

        Parameters
        ----------
        run
            For how many frames in a row, the last of these included, a direction was degenerate.
        frames
            Over how many frames the motion is.
        """
        first = max(run - frames, 0)
        k = np.arange(first + 1, max(run, first + frames) + 1, dtype=float)
        (a, b), (p, q) = self.sigma, self.power
        return float(a * np.sqrt((k**p).sum())), float(b * np.sqrt((k**q).sum()))


def _errors(
    poses: Float64, motions: Float64, unobservable: Sequence[Float64], ahead: int
) -> tuple[Float64, Bool]:
    """Rms error of going on by a motion for some frames, of translation and rotation; (2,) each.

    In `UNITS`, over constrained directions, and whether there were enough of them.
    """
    last = len(poses) - ahead
    going_on = np.linalg.matrix_power(motions[: last - 1], ahead)
    errors = se3.log(se3.inverse(poses[1:last] @ going_on) @ poses[1 + ahead :]) / UNITS
    squares, dimensions = np.zeros(2), np.zeros(2)
    for i, error in enumerate(errors, 1):
        P = np.eye(6)
        weak = np.concatenate([np.zeros((0, 6)), *unobservable[i : i + ahead + 1]])
        if len(weak):
            u = span(weak, _DISTINCT)
            P -= u @ u.T
        seen = P @ error
        squares += [seen[:3] @ seen[:3], seen[3:] @ seen[3:]]
        dimensions += [np.trace(P[:3, :3]), np.trace(P[3:, 3:])]
    return np.sqrt(squares / np.maximum(dimensions, 1)), dimensions >= _LEAST_CONSTRAINED


def runs(unobservable: Sequence[Float64]) -> Intp:
    """For how many frames in a row, this one included, some direction was degenerate; (N,)."""
    weak = np.array([len(u) > 0 for u in unobservable], np.intp)
    count = np.cumsum(weak)
    last_constrained = np.maximum.accumulate(np.where(weak == 0, count, 0))
    return np.asarray(count - last_constrained, np.intp)


def with_prediction(
    information: Float64, unobservable: Float64, sigma: tuple[float, float]
) -> Float64:
    """Information (6, 6) of a registration and of the prediction where the data is degenerate.

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
