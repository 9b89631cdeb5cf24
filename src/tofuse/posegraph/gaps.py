"""Gaps between parts of a recording that were tracked separately, and the motion over them.

During a gap the camera can have moved only so far. Its motion is known by external odometry, or
can be extrapolated from both sides if the gap is short.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.geometry import se3
from tofuse.kernels.rigid_motions import retract, twist_between
from tofuse.normal import SIGMA_OF_MEDIAN
from tofuse.odometry.motion import HANDHELD
from tofuse.posegraph.view_store import PosedView
from tofuse.registration.base import Link, Registration
from tofuse.registration.prepared_view import PreparedView

View = PosedView[PreparedView]

# Largest error of a guess from which alignments converge: fraction of the depth, and rad.
CONVERGENCE = 0.1
# Motions on either side of a gap that bound the camera's speed within it, and the factor on their
# maximum.
_AROUND, _FASTER = 20, 3.0
# Largest standard deviation of an extrapolated motion: fraction of the depth, and rad.
_MAX_SIGMA, _MAX_SIGMA_RAD = 0.02, np.radians(2.0)
# Motions at each end that are extrapolated, and their minimum number that odometry is compared
# with.
_ENDS, _MIN_COMPARED = 5, 10


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


def end_speeds(stretch: TrackedComponent, *, end: bool) -> Float64:
    """Return (n, 2) speeds, m/s and rad/s, of the motions next to the start, or to the end."""
    some = slice(-_AROUND, None) if end else slice(None, _AROUND)
    poses, times = stretch.poses[some], stretch.times[some]
    if len(poses) < 2:
        return np.zeros((0, 2))
    elapsed = np.maximum(np.diff(times), 1e-9)
    return _lengths(se3.inverse(poses[:-1]) @ poses[1:]) / elapsed[:, None]


def largest_motion(before: TrackedComponent, after: TrackedComponent) -> Float64:
    """Return (2,) how far, m and rad, the camera can have moved in a gap; infinite if unknown."""
    around = np.concatenate([end_speeds(before, end=True), end_speeds(after, end=False)])
    if len(around) < _AROUND // 4:
        return np.full(2, np.inf)
    elapsed = max(float(after.times[0] - before.times[-1]), 0.0)
    return np.asarray(np.maximum(_FASTER * around.max(0), HANDHELD) * elapsed)


def odometry_over(before: TrackedComponent, after: TrackedComponent) -> Link | None:
    """Return the motion over a gap by odometry; None without any, or if it is too uncertain.

    Its errors are those of the tracked motions on both sides, and grow as in a random walk.
    """
    elapsed = float(after.times[0] - before.times[-1])
    if before.odometry is None or after.odometry is None or elapsed <= 0:
        return None
    T = np.asarray(se3.inverse(before.odometry[-1]) @ after.odometry[0], np.float64)
    misfits, lengths, intervals = [], [], []
    for side, odometry in ((before, before.odometry), (after, after.odometry)):
        tracked = se3.inverse(side.poses[:-1]) @ side.poses[1:]
        measured = se3.inverse(odometry[:-1]) @ odometry[1:]
        misfits.append(se3.log(se3.inverse(tracked) @ measured))
        lengths.append(_lengths(measured))
        intervals.append(np.diff(side.times))
    misfit = np.concatenate(misfits)
    known = np.isfinite(misfit).all(1)
    if known.sum() < _MIN_COMPARED or not np.isfinite(T).all():
        return None
    steps = max(elapsed / max(float(np.median(np.concatenate(intervals))), 1e-9), 1.0)
    # Errors of odometry are in proportion to the motion.
    usual = np.median(np.concatenate(lengths)[known], axis=0) * steps
    more = np.maximum(_lengths(T[None])[0] / np.maximum(usual, 1e-9), 1.0)
    one = SIGMA_OF_MEDIAN * np.median(np.abs(misfit[known]), axis=0)
    sigma = one * np.sqrt(steps) * np.repeat(more, 3)
    limit = np.repeat([CONVERGENCE * before.depth, CONVERGENCE], 3)
    if (sigma > limit).any():
        return None
    how = "bridged by odometry"
    return _link_over_gap(before, after, T, np.maximum(sigma, 0.1 * limit), how)


def _lengths(T: Float64) -> Float64:
    """(K, 2) lengths, m, and angles, rad, of motions (K, 4, 4)."""
    return np.stack([np.linalg.norm(T[:, :3, 3], axis=1), np.asarray(se3.angle(T))], 1)


def extrapolated(before: TrackedComponent, after: TrackedComponent) -> Link | None:
    """Return the motion over a gap, extrapolated from both sides; None if it is too uncertain."""
    elapsed = float(after.times[0] - before.times[-1])
    n = _ENDS
    if min(len(before.frames), len(after.frames)) < n or elapsed <= 0:
        return None

    def velocities(stretch: TrackedComponent, some: slice) -> Float64:
        poses, times = stretch.poses[some], stretch.times[some]
        return np.stack(
            [
                twist_between(poses[k], poses[k + 1]) / max(float(times[k + 1] - times[k]), 1e-9)
                for k in range(len(poses) - 1)
            ]
        )

    v, w = velocities(before, slice(-n, None)), velocities(after, slice(None, n))
    interval = float(np.median(np.diff(np.concatenate([before.times[-n:], after.times[:n]]))))
    change = np.concatenate([np.diff(v, axis=0), np.diff(w, axis=0)])
    # A random walk of the velocity, observed at both ends.
    wander = np.sqrt((change**2).mean(0)) * np.sqrt(max(elapsed / max(interval, 1e-9), 1.0))
    apart = np.abs(v[-2:].mean(0) - w[:2].mean(0))
    sigma = np.hypot(0.5 * wander, 0.5 * apart) * elapsed
    depth = before.depth
    limit = np.repeat([_MAX_SIGMA * depth, _MAX_SIGMA_RAD], 3)
    if (sigma > limit).any():
        return None
    T = retract(np.eye(4), 0.5 * (v[-2:].mean(0) + w[:2].mean(0)) * elapsed)
    how = "bridged by the motion before and after the gap"
    return _link_over_gap(before, after, T, np.maximum(sigma, 0.1 * limit), how)


def _link_over_gap(
    before: TrackedComponent, after: TrackedComponent, T: Float64, sigma: Float64, how: str
) -> Link:
    """Return the link, given T (4, 4) from the frame after to the one before, and (6,) sigmas."""
    made = Registration(T, True, 0, 0, 0, np.nan, np.nan, np.diag(1 / sigma**2))
    return Link(int(before.frames[-1]), int(after.frames[0]), made, certain=False, how=how)
