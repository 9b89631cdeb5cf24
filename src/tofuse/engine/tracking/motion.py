"""Constant-velocity motion model: the predicted pose of the next frame, and its validation gate.

The velocity of a camera changes little from one frame to the next, so that a good fit at a wrong
place (one that looks similar, for example) violates the gate. Time is that of the timestamps, or
the frame index where there are none: after missing frames the predicted motion is longer and the
gate wider.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.geometry import distance_and_angle, retract, se3, twist_between

# Minimum of the gate, m and rad: handheld cameras at 5 to 30 frames a second stay below. At lower
# rates the same acceleration of 3 m/s^2 moves them further, by the square of the time since the
# last frame over _GATE_SECONDS; at most _MAX_GATE_SCALE times, which is reached after 0.6 s.
GATE = np.array([0.06, np.radians(4.0)])
_GATE_SECONDS, _MAX_GATE_SCALE = 0.2, 10.0
# Speed of a person who walks, m/s: a recording may begin in motion.
_WALKING = 1.5
# Largest velocity of a handheld camera, m/s and rad/s.
HANDHELD = np.array([3.0, 6.0])
# The gate is wider by this factor times the largest of the recent deviations from the prediction.
_DEVIATION_FACTOR, _DEVIATION_WINDOW = 2.0, 4
# Deviations of a camera on a tripod are the noise of tracking: m and rad.
_TRACKING_NOISE = np.array([0.003, np.radians(0.2)])
# Weight of the newest motion in the exponential moving average of the velocity.
_NEWEST_WEIGHT = 0.3
# Number of recent motions over which external odometry is compared with the velocity.
_COMPARISON_WINDOW = 10
# With fewer, odometry is not trusted more than a view that contradicts it.
_MIN_COMPARED = 3
# Without timestamps, no motion is predicted across more frames without a pose than this.
_MAX_UNTIMED_GAP = 3


@dataclass(frozen=True)
class FrameTime:
    """When a frame was taken: its index, and its time in s, which is the index if unknown."""

    index: int
    timestamp: float

    @property
    def is_timed(self) -> bool:
        """Whether the timestamp is a time, not the index."""
        return self.timestamp != self.index

    def since(self, earlier: FrameTime) -> float:
        """Time since another frame, in s, or in frames where only these were counted; above 0."""
        seconds = self.seconds_since(earlier)
        return float(max(self.index - earlier.index, 1)) if seconds is None else seconds

    def seconds_since(self, earlier: FrameTime) -> float | None:
        """Time since another frame in s; None where only frames were counted."""
        timed = (self.is_timed or earlier.is_timed) and self.timestamp > earlier.timestamp
        return self.timestamp - earlier.timestamp if timed else None

    def is_predictable_from(self, earlier: FrameTime) -> bool:
        """Whether so little time passed since another frame that a prediction limits the motion."""
        seconds = self.seconds_since(earlier)
        return seconds is None or (seconds / _GATE_SECONDS) ** 2 < _MAX_GATE_SCALE


class MotionModel:
    """The velocity of a camera, estimated from its poses, (4, 4) T_world_camera, so far.

    Attributes
    ----------
    velocity_is_inherited
        Whether the velocity is that of the component before, so that deviations from it are not
        counted.
    """

    def __init__(self) -> None:
        self.velocity_is_inherited = False
        self._T_last: Float64 | None = None  # of the last frame with a pose
        self._last_time: FrameTime | None = None
        self._velocity: Float64 | None = None  # (6,) twist per unit of time, while it is known
        self._mean_velocity: Float64 | None = None  # (6,) its exponential moving average
        self._interval = 1.0  # between the last two frames with a pose
        self._deviations: deque[Float64] = deque(maxlen=_DEVIATION_WINDOW)
        # (4, 4) poses of external odometry at the last frame and now; and the errors (2,), m and
        # rad, of recent motions as predicted by it and by the velocity.
        self._T_odometry_before: Float64 | None = None
        self._T_odometry_now: Float64 | None = None
        self._prediction_errors: deque[tuple[Float64, Float64]] = deque(maxlen=_COMPARISON_WINDOW)

    def set_odometry(self, T_odometry: Float64 | None) -> None:
        """Set the pose (4, 4) of the coming frame by external odometry, in any fixed frame."""
        self._T_odometry_now = T_odometry

    def predicted_pose(self, now: FrameTime) -> Float64 | None:
        """Return the pose at constant velocity; None while the velocity is unknown.

        Position and rotation are those of external odometry, each unless it has predicted recent
        motions worse than the velocity did.
        """
        return self._with_odometry(self._extrapolated(self._velocity, now), now)

    def odometry_pose(self) -> Float64 | None:
        """Return the last pose moved as by external odometry; None without odometry."""
        T, before, now = self._T_last, self._T_odometry_before, self._T_odometry_now
        if T is None or before is None or now is None:
            return None
        return np.asarray(T @ se3.inverse(before) @ now, np.float64)

    def trusted_odometry_pose(self, now: FrameTime) -> Float64 | None:
        """Return the pose by external odometry if it deserves more trust than a view that misfits.

        That is if it predicted recent motions better than the velocity did, and did not jump:
        otherwise, and without odometry, None.
        """
        T, T_velocity = self.odometry_pose(), self._extrapolated(self._velocity, now)
        if T is None or T_velocity is None or len(self._prediction_errors) < _MIN_COMPARED:
            return None
        if not self._odometry_predicts_better().all():
            return None
        within = (_distance_and_angle(T_velocity, T) <= self.gate(now)).all()
        return T if within else None

    def smoothed_pose(self, now: FrameTime) -> Float64 | None:
        """Return the pose at the mean velocity of recent frames; None while it is unknown.

        Where a direction is degenerate for many frames, only the prediction moves the camera
        along it, and the noise of single motions would accumulate. With external odometry as in
        `predicted_pose`.
        """
        return self._with_odometry(self._extrapolated(self._mean_velocity, now), now)

    def gate(self, now: FrameTime) -> Float64:
        """Return by how much a pose may deviate from the predicted one, (2,), m and rad.

        Infinite without a prediction.
        """
        if self._T_last is None or self._last_time is None or self._velocity is None:
            return np.full(2, np.inf)
        elapsed = now.since(self._last_time) / self._interval
        if self._deviations or self.velocity_is_inherited:
            typical_deviation = np.max([np.zeros(2), *self._deviations], axis=0)
        else:
            T_next = retract(self._T_last, self._velocity * self._interval)
            typical_deviation = _distance_and_angle(self._T_last, T_next)
        seconds = now.seconds_since(self._last_time)
        if seconds is None:
            if elapsed > _MAX_UNTIMED_GAP:
                return np.full(2, np.inf)
            minimum = GATE * max(elapsed, 1.0)
        else:
            minimum = _minimum_gate(seconds)
        return np.asarray(
            minimum + _DEVIATION_FACTOR * typical_deviation * max(elapsed, 1.0), np.float64
        )

    def gate_violation(self, T: Float64, now: FrameTime) -> str:
        """Describe by how much a pose outside of the gate deviates; empty for one inside."""
        T_predicted = self.predicted_pose(now)
        if T_predicted is None:
            return ""
        deviation = _distance_and_angle(T_predicted, T)
        if (deviation <= self.gate(now)).all():
            return ""
        return (
            f"{deviation[0]:.2f} m and {np.degrees(deviation[1]):.0f} degrees from the predicted "
            "pose"
        )

    def is_feasible(self, T: Float64, now: FrameTime) -> bool:
        """Whether a handheld camera can have moved to a pose since the last frame."""
        if self._T_last is None or self._last_time is None:
            return True
        seconds = now.seconds_since(self._last_time)
        limit = GATE + HANDHELD * (1.0 if seconds is None else seconds)
        return bool((_distance_and_angle(self._T_last, T) <= limit).all())

    def normalised_deviation(self, T: Float64, now: FrameTime) -> float:
        """Return the deviation from the predicted pose as a multiple of the largest recent one.

        0 without a prediction.
        """
        T_predicted = self.predicted_pose(now)
        if T_predicted is None or not self._deviations:
            return 0.0
        scale = np.maximum(np.max(self._deviations, axis=0), _TRACKING_NOISE)
        return float(np.max(_distance_and_angle(T_predicted, T) / scale))

    def _with_odometry(self, T: Float64 | None, now: FrameTime) -> Float64 | None:
        """Replace the parts of a pose (4, 4) that external odometry has not predicted worse."""
        T_odometry = self.odometry_pose()
        if T_odometry is None:
            return T
        if T is None:
            return T_odometry if self.is_feasible(T_odometry, now) else None
        use_position, use_rotation = self._odometry_predicts_better()
        fused = T.copy()
        if use_position:
            fused[:3, 3] = T_odometry[:3, 3]
        if use_rotation:
            fused[:3, :3] = T_odometry[:3, :3]
        return fused

    def _odometry_predicts_better(self) -> Bool:
        """Whether odometry predicted recent positions and rotations as well as the velocity did."""
        by_odometry, by_velocity = np.median(self._prediction_errors or [np.zeros((2, 2))], axis=0)
        return np.asarray(by_odometry <= by_velocity)

    def _compare_odometry(self, T: Float64, now: FrameTime) -> None:
        """Record how well odometry and velocity predicted a pose (4, 4)."""
        T_odometry, T_velocity = self.odometry_pose(), self._extrapolated(self._velocity, now)
        if T_odometry is not None and T_velocity is not None:
            self._prediction_errors.append(
                (_distance_and_angle(T_odometry, T), _distance_and_angle(T_velocity, T))
            )

    def update(self, T: Float64, now: FrameTime, *, degenerate: bool = False) -> None:
        """Update the velocity with the pose of the next frame.

        Parameters
        ----------
        T
            (4, 4) T_world_camera.
        now
            When the frame was taken.
        degenerate
            Whether some direction of the motion is only predicted.
        """
        if not degenerate:
            self._compare_odometry(T, now)
        self._update_velocity(T, now)
        self._T_odometry_before, self._T_odometry_now = self._T_odometry_now, None

    def _update_velocity(self, T: Float64, now: FrameTime) -> None:
        if self._T_last is None or self._last_time is None:
            self._T_last, self._last_time = T, now
            return
        elapsed = now.since(self._last_time)
        T_predicted = self.predicted_pose(now)
        if T_predicted is not None:
            deviation = _distance_and_angle(T_predicted, T)
            if not self.velocity_is_inherited and (deviation <= self.gate(now)).all():
                self._deviations.append(deviation * min(self._interval / elapsed, 1.0))
        velocity = twist_between(self._T_last, T) / elapsed
        mean = velocity if self._mean_velocity is None else self._mean_velocity
        residual = (velocity - mean) * elapsed
        # Jumps are down-weighted: they do not continue.
        excess = max(
            np.linalg.norm(residual[:3]) / GATE[0], np.linalg.norm(residual[3:]) / GATE[1], 1.0
        )
        self._mean_velocity = mean + _NEWEST_WEIGHT / excess * (velocity - mean)
        self._velocity, self._interval = velocity, elapsed
        self._T_last, self._last_time, self.velocity_is_inherited = T, now, False

    def restart_at(self, T: Float64, now: FrameTime) -> None:
        """Continue from the pose of the next frame at the same velocity: the motion was a jump."""
        self._T_last, self._last_time = T, now
        self._T_odometry_before, self._T_odometry_now = self._T_odometry_now, None

    def rest_at(self, T: Float64, now: FrameTime) -> None:
        """Expect the next pose at T (4, 4): the motion before was that of something else."""
        self.interrupt()
        self._T_last, self._last_time = T, now
        self._velocity = self._mean_velocity = np.zeros(6)

    def change_frame(self) -> None:
        """Expect the next pose in another frame of reference.

        The velocity is inherited, unless it already was.
        """
        if self.velocity_is_inherited or self._velocity is None:
            self.interrupt()
        self._T_last = self._last_time = None
        self.velocity_is_inherited = self._velocity is not None
        self._deviations.clear()

    def interrupt(self) -> None:
        """Forget the motion: the next pose can be anywhere."""
        self._velocity = self._mean_velocity = self._T_last = self._last_time = None
        self.velocity_is_inherited = False
        self._deviations.clear()

    def _extrapolated(self, velocity: Float64 | None, now: FrameTime) -> Float64 | None:
        if self._T_last is None or self._last_time is None or velocity is None:
            return None
        return retract(self._T_last, velocity * now.since(self._last_time))


def reach_m(seconds: float) -> float:
    """Return how far the true step between two frames may lie from the tracked one, m.

    Beyond, a camera that a person carries would be too fast, or accelerated too much.
    """
    return float(max(_minimum_gate(seconds)[0], _WALKING * seconds))


def _minimum_gate(seconds: float) -> Float64:
    """Return the gate (2,), m and rad, of a steady camera, this time after the last frame."""
    scale = min(max((seconds / _GATE_SECONDS) ** 2, 1.0), _MAX_GATE_SCALE)
    return np.asarray(GATE * scale, np.float64)


def is_small(T: Float64) -> bool:
    """Whether a motion (4, 4) is within the smallest gate, and plausible without a prediction."""
    return bool((_distance_and_angle(np.eye(4), T) <= GATE).all())


def find_jumps(
    poses: Sequence[Float64 | None],
    moments: Sequence[FrameTime],
    interruptions: Collection[int] = (),
) -> list[tuple[int, str]]:
    """Return the positions of poses outside of the gate, and descriptions of their deviations.

    Parameters
    ----------
    poses
        (4, 4) T_world_camera each; None for a frame without a pose.
    moments
        When each frame was taken.
    interruptions
        Positions at which no motion is predicted: where a recording or a component begins, or where
        the motion before was not measured.
    """
    motion = MotionModel()
    result = []
    for k, (T, now) in enumerate(zip(poses, moments, strict=True)):
        if k in interruptions:
            motion.interrupt()
        if T is None:
            continue
        violation = motion.gate_violation(T, now)
        if violation:
            result.append((k, violation))
            motion.restart_at(T, now)
        else:
            motion.update(T, now)
    return result


def _distance_and_angle(A: Float64, B: Float64) -> Float64:
    """Return the distance, m, and the angle, rad, between two poses (4, 4), as (2,)."""
    return np.array(distance_and_angle(A, B))
