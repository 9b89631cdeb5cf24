"""Odometry of the thesis: each frame is registered to the one before (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from tofuse.engine.alignment import Registrar
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp import algorithm_1
from tofuse.engine.parts import part
from tofuse.engine.search import SearchOptions
from tofuse.engine.tracking.base import Guess, Odometry, Step, Tracker
from tofuse.engine.views import PreparedView

# Seeds the random draws of odometry differently from other stages that register the same pair.
SEED_STAGE = 1


@part("odometry", "sequential", label="validated")
@dataclass(frozen=True)
class Sequential(Bounded, Odometry):
    """Registers each frame to the last one that has a pose, and chains the motions.

    Eqs 3.1 and 3.2, ``t = R t_new + t`` and ``R = R R_new``, as matrices:
    ``T_world_current = T_world_previous T_previous_current``. The first frame with enough points
    defines the world frame.

    A frame is lost, without a pose, when it has too few points, when its registration fails, or
    when too few of its points correspond; the next is then registered to the last with a pose.

    Attributes
    ----------
    registration
        Registers one pair.
    guess
        Initial guess of a registration (section 4.1): "identity"; "previous", the motion of the
        preceding registration (identity at first; a lost frame does not change it); "odometry",
        the motion between the poses of an odometry file (identity where either is missing).
    minimum_points
        Valid points that a frame must have.
    min_inlier_ratio
        Smallest inlier fraction, 0 to 1. The thesis has no such threshold for consecutive frames;
        this one is low and only rejects registrations with hardly any correspondences.
    """

    registration: Registrar = field(default_factory=algorithm_1)
    guess: Guess = "identity"
    minimum_points: Annotated[int, Bounds(1)] = 10
    min_inlier_ratio: Annotated[float, Bounds(0, 1)] = 0.02

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: those of the registration."""
        return self.registration.takes

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
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
            registration = options.registration.register(frame, last.frame, guess, rng)
        except RegistrationError as error:
            return _lost(f"not registered to frame {last.frame.index}: {error}", last)
        if registration.inlier_ratio < options.min_inlier_ratio:
            return _lost(
                f"only {registration.inlier_ratio:.1%} of the points correspond to frame "
                f"{last.frame.index}, {options.min_inlier_ratio:.1%} are needed",
                last,
            )
        self._motion = registration.T_target_source
        # Rounding accumulates in long products; each is projected onto the nearest rotation.
        T_world_camera = se3.orthonormalise(last.T_world_camera @ registration.T_target_source)
        self._last = _Tracked(frame, T_world_camera, T_odometry)
        return Step("tracked", "", T_world_camera, last.frame.index, registration)

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
