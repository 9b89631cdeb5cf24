"""Coarse-to-fine registration of two clouds with automatic parameters."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np

from tofuse.arrays import Float64
from tofuse.bounds import Bounded, Bounds, NotEmpty
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.kernels.kdtree import KdTree
from tofuse.parts import part
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.icp import Icp
from tofuse.registration.interfaces import Metric
from tofuse.registration.pairs import FEWEST_PAIRS
from tofuse.registration.reduce import averaged, extent, reduced
from tofuse.registration.rejectors import MaxDistance
from tofuse.registration.remapping import Remapping
from tofuse.registration.selectors import All, Uniform
from tofuse.registration.shape import shape_at
from tofuse.registration.stopping import SmallStep
from tofuse.registration.surface_metrics import PlaneToPlane

_SPACING_SAMPLE = 5000
_SMALLEST_LEVEL = 60
_CELLS_PER_EXTENT = 10
# Median roughness above which normals are unreliable, and number of points of the estimate.
_ROUGHEST, _ROUGHNESS_SAMPLE = 0.25, 1500
_COARSER = 1.5
# Minimum extent of the scene, in resolutions of the finest level.
_FINEST = 10


@part("registration", "in-turn")
@dataclass(frozen=True)
class InTurn(Bounded, Registrar):
    """A sequence of registrations, each starting from the result of the previous one.

    Attributes
    ----------
    stages
        At least one.
    """

    stages: Annotated[tuple[Registrar, ...], NotEmpty()]

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view that all stages work on."""
        return frozenset.intersection(*(stage.takes for stage in self.stages))

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; the result is that of the last stage."""
        found = self.stages[0].register(source, target, guess, rng)
        for stage in self.stages[1:]:
            found = stage.register(source, target, found.T_target_source, rng)
        return found


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
    """

    resolution: Annotated[float | None, Bounds(0, exclusive=True)] = None
    points: Annotated[int, Bounds(_SMALLEST_LEVEL)] = 20000
    metric: Metric = field(default_factory=lambda: PlaneToPlane(loss="tukey"))
    reach: float = 3.0
    neighbours: int = 12
    max_iterations: int = 40
    coarsest: Annotated[float | None, Bounds(0, exclusive=True)] = None
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

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
            if len(view) < FEWEST_PAIRS:
                raise RegistrationError(
                    f"has {len(view)} points, {FEWEST_PAIRS} are needed",
                    where=f"frame {view.index}",
                )
        if self.resolution is None:
            fine = self.finest(source, target, max(spacing(source), spacing(target)))
        else:
            size = self.resolution
            fine = size, averaged(source, size), averaged(target, size)
        levels = [fine]
        most = extent(fine[2].points) / _CELLS_PER_EXTENT
        most = most if self.coarsest is None else min(most, self.coarsest)
        while levels[-1][0] * 2 < most:
            resolution = 2 * levels[-1][0]
            coarser = resolution, averaged(fine[1], resolution), averaged(fine[2], resolution)
            if min(len(coarser[1]), len(coarser[2])) < _SMALLEST_LEVEL:
                break
            levels.append(coarser)
        T = guess
        for resolution, data, model in reversed(levels):
            last = resolution == fine[0]
            icp = self._icp(resolution, 1e-3 if last else 1e-2)
            try:
                found = icp.register(data, model, T, rng)
            except RegistrationError:
                if last:
                    raise
                continue  # too few pairs at this level: a finer one may have enough
            T = found.T_target_source
        return _kept(found, icp, data, model, guess, rng)

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
        return _kept(icp.register(data, model, T_start, rng), icp, data, model, guess, rng)

    def roughly(
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
            rejectors=(MaxDistance(self.reach),),
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
        first = size, data, model
        while max(self._roughness(data), self._roughness(model)) > _ROUGHEST:
            size *= _COARSER
            data, model = averaged(source, size), averaged(target, size)
            if min(len(data), len(model)) < _SMALLEST_LEVEL or size * _FINEST > extent(
                model.points
            ):
                return first
        return size, data, model

    def _roughness(self, view: CloudFrame) -> float:
        some = np.arange(0, len(view), max(1, len(view) // _ROUGHNESS_SAMPLE))
        rough = shape_at(view, some, self.neighbours).roughness
        return float(np.nanmedian(rough)) if np.isfinite(rough).any() else 0.0


def _kept(
    found: Registration,
    icp: Icp,
    data: CloudFrame,
    model: CloudFrame,
    guess: Float64,
    rng: np.random.Generator,
) -> Registration:
    """Return the registration with degenerate directions fixed to the guess (4, 4)."""
    if len(found.unobservable) == 0:
        return found
    remapping = Remapping.of(found.unobservable, data.points.astype(np.float64))
    T = found.T_target_source
    T = T @ remapping.along(se3.inverse(T) @ guess)
    return icp.register(data, model, T, rng, remapping)


def spacing(view: Frame) -> float:
    """Median distance in m between neighbours among 5000 evenly chosen points; 0.01 if too few."""
    points = view.points[:: max(1, len(view) // _SPACING_SAMPLE)].astype(np.float64)
    if len(points) < 2:
        return 0.01
    _, squared = KdTree(points).neighbours(points, 2)
    distances: Float64 = np.sqrt(squared[:, 1])
    positive = distances[distances > 0]
    return float(np.median(positive)) if len(positive) else 0.01
