"""Named variants of ICP (section 1.3), each a combination of parts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import numpy as np

from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds, NotEmpty
from tofuse.engine.frames import Frame
from tofuse.engine.icp import Icp, icp_parts, interfaces, surface_metrics
from tofuse.engine.parts import part
from tofuse.lab.methods.compatibility import Trimmed
from tofuse.lab.methods.correspondence import ClosestCompatible, ClosestInvariant, Invariant
from tofuse.lab.methods.symmetric import Symmetric

_GOLDEN = (math.sqrt(5) - 1) / 2


class Variant(Registrar, Protocol):
    """A registration composed of ICP parts."""

    def parts(self) -> Registrar:
        """Return the registration as its parts."""
        ...

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it accepts."""
        return self.parts().takes

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`."""
        return self.parts().register(source, target, guess, rng)


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
        registration = self.stages[0].register(source, target, guess, rng)
        for stage in self.stages[1:]:
            registration = stage.register(source, target, registration.T_target_source, rng)
        return registration


@dataclass(frozen=True)
class _ClosestPoints(Variant):
    """ICP with closest points, and any metric.

    Attributes
    ----------
    resolution
        Typical distance between neighbouring points, m.
    points
        Random points of the source (None: all), against all of the target.
    reach
        Largest distance of a pair, in resolutions.
    max_iterations
        Maximum number of iterations.
    """

    resolution: float = 0.01
    points: int | None = 1000
    reach: float = 5.0
    max_iterations: int = 50

    def _with_metric(self, metric: interfaces.Metric) -> Icp:
        return Icp(
            self.resolution,
            source=icp_parts.at_most(self.points),
            target=icp_parts.All(),
            rejectors=(icp_parts.MaxDistance(self.reach),),
            metric=metric,
            stopping=icp_parts.SmallStep(max_iterations=self.max_iterations),
        )


@part("registration", "point-to-plane", label="validated")
@dataclass(frozen=True)
class PointToPlaneIcp(_ClosestPoints):
    """Point-to-plane ICP (Chen and Medioni 1992) with closest points."""

    def parts(self) -> Icp:
        """See `Variant.parts`."""
        return self._with_metric(surface_metrics.PointToPlane())


@part("registration", "symmetric", label="validated")
@dataclass(frozen=True)
class SymmetricIcp(_ClosestPoints):
    """ICP with the symmetric objective (Rusinkiewicz 2019) and closest points."""

    def parts(self) -> Icp:
        """See `Variant.parts`."""
        return self._with_metric(Symmetric())


@part("registration", "gicp", label="validated")
@dataclass(frozen=True)
class GeneralizedIcp(_ClosestPoints):
    """Generalised ICP, plane to plane (Segal, Haehnel and Thrun 2009).

    Attributes
    ----------
    epsilon
        Variance across a surface relative to that along it.
    """

    epsilon: float = 1e-3

    def parts(self) -> Icp:
        """See `Variant.parts`."""
        return self._with_metric(surface_metrics.PlaneToPlane(self.epsilon))


@part("registration", "tricp", label="validated")
@dataclass(frozen=True)
class Tricp(Bounded, Registrar):
    """Trimmed ICP (Chetverikov, Stepanov and Krsek 2005).

    Each iteration keeps the fraction xi of shortest pairs, at any distance. An unknown overlap xi
    minimises ``psi(xi) = e(xi) xi^-(1 + preference)``, with e the mean squared distance of the
    pairs kept by the converged registration: searched on a grid of six, then by golden section.

    Attributes
    ----------
    resolution
        Typical distance between neighbouring points, m.
    points
        Random points of the source (None: all), against all of the target.
    overlap
        xi, if it is known.
    smallest
        Lower bound of the searched overlap.
    preference
        lambda of the paper (2): preference of large overlaps.
    tolerance
        Accuracy of the overlap.
    max_iterations
        Of each registration.
    """

    resolution: float = 0.01
    points: int | None = 1000
    overlap: Annotated[float | None, Bounds(0.01, 1)] = None
    smallest: Annotated[float, Bounds(0, 1, exclusive=True)] = 0.4
    preference: float = 2.0
    tolerance: Annotated[float, Bounds(0, exclusive=True)] = 0.02
    max_iterations: int = 100

    def parts(self, overlap: float) -> Icp:
        """Return the trimmed ICP for one overlap."""
        return Icp(
            self.resolution,
            source=icp_parts.at_most(self.points),
            target=icp_parts.All(),
            rejectors=(Trimmed(overlap),),
            metric=icp_parts.PointToPoint(),
            stopping=icp_parts.SmallStep(max_iterations=self.max_iterations),
        )

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; the fraction of corresponding points is the overlap."""
        if self.overlap is not None:
            return self.parts(self.overlap).register(source, target, guess, rng)
        # The same points for every overlap, to keep psi free of sampling noise.
        seed = int(rng.integers(2**62))
        results: dict[float, tuple[float, Registration]] = {}

        def psi(overlap: float) -> float:
            if overlap not in results:
                same_rng = np.random.default_rng([seed])
                registration = self.parts(overlap).register(source, target, guess, same_rng)
                floor = (1e-6 * self.resolution) ** 2
                value = max(registration.rms_m**2, floor) * overlap ** -(1 + self.preference)
                results[overlap] = (value, registration)
            return results[overlap][0]

        grid = [float(x) for x in np.linspace(self.smallest, 1, 6)]
        best = min(range(len(grid)), key=lambda k: psi(grid[k]))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        while high - low > self.tolerance:
            a = high - _GOLDEN * (high - low)
            b = low + _GOLDEN * (high - low)
            if psi(a) <= psi(b):
                high = b
            else:
                low = a
        return min(results.values(), key=lambda result: result[0])[1]


@part("registration", "iccp", label="validated")
@dataclass(frozen=True)
class Iccp(_ClosestPoints):
    """Iterative Closest Compatible Point (Godin, Rioux and Baribeau 1994).

    Only points of similar amplitude are paired, so that texture constrains what the shape does not.
    Needs amplitude in both views, compensated for range if the range differs.

    Attributes
    ----------
    ratio
        Largest ratio of two compatible amplitudes.
    """

    reach: float = 10.0
    max_iterations: int = 100
    ratio: float = 1.2

    def parts(self) -> Icp:
        """See `Variant.parts`."""
        plain = self._with_metric(icp_parts.PointToPoint())
        return replace(plain, matcher=ClosestCompatible(self.ratio))


@part("registration", "icpif", label="validated")
@dataclass(frozen=True)
class Icpif(_ClosestPoints):
    """ICP using invariant features (Sharp, Lee and Wehe 2002).

    Points are paired by their distance in space and in pose-invariant features, which enlarges the
    basin of convergence; plain ICP refines the result.

    Attributes
    ----------
    features
        Any of "curvature", "moments".
    weight
        Distance, in resolutions, equivalent to one mean absolute deviation of a feature.
    radius
        Radius of the ball for moments, in resolutions.
    reach
        Largest distance of a pair in the plain ICP, in resolutions.
    max_iterations
        Of each of the two.
    """

    reach: float = 3.0
    max_iterations: int = 100
    features: tuple[Invariant, ...] = ("moments",)
    weight: float = 20.0
    radius: float = 6.0

    def parts(self) -> InTurn:
        """See `Variant.parts`."""
        plain = self._with_metric(icp_parts.PointToPoint())
        matcher = ClosestInvariant(self.features, self.weight, self.radius)
        return InTurn((replace(plain, matcher=matcher, rejectors=(icp_parts.Unique(),)), plain))
