"""KISS-ICP (Vizzo et al. 2023): odometry by point-to-point ICP against a voxel map."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import icp_kernels, icp_parts, interfaces
from tofuse.engine.parts import part
from tofuse.engine.search import SearchOptions
from tofuse.engine.tracking import Odometry, Step, Tracker
from tofuse.engine.views import PreparedView

# Relative to the range: voxel size of the map, initial sigma of the threshold and the smallest
# deviation that updates it (the paper: 1 m, 2 m and 0.1 m of 100 m).
_VOXEL_RATIO, _SIGMA_RATIO, _MOTION_RATIO = 0.01, 0.02, 0.001
_MAX_POINTS_PER_VOXEL = 20
_RANGE_QUANTILE = 95
_CONVERGENCE = 1e-4  # largest motion of a point, in voxels


@dataclass
class AdaptiveThreshold:
    """Correspondence distance threshold, estimated from prediction errors (eq 5).

    A correction by an angle theta and a length of t moves a point at range r by at most
    ``delta = 2 r sin(theta / 2) + t`` (eqs 3 and 4). The threshold is three times ``sigma``, the
    root mean square of the deltas above a minimum, and the scale of the loss a third of it.

    Attributes
    ----------
    range_m
        r, the largest range.
    min_delta
        Deltas below this (m) are ignored.
    initial_sigma
        Initial value of sigma, m.
    """

    range_m: float
    min_delta: float
    initial_sigma: float
    _sum: float = 0.0
    _count: int = 0

    @property
    def sigma(self) -> float:
        """Standard deviation of the predictions, m."""
        return math.sqrt(self._sum / self._count) if self._count else self.initial_sigma

    def update(self, correction: Float64) -> None:
        """Update sigma by the correction (4, 4) of a prediction."""
        theta = float(se3.angle(correction[:3, :3]))
        delta = 2 * self.range_m * math.sin(theta / 2) + float(np.linalg.norm(correction[:3, 3]))
        if delta > self.min_delta:
            self._sum += delta**2
            self._count += 1


@part("odometry", "kiss-icp", label="validated")
@dataclass(frozen=True)
class Kiss(Bounded, Odometry):
    """Point-to-point ICP of each frame to the map of the previous ones; constant velocity model.

    The frame is downsampled to one point per voxel of half the map's voxel size, and these to one
    per 1.5 voxel sizes for the registration. Points are paired with the closest of the map within
    three sigma (the adaptive threshold), weighted by Geman and McClure's loss with the scale sigma
    / 3, and aligned until a step is small. The map stores up to twenty points per voxel, within the
    range. The defaults are those of the paper, relative to the range, without parameters to tune.

    Attributes
    ----------
    voxel
        Voxel size of the map, m; None: a hundredth of the first frame's range.
    max_iterations
        Maximum number per frame.
    minimum_points
        Minimum number of valid points of a frame.
    """

    voxel: Annotated[float | None, Bounds(0, exclusive=True)] = None
    max_iterations: int = 500
    minimum_points: Annotated[int, Bounds(3)] = 10

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`; deterministic."""
        return _KissTracker(self)


@dataclass
class _Map:
    """Points of the world by voxel, up to twenty each, in order of insertion."""

    size: float
    points: Float64 = field(default_factory=lambda: np.zeros((0, 3)))

    def add(self, x: Float64, position: Float64, max_range: float) -> None:
        """Add points, and remove those beyond `max_range` m from the camera."""
        points = np.concatenate([self.points, x])
        cell = np.floor(points / self.size).astype(np.int64)
        _, key = np.unique(cell, axis=0, return_inverse=True)
        key = key.ravel()
        order = np.argsort(key, kind="stable")
        first = np.searchsorted(key[order], np.arange(key.max() + 1))
        rank = np.empty(len(key), np.int64)
        rank[order] = np.arange(len(key)) - first[key[order]]
        in_range = ((points - position) ** 2).sum(1) <= max_range**2
        self.points = points[(rank < _MAX_POINTS_PER_VOXEL) & in_range]


