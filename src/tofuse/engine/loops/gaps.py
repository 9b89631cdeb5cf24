"""Gaps between parts of a recording that were tracked separately, and the motion over them.

The motion of the camera during a gap is bounded. It is measured by external odometry, or can be
extrapolated from both sides if the gap is short.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.engine.alignment import Link, Registration
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.geometry import retract, se3, twist_between
from tofuse.engine.normal import SIGMA_OF_MEDIAN
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import HANDHELD
from tofuse.engine.views import PreparedView

View = PosedView[PreparedView]

# Largest error of a guess from which alignments converge: fraction of the depth, and rad.
CONVERGENCE = 0.1
# Motions on either side of a gap that bound the camera's speed within it, and the factor on their
# maximum.
_SPEED_SAMPLES, _SPEED_FACTOR = 20, 3.0
# Largest standard deviation of an extrapolated motion: fraction of the depth, and rad.
_MAX_SIGMA, _MAX_SIGMA_RAD = 0.02, np.radians(2.0)
# Poses at each end for the extrapolation, and minimum number of motions for a comparison with
# odometry.
_EXTRAPOLATED, _MIN_COMPARED = 5, 10


@dataclass(frozen=True, eq=False)
class TrackedComponent:
    """A component as tracked.

    Attributes
    ----------
    component
        Its number.
    frames
        (N,) indices, ascending.
    times
        (N,) s.
    poses
        (N, 4, 4) T_component_camera.
    views
        The stored views of its frames.
    recording
        Number of its recording, if several are merged: no motion is known between these.
    odometry
        (N, 4, 4) T_odometry_camera by external odometry, NaN where there is none; None without any.
    """

    component: int
    frames: Intp
    times: Float64
    poses: Float64
    views: tuple[View, ...]
    recording: int = 0
    odometry: Float64 | None = None

    @cached_property
    def depth(self) -> float:
        """Median depth of its views, m."""
        return float(np.median([v.depth for v in self.views])) if self.views else 1.0


def motion_over(
    before: TrackedComponent, after: TrackedComponent, T: Mapping[int, Float64]
) -> Float64:
    """Return the motion (4, 4) from the end of one component to the start of another.

    `T` are their poses (4, 4) in a common frame, by component.
    """
    end = T[before.component] @ before.poses[-1]
    return np.asarray(se3.inverse(end) @ T[after.component] @ after.poses[0], np.float64)


def end_speeds(component: TrackedComponent, *, end: bool) -> Float64:
    """Return (n, 2) speeds, m/s and rad/s, of the motions next to the start, or to the end."""
    window = slice(-_SPEED_SAMPLES, None) if end else slice(None, _SPEED_SAMPLES)
    poses, times = component.poses[window], component.times[window]
    if len(poses) < 2:
        return np.zeros((0, 2))
    elapsed = np.maximum(np.diff(times), 1e-9)
    return se3.lengths(se3.inverse(poses[:-1]) @ poses[1:]) / elapsed[:, None]


def largest_motion(before: TrackedComponent, after: TrackedComponent) -> Float64:
    """Return the (2,) largest possible motion, m and rad, in a gap; infinite if unknown."""
    speeds = np.concatenate([end_speeds(before, end=True), end_speeds(after, end=False)])
    if len(speeds) < _SPEED_SAMPLES // 4:
        return np.full(2, np.inf)
    elapsed = max(float(after.times[0] - before.times[-1]), 0.0)
    return np.asarray(np.maximum(_SPEED_FACTOR * speeds.max(0), HANDHELD) * elapsed)


def odometry_over(before: TrackedComponent, after: TrackedComponent) -> Link | None:
    """Return the motion over a gap by odometry; None without any, or if it is too uncertain.

    Its errors are those of the tracked motions on both sides, and grow as in a random walk.
    """
    elapsed = float(after.times[0] - before.times[-1])
    if before.odometry is None or after.odometry is None or elapsed <= 0:
        return None
    T = np.asarray(se3.inverse(before.odometry[-1]) @ after.odometry[0], np.float64)
    all_errors, lengths, intervals = [], [], []
    for side, odometry in ((before, before.odometry), (after, after.odometry)):
        tracked = se3.inverse(side.poses[:-1]) @ side.poses[1:]
        measured = se3.inverse(odometry[:-1]) @ odometry[1:]
        all_errors.append(se3.log(se3.inverse(tracked) @ measured))
        lengths.append(se3.lengths(measured))
        intervals.append(np.diff(side.times))
    errors = np.concatenate(all_errors)
    valid = np.isfinite(errors).all(1)
    if valid.sum() < _MIN_COMPARED or not np.isfinite(T).all():
        return None
    step_count = max(elapsed / max(float(np.median(np.concatenate(intervals))), 1e-9), 1.0)
    # Errors of odometry are in proportion to the motion.
    typical = np.median(np.concatenate(lengths)[valid], axis=0) * step_count
    excess = np.maximum(se3.lengths(T[None])[0] / np.maximum(typical, 1e-9), 1.0)
    step_sigma = SIGMA_OF_MEDIAN * np.median(np.abs(errors[valid]), axis=0)
    sigma = step_sigma * np.sqrt(step_count) * np.repeat(excess, 3)
    limit = np.repeat([CONVERGENCE * before.depth, CONVERGENCE], 3)
    if (sigma > limit).any():
        return None
    method = "bridged by odometry"
    return _link_over_gap(before, after, T, np.maximum(sigma, 0.1 * limit), method)


def extrapolated(before: TrackedComponent, after: TrackedComponent) -> Link | None:
    """Return the motion over a gap, extrapolated from both sides; None if it is too uncertain."""
    elapsed = float(after.times[0] - before.times[-1])
    n = _EXTRAPOLATED
    if min(len(before.frames), len(after.frames)) < n or elapsed <= 0:
        return None

    def velocities(component: TrackedComponent, window: slice) -> Float64:
        poses, times = component.poses[window], component.times[window]
        return np.stack(
            [
                twist_between(poses[k], poses[k + 1]) / max(float(times[k + 1] - times[k]), 1e-9)
                for k in range(len(poses) - 1)
            ]
        )

    v, w = velocities(before, slice(-n, None)), velocities(after, slice(None, n))
    interval = float(np.median(np.diff(np.concatenate([before.times[-n:], after.times[:n]]))))
    velocity_changes = np.concatenate([np.diff(v, axis=0), np.diff(w, axis=0)])
    # A random walk of the velocity, observed at both ends.
    random_walk = np.sqrt((velocity_changes**2).mean(0)) * np.sqrt(
        max(elapsed / max(interval, 1e-9), 1.0)
    )
    difference = np.abs(v[-2:].mean(0) - w[:2].mean(0))
    sigma = np.hypot(0.5 * random_walk, 0.5 * difference) * elapsed
    depth = before.depth
    limit = np.repeat([_MAX_SIGMA * depth, _MAX_SIGMA_RAD], 3)
    if (sigma > limit).any():
        return None
    T = retract(np.eye(4), 0.5 * (v[-2:].mean(0) + w[:2].mean(0)) * elapsed)
    method = "bridged by the motion before and after the gap"
    return _link_over_gap(before, after, T, np.maximum(sigma, 0.1 * limit), method)


def _link_over_gap(
    before: TrackedComponent, after: TrackedComponent, T: Float64, sigma: Float64, method: str
) -> Link:
    """Return the link, given T (4, 4) from the frame after to the one before, and (6,) sigmas."""
    registration = Registration(T, True, 0, 0, 0, np.nan, np.nan, np.diag(1 / sigma**2))
    return Link(
        int(before.frames[-1]), int(after.frames[0]), registration, certain=False, how=method
    )
