"""Uncertainty of the motion prediction, which alone constrains degenerate directions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3

# Constrained dimensions that an rms needs; with fewer, sigma is a fraction of the typical motion.
_MIN_CONSTRAINED = 30.0
_MOTION_FRACTION = 0.5
# Smallest sigma of a prediction, in units of 1 cm and 1 degree.
_MIN_SIGMA = 0.1
# Directions of several frames are distinct above this fraction of the largest singular value.
_DISTINCT = 0.3
# Number of frames over which the growth of the error is estimated, and the candidates of its power:
# from that of independent steps to that of a velocity that follows a random walk. The error of a
# smooth motion grows faster over some frames, but its velocity stays bounded.
_AHEAD = 8
_POWERS = np.linspace(0.0, 2.0, 41)
# If it can't be estimated from the recording.
_DEFAULT_POWER = 2.0
# Sigma of the speed of an unobserved motion, as a fraction of the speed before it: 95 % are between
# standing still and twice as fast.
_SPEED_SIGMA = 0.5
# Number of changes of direction of which the rms is known.
_MIN_TURNS = 15


@dataclass(frozen=True)
class Prediction:
    """Error model of the constant-velocity prediction in a recording.

    Along a direction that is degenerate for n frames the camera is extrapolated. The variance of
    the position grows as the sum of k^power over the frames k = 1 to n: a power of 0 is that of
    independent steps, about 1 that of a constant velocity error, and 2 that of a velocity that
    follows a random walk.

    Attributes
    ----------
    sigma
        Rms error of one prediction along each axis: m and rad.
    power
        Power of the growth, of translation and of rotation.
    """

    sigma: tuple[float, float]
    power: tuple[float, float] = (_DEFAULT_POWER, _DEFAULT_POWER)

    @classmethod
    def of(cls, poses: Float64, unobservable: Sequence[Float64]) -> Prediction:
        """Estimate it from the constrained motions of a recording.

        If too few directions were constrained, sigma is half of the rms motion.

        Parameters
        ----------
        poses
            (N, 4, 4) T_world_camera of consecutive frames.
        unobservable
            (k, 6) degenerate directions of each frame, m and rad.
        """
        if len(poses) < 3:
            return cls((0.1, 0.1))
        motions = se3.inverse(poses[:-1]) @ poses[1:]
        squares = (se3.log(motions) / projective.UNITS).reshape(-1, 2, 3) ** 2
        typical = np.sqrt(squares.mean((0, 2)))
        rms, enough = _errors(poses, motions, unobservable, 1)
        sigma = np.maximum(np.where(enough, rms, _MOTION_FRACTION * typical), _MIN_SIGMA)
        power = (_DEFAULT_POWER, _DEFAULT_POWER)
        if len(poses) > _AHEAD + 1:
            rms_ahead, enough_ahead = _errors(poses, motions, unobservable, _AHEAD)
            ratio = np.divide(rms_ahead, rms, out=np.ones(2), where=rms > 0)
            k = np.arange(1, _AHEAD + 1)[:, None]
            exponent = np.interp(ratio**2, (k**_POWERS).sum(0), _POWERS)
            exponent = np.where(enough & enough_ahead & (rms > 0), exponent, _DEFAULT_POWER)
            power = (float(exponent[0]), float(exponent[1]))
        return cls(
            (float(sigma[0] * projective.UNITS[0]), float(sigma[1] * projective.UNITS[3])), power
        )

    def with_max_growth(self) -> Prediction:
        """Return the model whose velocity error follows a random walk."""
        return replace(self, power=(_DEFAULT_POWER, _DEFAULT_POWER))

    def error(self, run: int, frames: int) -> tuple[float, float]:
        """Return sigma of a motion along a degenerate axis, m and rad.

        Parameters
        ----------
        run
            Number of consecutive frames, up to the last of the motion, in which some direction was
            degenerate.
        frames
            Number of frames that the motion spans.
        """
        first = max(run - frames, 0)
        k = np.arange(first + 1, max(run, first + frames) + 1, dtype=float)
        (a, b), (p, q) = self.sigma, self.power
        return float(a * np.sqrt((k**p).sum())), float(b * np.sqrt((k**q).sum()))


def _errors(
    poses: Float64, motions: Float64, unobservable: Sequence[Float64], ahead: int
) -> tuple[Float64, Bool]:
    """Return rms errors of the extrapolation by `ahead` frames, of translation and rotation; (2,).

    In `UNITS`, over constrained directions; and whether there were enough of them, (2,).
    """
    last = len(poses) - ahead
    extrapolated = np.linalg.matrix_power(motions[: last - 1], ahead)
    errors = (
        se3.log(se3.inverse(poses[1:last] @ extrapolated) @ poses[1 + ahead :]) / projective.UNITS
    )
    squares, dimensions = np.zeros(2), np.zeros(2)
    for i, error in enumerate(errors, 1):
        projector = np.eye(6)
        degenerate = np.concatenate([np.zeros((0, 6)), *unobservable[i : i + ahead + 1]])
        if len(degenerate):
            basis = projective.span(degenerate, _DISTINCT)
            projector -= basis @ basis.T
        constrained = projector @ error
        t, r = constrained[:3], constrained[3:]
        squares += [t @ t, r @ r]
        dimensions += [np.trace(projector[:3, :3]), np.trace(projector[3:, 3:])]
    return np.sqrt(squares / np.maximum(dimensions, 1)), dimensions >= _MIN_CONSTRAINED


def degenerate_runs(unobservable: Sequence[Float64]) -> Intp:
    """Return for how many consecutive frames, up to each, some direction was degenerate; (N,)."""
    weak = np.array([len(u) > 0 for u in unobservable], np.intp)
    count = np.cumsum(weak)
    last_constrained = np.maximum.accumulate(np.where(weak == 0, count, 0))
    return np.asarray(count - last_constrained, np.intp)


def steps_between_bounded(
    poses: Float64, unobservable: Sequence[Float64], bounded: Bool, spans: Float64
) -> list[tuple[int, Float64]]:
    """Return how far cameras may be from poses that only those before and after them bound.

    Both ends of such a run of frames are measured. In between the speed is unknown, but for its
    scale: sigma is half of that at the ends, or of the typical one if that is higher. As far as it
    is that at the ends, it has their direction, and changes across it are those of measured motions
    (translation and rotation each). The errors of consecutive steps are alike, so that they grow in
    proportion to the time from the nearer end. Added are the error of the prediction, which grows
    at the maximum rate, and the step's difference from an even motion, as a registration may have
    moved along a degenerate direction.

    Parameters
    ----------
    poses
        (N, 4, 4) T_world_camera of consecutive frames.
    unobservable
        (k, 6) degenerate directions of each frame, m and rad.
    bounded
        (N,) whether measurements bound the pose.
    spans
        (N - 1,) time from each frame to the next, in intervals of the recording.

    Returns
    -------
    For each step of these runs: the frame k that it leads to, from frame k - 1, and the covariance
    (6, 6) of its motion, m and rad. Empty if too few steps are measured to know the speed of the
    camera.
    """
    measured = bounded[1:] & bounded[:-1]
    if 6 * np.count_nonzero(measured) < _MIN_CONSTRAINED:
        return []
    prediction = Prediction.of(poses, unobservable).with_max_growth()
    velocities = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / spans[:, None]
    velocities = velocities.reshape(-1, 2, 3)
    speeds = np.linalg.norm(velocities, axis=2)
    typical = np.sqrt((speeds[measured] ** 2).mean(0))
    known = np.flatnonzero(measured)
    steps = []
    for before, after in itertools.pairwise(known):
        k = np.arange(before + 1, after)  # steps of the run, from frame k to k + 1
        if not len(k):
            continue
        ends = np.cumsum(np.append(0.0, spans[k]))
        n = np.minimum(ends[1:], (ends[-1] - ends[:-1]))  # time from the nearer end
        speed = np.maximum(typical, speeds[[before, after]].max(0))
        growth = n**2 - np.maximum(n - spans[k], 0.0) ** 2
        share = ((ends[1:] + ends[:-1]) / (2 * ends[-1]))[:, None, None]
        even = (1 - share) * velocities[before] + share * velocities[after]
        uneven = (velocities[k] - even) * spans[k, None, None]
        turns = _turns(velocities, measured, typical, int(np.ceil(n.max())))
        for i, row in enumerate(k.tolist()):
            error = prediction.error(*np.ceil([n[i], spans[row]]).astype(int))
            blocks = [
                growth[i] * _of_speed(even[i, j], speed[j], turns[j])
                + error[j] ** 2 * np.eye(3)
                + np.outer(uneven[i, j], uneven[i, j])
                for j in range(2)
            ]
            steps.append((row + 1, block_diag(*blocks)))
    return steps


def _turns(velocities: Float64, measured: Bool, typical: Float64, ahead: int) -> Float64:
    """Return sigma of velocities (N, 2, 3) along the axes across those `ahead` steps before.

    As a fraction of the typical speeds (2,), of translation and rotation; infinite if too few pairs
    of steps are measured.
    """
    first = np.flatnonzero(measured[:-ahead] & measured[ahead:])
    if len(first) < _MIN_TURNS:
        return np.full(2, np.inf)
    before, after = velocities[first], velocities[first + ahead]
    along = (before * after).sum(2) ** 2 / np.maximum((before**2).sum(2), 1e-30)
    across = np.maximum((after**2).sum(2) - along, 0.0)
    return np.asarray(np.sqrt(across.mean(0) / 2) / np.maximum(typical, 1e-12), np.float64)


def _of_speed(even: Float64, speed: float, turn: float) -> Float64:
    """Return the covariance (3, 3) of an unobserved velocity of some speed about an even one (3,).

    `turn` is sigma across the even one, as a fraction of the speed; what the even one lacks of the
    speed may have any direction.
    """
    known = float(np.linalg.norm(even))
    rest = max(1 - known / max(speed, 1e-12), 0.0)
    across = min(_SPEED_SIGMA, float(np.hypot(turn, _SPEED_SIGMA * rest))) ** 2
    along = (_SPEED_SIGMA**2 - across) * np.outer(even, even) / max(known, 1e-12) ** 2
    return np.asarray(speed**2 * (across * np.eye(3) + along), np.float64)


def with_prediction(
    information: Float64, unobservable: Float64, sigma: tuple[float, float]
) -> Float64:
    """Return the information of a registration, with that of the prediction along degenerate axes.

    There it replaces the prior of the alignment, which is that of any prediction.

    Parameters
    ----------
    information
        (6, 6) of the registration.
    unobservable
        (k, 6) degenerate unit directions, m and rad.
    sigma
        Of the prediction, m and rad.
    """
    if not len(unobservable):
        return information
    basis, _ = np.linalg.qr((unobservable / projective.UNITS).T)
    variance = (np.repeat(sigma, 3) / projective.UNITS) ** 2
    units = np.outer(projective.UNITS, projective.UNITS)
    predicted = basis @ np.linalg.inv(basis.T @ (variance[:, None] * basis)) @ basis.T
    measured = projective.with_free_directions(information * units, basis)
    return np.asarray((measured + predicted) / units, np.float64)