class _KissTracker(Tracker):
    def __init__(self, options: Kiss) -> None:
        self._options = options
        self._map: _Map | None = None
        self._pose, self._motion = np.eye(4), np.eye(4)
        self._reference = 0

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion = np.eye(4)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`; frames without points raise no error."""
        if len(frame) < self._options.minimum_points:
            reason = f"{len(frame)} valid points, {self._options.minimum_points} are needed"
            return Step("lost", reason, None)
        points = frame.points.astype(np.float64)
        if self._map is None:
            max_range = float(np.percentile(np.linalg.norm(points, axis=1), _RANGE_QUANTILE))
            self._max_range = max_range
            self._map = _Map(self._options.voxel or _VOXEL_RATIO * max_range)
            self._threshold = AdaptiveThreshold(
                max_range, _MOTION_RATIO * max_range, _SIGMA_RATIO * max_range
            )
        size = self._map.size
        downsampled = first_of_voxels(points, size / 2)
        if not len(self._map.points):
            self._map.add(downsampled, self._pose[:3, 3], self._max_range)
            self._reference = frame.index
            return Step("tracked", "", self._pose.copy())
        predicted = self._pose @ self._motion
        try:
            pose, registration = self._register(first_of_voxels(downsampled, 1.5 * size), predicted)
        except RegistrationError as error:
            return Step("lost", f"not registered to the map: {error}", None, self._reference)
        self._threshold.update(se3.inverse(predicted) @ pose)
        self._motion = se3.orthonormalise(se3.inverse(self._pose) @ pose)
        self._pose = pose
        self._map.add(icp_kernels.transform_points(pose, downsampled), pose[:3, 3], self._max_range)
        reference, self._reference = self._reference, frame.index
        return Step("tracked", "", pose.copy(), reference, registration)

    def _register(self, p: Float64, predicted: Float64) -> tuple[Float64, Registration]:
        """Pose T_world_camera of points p (n, 3), and the motion since the last frame."""
        assert self._map is not None
        sigma = self._threshold.sigma
        target = _cloud(self._map.points)
        tree = KdTree(target.points)
        source, T = _cloud(p), predicted
        converged, metric = False, icp_parts.PointToPoint()
        iterations = 0
        while not converged and iterations < self._options.max_iterations:
            iterations += 1
            x = icp_kernels.transform_points(T, p)
            index, distance2 = tree.nearest(x, 3 * sigma)
            matched = np.flatnonzero(index >= 0)
            scale2 = (sigma / 3) ** 2
            weight = (scale2 / (scale2 + distance2[matched])) ** 2
            pairs = interfaces.Matches(matched, index[matched], np.sqrt(distance2[matched]), weight)
            alignment = interfaces.Alignment(source, target, self._map.size, T, x)
            T = se3.orthonormalise(metric.motion(pairs, alignment) @ T)
            displacement = icp_kernels.transform_points(T, p) - x
            converged = float(np.abs(displacement).max()) < _CONVERGENCE * self._map.size
        relative = se3.inverse(self._pose) @ T
        registration = Registration(
            T_target_source=relative,
            converged=converged,
            iterations=iterations,
            correspondences=len(pairs),
            points=len(p),
            error=float(pairs.distance.sum()) / (len(p) * self._map.size),
            rms_m=float(np.sqrt((pairs.distance**2).mean())),
            information=metric.information(pairs, alignment),
        )
        return T, registration


def first_of_voxels(points: Float64, size: float) -> Float64:
    """The first point in each voxel with edges of `size` m, in their order."""
    cell = np.floor(points / size).astype(np.int64)
    _, first = np.unique(cell, axis=0, return_index=True)
    return points[np.sort(first)]


def _cloud(points: Float64) -> interfaces.Points:
    view = CloudFrame(0, 0.0, points.astype(np.float32))
    return interfaces.Points(view, np.arange(len(points)), points)
