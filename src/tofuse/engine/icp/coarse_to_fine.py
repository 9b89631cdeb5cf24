"""Coarse-to-fine registration of two clouds, averaged to voxels, with automatic parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated
from weakref import WeakKeyDictionary

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp.icp import Icp, Remapping
from tofuse.engine.icp.icp_parts import All, MaxDistance, SmallStep, Uniform
from tofuse.engine.icp.interfaces import Metric, Rejector
from tofuse.engine.icp.surface_metrics import MIN_PAIRS, PlaneToPlane
from tofuse.engine.icp.surface_shape import shape_at
from tofuse.engine.parts import part

# Maximum number of cubes with a unique index in float64.
_MAX_CELLS = 2.0**52
# Turn of another grid of cubes, by an angle about an axis that no building or part has.
_TURN = se3.so3_exp([0.5, 0.3, 0.7])

_SPACING_SAMPLE = 5000
_MIN_LEVEL_POINTS = 60
_CELLS_PER_EXTENT = 10
# Median roughness above which normals are unreliable, and number of points of the estimate.
_MAX_ROUGHNESS, _ROUGHNESS_SAMPLE = 0.25, 1500
_COARSENING = 1.5
# Minimum extent of the scene, in resolutions of the finest level.
_MIN_EXTENT = 10
# Cache: a view is registered to several others.
_spacings: WeakKeyDictionary[Frame, float] = WeakKeyDictionary()


@part("registration", "coarse-to-fine", label="validated")
@dataclass(frozen=True)
class CoarseToFine(Bounded, Registrar):
    """ICP on a pyramid of both views, from coarse to fine.

    A level is a voxel-grid average, whose resolution halves from level to level: coarse levels
    have a large basin of convergence and little noise. Degenerate directions of the finest level
    keep the guess.

    Attributes
    ----------
    resolution
        Voxel size of the finest level, m. None: the spacing of 5000 points of each view, more if
        that leaves more than `points` points, or if noise makes plane fits as thick as wide.
    points
        Maximum number of points of the finest level of each view; only if `resolution` is None.
    metric
        Error metric of every level.
    reach
        Largest distance of a pair, in resolutions of the level.
    neighbours
        Points of each plane fit.
    max_iterations
        Maximum number of iterations of each level.
    coarsest
        Upper limit of the coarsest level's resolution, m, for accurate guesses. None: a tenth of
        the scene.
    rejectors
        Drop pairs that are within reach.
    """

    resolution: Annotated[float | None, Bounds(0, exclusive=True)] = None
    points: Annotated[int, Bounds(_MIN_LEVEL_POINTS)] = 20000
    metric: Metric = field(default_factory=lambda: PlaneToPlane(loss="tukey"))
    reach: float = 3.0
    neighbours: int = 12
    max_iterations: int = 40
    coarsest: Annotated[float | None, Bounds(0, exclusive=True)] = None
    rejectors: tuple[Rejector, ...] = ()

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; points, errors and rms are those of the finest level.

        Raises
        ------
        RegistrationError
            If there are too few points, or too few correspond.
        """
        for view in (source, target):
            if len(view) < MIN_PAIRS:
                raise RegistrationError(
                    f"has {quantities.count(len(view), 'point')}, {MIN_PAIRS} are needed",
                    where=f"frame {view.index}",
                )
        if self.resolution is None:
            finest = self.finest(source, target, max(spacing(source), spacing(target)))
        else:
            size = self.resolution
            finest = size, averaged(source, size), averaged(target, size)
        levels = [finest]
        max_resolution = extent(finest[2].points) / _CELLS_PER_EXTENT
        max_resolution = (
            max_resolution if self.coarsest is None else min(max_resolution, self.coarsest)
        )
        while levels[-1][0] * 2 < max_resolution:
            resolution = 2 * levels[-1][0]
            coarser = resolution, averaged(finest[1], resolution), averaged(finest[2], resolution)
            if min(len(coarser[1]), len(coarser[2])) < _MIN_LEVEL_POINTS:
                break
            levels.append(coarser)
        T = guess
        for resolution, data, model in reversed(levels):
            is_finest = resolution == finest[0]
            icp = self._icp(resolution, 1e-3 if is_finest else 1e-2)
            try:
                registration = icp.register(data, model, T, rng)
            except RegistrationError:
                if is_finest:
                    raise
                continue  # too few pairs at this level: a finer one may have enough
            T = registration.T_target_source
        return _remapped(registration, icp, data, model, guess, rng)

    def at(
        self,
        resolution: float,
        data: CloudFrame,
        model: CloudFrame,
        T_start: Float64,
        guess: Float64,
    ) -> Registration:
        """Register two clouds averaged to a resolution in m, from a start (4, 4).

        Degenerate directions keep the guess (4, 4).
        """
        icp, rng = self._icp(resolution, 1e-3), np.random.default_rng(0)  # nothing is drawn
        return _remapped(icp.register(data, model, T_start, rng), icp, data, model, guess, rng)

    def approximate_pose(
        self, resolution: float, data: CloudFrame, model: CloudFrame, T_start: Float64, points: int
    ) -> Float64:
        """Register about `points` points as `at` does, less accurately; return the pose (4, 4).

        Raises
        ------
        RegistrationError
            If too few points correspond.
        """
        icp, rng = self._icp(resolution, 1e-2), np.random.default_rng(0)
        icp = replace(icp, source=Uniform(points))
        return icp.register(data, model, T_start, rng).T_target_source

    def _icp(self, resolution: float, epsilon: float) -> Icp:
        return Icp(
            resolution,
            source=All(),
            target=All(),
            rejectors=(MaxDistance(self.reach), *self.rejectors),
            metric=self.metric,
            stopping=SmallStep(epsilon, self.max_iterations),
            neighbours=self.neighbours,
        )

    def finest(
        self, source: Frame, target: Frame, size: float
    ) -> tuple[float, CloudFrame, CloudFrame]:
        """Average both views to `size` m, or coarser to limit the number of points and the noise.

        Returns
        -------
        The resolution in m, and both averaged views.
        """
        size, data, model = reduced(source, target, size, self.points)
        # Averaging reduces noise, but not true roughness, which keeps the first size.
        initial = size, data, model
        while max(self._roughness(data), self._roughness(model)) > _MAX_ROUGHNESS:
            size *= _COARSENING
            data, model = averaged(source, size), averaged(target, size)
            if min(len(data), len(model)) < _MIN_LEVEL_POINTS or size * _MIN_EXTENT > extent(
                model.points
            ):
                return initial
        return size, data, model

    def _roughness(self, view: CloudFrame) -> float:
        sampled = np.arange(0, len(view), max(1, len(view) // _ROUGHNESS_SAMPLE))
        roughness = shape_at(view, sampled, self.neighbours).roughness
        return float(np.nanmedian(roughness)) if np.isfinite(roughness).any() else 0.0


def _remapped(
    registration: Registration,
    icp: Icp,
    data: CloudFrame,
    model: CloudFrame,
    guess: Float64,
    rng: np.random.Generator,
) -> Registration:
    """Return the registration with degenerate directions fixed to the guess (4, 4)."""
    if len(registration.unobservable) == 0:
        return registration
    remapping = Remapping.of(registration.unobservable, data.points.astype(np.float64))
    T = registration.T_target_source
    T = T @ remapping.along(se3.inverse(T) @ guess)
    return icp.register(data, model, T, rng, remapping)


def spacing(view: Frame) -> float:
    """Median distance in m between neighbours among 5000 evenly chosen points; 0.01 if too few."""
    if view not in _spacings:
        _spacings[view] = _spacing(view)
    return _spacings[view]


def _spacing(view: Frame) -> float:
    points = view.points[:: max(1, len(view) // _SPACING_SAMPLE)].astype(np.float64)
    if len(points) < 2:
        return 0.01
    _, squared = KdTree(points).neighbours(points, 2)
    distances: Float64 = np.sqrt(squared[:, 1])
    positive = distances[distances > 0]
    return float(np.median(positive)) if len(positive) else 0.01


def extent(points: Float32 | Float64) -> float:
    """Return the diagonal in m of the middle 90 % of points (n, 3) along each axis; 0 of none."""
    if not len(points):
        return 0.0
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(np.linalg.norm(high - low))


def averaged(view: Frame, size: float, *, turned: bool = False) -> CloudFrame:
    """Return a cloud with the mean of the points in each cube with edges of `size` m.

    Its points are in the order of the cubes, which are parallel to the axes unless `turned`;
    amplitude and colour are not kept.
    """
    points = view.points.astype(np.float64)
    if len(points) == 0:
        return CloudFrame(view.index, view.timestamp, view.points, origin=view.origin)
    order, starts = _cells(points @ _TURN if turned else points, size)
    counts = np.diff(np.r_[starts, len(points)])
    means = np.add.reduceat(points[order], starts, axis=0) / counts[:, None]
    return CloudFrame(
        view.index, view.timestamp, means.astype(np.float32), origin=np.asarray(view.origin)
    )


def _cells(points: Float64, size: float) -> tuple[Intp, Intp]:
    """Order of points (n, 3) by cubes, x before y before z, and where each cube starts in it."""
    columns = np.ascontiguousarray(points.T)
    cell = np.floor((columns - columns.min(1)[:, None]) / size)
    count = cell.max(1) + 1
    if count.prod() < _MAX_CELLS:
        # A single key sorts faster than three.
        key = ((cell[0] * count[1] + cell[1]) * count[2] + cell[2]).astype(np.int64)
        order = np.argsort(key, kind="stable")
        key = key[order]
        return order, np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    order = np.lexsort(cell[::-1])
    cell = cell[:, order]
    return order, np.flatnonzero(np.r_[True, (cell[:, 1:] != cell[:, :-1]).any(0)])


def reduced(
    source: Frame, target: Frame, size: float, max_points: int
) -> tuple[float, CloudFrame, CloudFrame]:
    """Return the voxel size in m and both averaged views, with at most `max_points` points each.

    The voxel size is `size` m, or larger if that leaves too many points.
    """
    while True:
        data, model = averaged(source, size), averaged(target, size)
        count = max(len(data), len(model))
        if count <= max_points:
            return size, data, model
        # Points lie on surfaces: their number falls with the square of the edge.
        size *= 1.02 * max(1.05, math.sqrt(count / max_points))
