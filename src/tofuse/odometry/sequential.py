"""Odometry of the thesis: each frame is registered to the one before (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.odometry.base import Odometry, Step, Tracker
from tofuse.parts import part
from tofuse.recordings.frames import Frame
from tofuse.registration.base import Registrar
from tofuse.registration.icp import algorithm_1
from tofuse.registration.prepared_view import PreparedView

Guess = Literal["identity", "previous", "odometry"]

# Keeps the draws of odometry apart from those of other stages that register the same pair.
SEED_STAGE = 1


@part("odometry", "sequential", label="validated")
@dataclass(frozen=True)
class Sequential(Odometry):
    """Registers each frame to the last one that has a pose, and chains the motions.

    Eqs 3.1 and 3.2, ``t = R t_new + t`` and ``R = R R_new``, as matrices:
    ``T_world_current = T_world_previous T_previous_current``. The first frame with enough points
    is the world.

    A frame is lost, without a pose, when it has too few points, when its registration fails, or
    when too few of its points correspond; the next is then registered to the last with a pose.

    Attributes
    ----------
    registration
        Registers one pair.
    guess
        Where a registration starts from (section 4.1): "identity"; "previous", the motion that
        the preceding registration found (identity at first; a lost frame leaves it as it was);
        "odometry", the motion between the poses of an odometry file (identity where either is
        missing).
    minimum_points
        Valid points that a frame must have.
    minimum_share
        Smallest share of corresponding points, 0 to 1. The thesis has no such threshold for
        neighbours; this one is low and only catches registrations that hold on to almost nothing.
    """

    registration: Registrar = field(default_factory=algorithm_1)
    guess: Guess = "identity"
    minimum_points: int = 10
    minimum_share: float = 0.02

    def __post_init__(self) -> None:
        if self.minimum_points < 1:
            raise ValueError(f"minimum_points is {self.minimum_points}, not 1 or more")
        if not 0 <= self.minimum_share <= 1:
            raise ValueError(f"minimum_share is {self.minimum_share}, not 0 to 1")

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: those of the registration."""
        return self.registration.takes

    def start(self, seed: int) -> Tracker:
        """See `Odometry.start`."""
        return _SequentialTracker(self, seed)


@dataclass(frozen=True, eq=False)
class _Tracked:
    """The last frame with a pose."""

    frame: Frame
    T_world_camera: Float64
    T_odometry: Float64 | None


class _SequentialTracker(Tracker):
    def __init__(self, options: Sequential, seed: int) -> None:
        self._options = options
        self._seed = seed
        self._last: _Tracked | None = None
        self._motion = np.eye(4)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion = np.eye(4)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`; raises nothing for frames without points."""
        options, last = self._options, self._last
        if len(frame) < options.minimum_points:
            return _lost(f"{len(frame)} valid points, {options.minimum_points} are needed")
        if last is None:
            self._last = _Tracked(frame, np.eye(4), T_odometry)
            return Step("tracked", "", np.eye(4))

        guess = self._guess(last, T_odometry)
        rng = np.random.default_rng([self._seed, SEED_STAGE, frame.index, last.frame.index])
        try:
            found = options.registration.register(frame, last.frame, guess, rng)
        except RegistrationError as error:
            return _lost(f"not registered to frame {last.frame.index}: {error}", last)
        if found.share < options.minimum_share:
            return _lost(
                f"only {found.share:.1%} of the points correspond to frame {last.frame.index}, "
                f"{options.minimum_share:.1%} are needed",
                last,
            )
        self._motion = found.T_target_source
        # Long products drift away from rotations; the nearest one is taken at each step.
        T_world_camera = se3.orthonormalise(last.T_world_camera @ found.T_target_source)
        self._last = _Tracked(frame, T_world_camera, T_odometry)
        return Step("tracked", "", T_world_camera, last.frame.index, found)

    def _guess(self, last: _Tracked, T_odometry: Float64 | None) -> Float64:
        if self._options.guess == "odometry":
            return _odometry_motion(last, T_odometry)
        return self._motion if self._options.guess == "previous" else np.eye(4)


def _lost(reason: str, last: _Tracked | None = None) -> Step:
    return Step("lost", reason, None, None if last is None else last.frame.index)


def _odometry_motion(last: _Tracked, T_odometry: Float64 | None) -> Float64:
    before = last.T_odometry
    if before is None or T_odometry is None:
        return np.eye(4)
    motion = se3.inverse(before) @ T_odometry
    return motion if np.isfinite(motion).all() else np.eye(4)
