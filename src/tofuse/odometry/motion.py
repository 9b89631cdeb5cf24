"""How a camera moves: where it is expected next, and which motions are surprises.

A camera that is carried or turned changes its velocity little from one frame to the next. A frame
that fits well at a place where it can hardly be (a mirrored image, another scale of depth, another
place that looks alike) is given away by that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.motion import distance_and_angle, moved, twist_between

Float64 = NDArray[np.float64]

# What a motion may differ from the expected one, whatever was seen before: m and rad. Carried
# cameras at 5 to 30 frames a second stay below. At lower rates the same accelerations, of 3 m/s^2,
# take them further, by the square of the time; after 0.6 s nothing can be expected any more.
FLOOR = np.array([0.06, np.radians(4.0)])
_SECONDS, _FARTHEST = 0.2, 10.0
# Over that, so many times the largest of so many recent differences.
_TIMES, _RECENT = 2.0, 4
# Share of the newest motion in the running mean.
_NEWEST = 0.3
# After so many frames without a pose the camera can be anywhere.
_FORGOTTEN = 3


@dataclass(frozen=True)
class Moment:
    """When a frame was taken: its index, and its time in s, which is the index if none is known."""

    index: int
    timestamp: float

    def seconds_since(self, before: Moment | None) -> float | None:
        """Time since another frame; None where only frames were counted."""
        if before is None or (before.timestamp, self.timestamp) == (before.index, self.index):
            return None
        return self.timestamp - before.timestamp


class Motion:
    """The motion of a camera so far."""

    def __init__(self) -> None:
        self._T: Float64 | None = None  # of the last frame with a pose
        self._per_frame: Float64 | None = None  # (6,) the motion of a frame, while it is known
        self._steady: Float64 | None = None  # (6,) the same as a running mean, with less noise
        self._missed = 0  # frames since
        self._elsewhere: Float64 | None = None  # the last surprise, and frames since
        self._waited = 0
        self._differences: deque[Float64] = deque(maxlen=_RECENT)

    @property
    def expected(self) -> Float64 | None:
        """T_world_camera (4, 4) if the last motion goes on; None if it is not known."""
        if self._T is None or self._per_frame is None:
            return None
        return _onward(self._T, self._per_frame, self._missed + 1)

    @property
    def steadily(self) -> Float64 | None:
        """T_world_camera (4, 4) if the mean motion of some frames goes on; None if not known.

        Where the data does not hold a direction for many frames, the camera goes on there by what
        is expected, and the noise of one motion would add up.
        """
        if self._T is None or self._steady is None:
            return None
        return _onward(self._T, self._steady, self._missed + 1)

    def surprise(self, T: Float64, expected: Float64 | None, seconds: float | None = None) -> str:
        """Return in words how a pose differs from what was expected, or nothing if it is believed.

        `seconds` is the time since the last frame with a pose, where it is known.

        A surprise is believed if the frame before it was one too and the camera went on from there
        as it moved before: a jump of the camera, or of the recording, does not change how it moves,
        but a mirrored image does.
        """
        if expected is None or self._missed >= _FORGOTTEN:
            return ""
        difference = _apart(expected, T)
        allowed = self._allowed(expected, seconds)
        if (difference <= allowed * (self._missed + 1)).all():
            self._differences.append(difference / (self._missed + 1))
            self._elsewhere = None
            return ""
        if self._elsewhere is not None and self._per_frame is not None:
            onward = _onward(self._elsewhere, self._per_frame, self._waited + 1)
            if (_apart(onward, T) <= allowed * (self._waited + 1)).all():
                return ""
        self._elsewhere, self._waited = T, -1  # the call of `miss` follows
        return (
            f"that is {difference[0]:.2f} m and {np.degrees(difference[1]):.0f} degrees from where "
            "the motion leads"
        )

    def _allowed(self, expected: Float64, seconds: float | None) -> Float64:
        """What a motion may differ from the expected one for each frame, m and rad."""
        if self._T is None:
            return np.full(2, np.inf)
        if self._differences:
            usual = np.max(self._differences, axis=0)
        else:
            usual = _apart(self._T, expected)
        return np.asarray(_reach(seconds, self._missed + 1) + _TIMES * usual, np.float64)

    def is_surprising(
        self, T: Float64, expected: Float64 | None, seconds: float | None = None
    ) -> bool:
        """Whether a pose differs much from what was expected, without taking note of it."""
        if expected is None or self._missed >= _FORGOTTEN:
            return False
        allowed = self._allowed(expected, seconds) * (self._missed + 1)
        return bool((_apart(expected, T) > allowed).any())

    def follow(self, T: Float64) -> bool:
        """Take the pose of the next frame; returns whether the camera jumped to get there."""
        before, frames = self._T, self._missed + 1
        jumped = self._elsewhere is not None
        if jumped:
            before, frames = self._elsewhere, self._waited + 1
        if before is None or frames > _FORGOTTEN:
            self._per_frame = self._steady = None
        elif frames > 0:  # at the place of a surprise itself the motion is taken to go on
            self._per_frame = now = twist_between(before, T) / frames
            mean = now if self._steady is None else self._steady
            off = now - mean
            # A jump hardly counts: the camera does not go on jumping.
            far = max(np.linalg.norm(off[:3]) / FLOOR[0], np.linalg.norm(off[3:]) / FLOOR[1], 1.0)
            self._steady = mean + _NEWEST / far * off
        self._T, self._missed, self._elsewhere = T, 0, None
        return jumped

    def dismiss(self) -> None:
        """Say that the last surprise told nothing of the camera."""
        self._elsewhere = None

    def interrupt(self) -> None:
        """Say that the camera may be anywhere by the next frame."""
        self._missed = _FORGOTTEN
        self._per_frame = self._steady = self._elsewhere = None

    def miss(self) -> None:
        """Say that the next frame has no pose."""
        self._missed += 1
        self._waited += 1
        if self._missed >= _FORGOTTEN:
            self._per_frame = self._steady = self._elsewhere = None


def is_small(T: Float64) -> bool:
    """Whether a motion (4, 4) is one that needs no explanation."""
    return bool((_apart(np.eye(4), T) <= FLOOR).all())


def jumps(
    poses: Sequence[Float64 | None],
    interruptions: Collection[int] = (),
    moments: Sequence[Moment] = (),
) -> list[tuple[int, str]]:
    """Positions of poses (4, 4) that the motion before does not lead to, and how far off they are.

    None is a frame without a pose; `interruptions` are positions at which a recording begins;
    `moments` say when each was taken.
    """
    motion = Motion()
    found = []
    before = None
    for k, T in enumerate(poses):
        if k in interruptions:
            motion.interrupt()
        if T is None:
            motion.miss()
            continue
        seconds = moments[k].seconds_since(before) if moments else None
        words = motion.surprise(T, motion.expected, seconds)
        if words:
            found.append((k, words))
        motion.follow(T)
        before = moments[k] if moments else None
    return found


def _reach(seconds: float | None, frames: int) -> Float64:
    """What a motion may differ from the expected one for each of so many frames, m and rad."""
    if seconds is None or not seconds > 0:
        return FLOOR
    return FLOOR * min(max((seconds / frames / _SECONDS) ** 2, 1.0), _FARTHEST)


def _onward(T: Float64, per_frame: Float64, frames: int) -> Float64:
    """Pose (4, 4) after so many frames of a motion (6,)."""
    return moved(T, per_frame * frames)


def _apart(A: Float64, B: Float64) -> Float64:
    """Distance in m and angle in rad of the motion from one pose (4, 4) to another."""
    return np.array(distance_and_angle(A, B))
