"""How a camera moves: where it is expected next, and which motions are surprises.

A camera that is carried or turned changes its velocity little from one frame to the next. A frame
that fits well at a place where it can hardly be (another place that looks alike, say) is given away
by that. Time is what the timestamps say, or the frames' indices where they say nothing: frames
that are missing make the next motion longer, not stranger.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.kernels.motion import distance_and_angle, retract, twist_between

# What a motion may differ from the expected one, whatever was seen before: m and rad. Carried
# cameras at 5 to 30 frames a second stay below. At lower rates the same accelerations, of 3 m/s^2,
# take them further, by the square of the time; after 0.6 s nothing can be expected any more.
FLOOR = np.array([0.06, np.radians(4.0)])
# What a hand can do at any time, m/s and rad/s.
HANDHELD = np.array([3.0, 6.0])
_SECONDS, _FARTHEST = 0.2, 10.0
# Over that, so many times the largest of so many recent differences.
_TIMES, _RECENT = 2.0, 4
# Differences of a tripod are the tracker's noise: m and rad.
_STILL = np.array([0.003, np.radians(0.2)])
# Share of the newest motion in the running mean.
_NEWEST = 0.3
# Odometry is compared with the velocity over so many turns, at least half of them.
_PROOF = 10
# After so many frames without a pose, of which no time is known, the camera can be anywhere.
_FORGOTTEN = 3


@dataclass(frozen=True)
class Moment:
    """When a frame was taken: its index, and its time in s, which is the index if none is known."""

    index: int
    timestamp: float

    @property
    def is_timed(self) -> bool:
        """Whether the timestamp says more than the index."""
        return self.timestamp != self.index

    def since(self, before: Moment) -> float:
        """Time since another frame, in s, or in frames where only these were counted; above 0."""
        seconds = self.seconds_since(before)
        return float(max(self.index - before.index, 1)) if seconds is None else seconds

    def seconds_since(self, before: Moment) -> float | None:
        """Time since another frame in s; None where only frames were counted."""
        timed = (self.is_timed or before.is_timed) and self.timestamp > before.timestamp
        return self.timestamp - before.timestamp if timed else None


class Motion:
    """The motion of a camera so far; poses are (4, 4) T_world_camera.

    Attributes
    ----------
    is_guess
        Whether the velocity is that of another component: what differs from it is no surprise.
    """

    def __init__(self) -> None:
        self.is_guess = False
        self._T: Float64 | None = None  # of the last frame with a pose
        self._when: Moment | None = None
        self._velocity: Float64 | None = None  # (6,) by the unit of time, while it is known
        self._steady: Float64 | None = None  # (6,) the same as a running mean, with less noise
        self._interval = 1.0  # between the last two frames with a pose
        self._differences: deque[Float64] = deque(maxlen=_RECENT)
        # (4, 4) of odometry beside the images, at the last frame and now; and by which angles it
        # and the velocity failed to predict recent turns.
        self._sensed_before: Float64 | None = None
        self._sensed: Float64 | None = None
        self._failed: deque[tuple[float, float]] = deque(maxlen=_PROOF)

    def sense(self, T_odometry: Float64 | None) -> None:
        """Take the pose (4, 4) that odometry gives the coming frame, in any fixed frame."""
        self._sensed = T_odometry

    def expected(self, now: Moment) -> Float64 | None:
        """Pose if the last motion goes on; None if it is not known.

        Turned as odometry says, if it has predicted recent turns better than the velocity did.
        """
        T = self._onward(self._velocity, now)
        if not self._odometry_is_proven():
            return T
        sensed = self._as_sensed(self._T if T is None else T)
        return T if sensed is None else sensed

    def steadily(self, now: Moment) -> Float64 | None:
        """Pose if the mean motion of some frames goes on; None if it is not known.

        Where a direction is degenerate for many frames, the camera goes on there by what is
        expected, and the noise of one motion would add up.
        """
        return self._onward(self._steady, now)

    def allowed(self, now: Moment) -> Float64:
        """What a pose may differ from the expected one, m and rad; infinite if none is expected."""
        if self._T is None or self._when is None or self._velocity is None:
            return np.full(2, np.inf)
        elapsed = now.since(self._when) / self._interval
        if self._differences or self.is_guess:
            usual = np.max([np.zeros(2), *self._differences], axis=0)
        else:
            usual = _apart(self._T, retract(self._T, self._velocity * self._interval))
        seconds = now.seconds_since(self._when)
        if seconds is None:
            if elapsed > _FORGOTTEN:
                return np.full(2, np.inf)
            floor = FLOOR * max(elapsed, 1.0)
        else:
            floor = FLOOR * min(max((seconds / _SECONDS) ** 2, 1.0), _FARTHEST)
        return np.asarray(floor + _TIMES * usual * max(elapsed, 1.0), np.float64)

    def surprise(self, T: Float64, now: Moment) -> str:
        """How a pose differs from what was expected, in words; empty if that is nothing unusual."""
        expected = self.expected(now)
        if expected is None:
            return ""
        difference = _apart(expected, T)
        if (difference <= self.allowed(now)).all():
            return ""
        return (
            f"{difference[0]:.2f} m and {np.degrees(difference[1]):.0f} degrees from the predicted "
            "pose"
        )

    def is_possible(self, T: Float64, now: Moment) -> bool:
        """Whether a hand can have moved the camera to a pose since the last frame."""
        if self._T is None or self._when is None:
            return True
        seconds = now.seconds_since(self._when)
        far = FLOOR + HANDHELD * (1.0 if seconds is None else seconds)
        return bool((_apart(self._T, T) <= far).all())

    def deviation(self, T: Float64, now: Moment) -> float:
        """Distance of a pose from the expected one, in multiples of what recent ones had.

        0 where nothing is expected.
        """
        expected = self.expected(now)
        if expected is None or not self._differences:
            return 0.0
        usual = np.maximum(np.max(self._differences, axis=0), _STILL)
        return float(np.max(_apart(expected, T) / usual))

    def _as_sensed(self, T: Float64 | None) -> Float64 | None:
        """A pose (4, 4), turned since the last frame as odometry says; None where it is silent."""
        if T is None or self._T is None or self._sensed is None or self._sensed_before is None:
            return None
        out = T.copy()
        turn = self._sensed_before[:3, :3].T @ self._sensed[:3, :3]
        out[:3, :3] = self._T[:3, :3] @ turn
        return out

    def _odometry_is_proven(self) -> bool:
        if len(self._failed) < _PROOF // 2:
            return False
        odometry, velocity = np.median(self._failed, axis=0)
        return bool(odometry < velocity)

    def _compare_odometry(self, T: Float64, now: Moment) -> None:
        """Take note of how well odometry and velocity predicted a turn."""
        sensed, onward = self._as_sensed(T), self._onward(self._velocity, now)
        if sensed is not None and onward is not None:
            self._failed.append((float(_apart(sensed, T)[1]), float(_apart(onward, T)[1])))

    def follow(self, T: Float64, now: Moment) -> None:
        """Take the pose of the next frame."""
        self._compare_odometry(T, now)
        self._move(T, now)
        self._sensed_before, self._sensed = self._sensed, None

    def _move(self, T: Float64, now: Moment) -> None:
        if self._T is None or self._when is None:
            self._T, self._when = T, now
            return
        elapsed = now.since(self._when)
        expected = self.expected(now)
        if expected is not None:
            difference = _apart(expected, T)
            if not self.is_guess and (difference <= self.allowed(now)).all():
                self._differences.append(difference * min(self._interval / elapsed, 1.0))
        velocity = twist_between(self._T, T) / elapsed
        mean = velocity if self._steady is None else self._steady
        off = (velocity - mean) * elapsed
        # A jump hardly counts: the camera does not go on jumping.
        far = max(np.linalg.norm(off[:3]) / FLOOR[0], np.linalg.norm(off[3:]) / FLOOR[1], 1.0)
        self._steady = mean + _NEWEST / far * (velocity - mean)
        self._velocity, self._interval = velocity, elapsed
        self._T, self._when, self.is_guess = T, now, False

    def jump(self, T: Float64, now: Moment) -> None:
        """Take the pose of the next frame, but not the motion to it, which does not go on."""
        self._T, self._when = T, now
        self._sensed_before, self._sensed = self._sensed, None

    def restart(self) -> None:
        """Say that the next pose is in another frame of reference.

        The velocity is still the best guess, unless it was but a guess itself.
        """
        if self.is_guess or self._velocity is None:
            self.interrupt()
        self._T = self._when = None
        self.is_guess = self._velocity is not None
        self._differences.clear()

    def interrupt(self) -> None:
        """Say that the camera may be anywhere by the next frame."""
        self._velocity = self._steady = self._T = self._when = None
        self.is_guess = False
        self._differences.clear()

    def _onward(self, velocity: Float64 | None, now: Moment) -> Float64 | None:
        if self._T is None or self._when is None or velocity is None:
            return None
        return retract(self._T, velocity * now.since(self._when))


def is_small(T: Float64) -> bool:
    """Whether a motion (4, 4) is one that needs no explanation."""
    return bool((_apart(np.eye(4), T) <= FLOOR).all())


def jumps(
    poses: Sequence[Float64 | None],
    moments: Sequence[Moment],
    interruptions: Collection[int] = (),
) -> list[tuple[int, str]]:
    """Positions of poses (4, 4) that the motion before does not lead to, and how far off they are.

    None is a frame without a pose; `moments` say when each was taken; `interruptions` are positions
    to which no motion leads: where a recording or a component begins, or where the motion before
    was not measured.
    """
    motion = Motion()
    found = []
    for k, (T, now) in enumerate(zip(poses, moments, strict=True)):
        if k in interruptions:
            motion.interrupt()
        if T is None:
            continue
        words = motion.surprise(T, now)
        if words:
            found.append((k, words))
            motion.jump(T, now)
        else:
            motion.follow(T, now)
    return found


def _apart(A: Float64, B: Float64) -> Float64:
    """Distance in m and angle in rad of the motion from one pose (4, 4) to another."""
    return np.array(distance_and_angle(A, B))
