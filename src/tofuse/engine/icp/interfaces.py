"""Interfaces of the parts of ICP, and the data passed between them.

In each iteration the *matcher* pairs points, the *rejectors* drop pairs, the error *metric*
computes a motion from the pairs, and the *stopping* rule checks the history. Before the first
iteration a *selector* chooses the points of each view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Protocol, Self

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int64, UInt8
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.icp.surface_shape import NEIGHBOURS, Shape, normals_at, shape_at


@dataclass(frozen=True, eq=False)
class Points:
    """The selected points of a view.

    Attributes
    ----------
    view
        The view, with its normals, sigma and amplitude.
    index
        (n,) positions of the points in ``view.points``.
    points
        (n, 3) m, in the view's frame.
    neighbours
        Number of points of each plane fit, if normals are needed.
    """

    view: Frame
    index: Int64
    points: Float64
    neighbours: int = NEIGHBOURS

    @classmethod
    def of(cls, view: Frame, index: Int64, neighbours: int = NEIGHBOURS) -> Self:
        """Take the points of a view at the positions `index`."""
        return cls(view, index, view.points[index].astype(np.float64), neighbours)

    @cached_property
    def normals(self) -> Float64:
        """(n, 3) unit normals towards the sensor: the view's own, else plane fits; may be NaN."""
        return normals_at(self.view, self.index, self.neighbours)

    @cached_property
    def shape(self) -> Shape:
        """The view's surface at the points."""
        return shape_at(self.view, self.index, self.neighbours)

    @cached_property
    def amplitude(self) -> Float64:
        """(n,) amplitude in counts; RegistrationError if the view has none."""
        return self._column(self.view.amplitude, "amplitude")

    @cached_property
    def color(self) -> Float64:
        """(n, 3) RGB, 0 to 1; RegistrationError if the view has none."""
        return self._column(self.view.color, "colour") / 255

    def _column(self, values: Float32 | UInt8 | None, name: str) -> Float64:
        if values is None:
            raise RegistrationError(
                f"has no {name}, which this registration compares", where=f"frame {self.view.index}"
            )
        return values[self.index].astype(np.float64)

    @cached_property
    def variance(self) -> Float64 | None:
        """(n,) variance of the range in m^2; None if not known."""
        sigma = self.view.sigma
        return None if sigma is None else sigma[self.index].astype(np.float64) ** 2

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True, eq=False)
class Alignment:
    """State of a registration at one iteration.

    Attributes
    ----------
    source, target
        The selected points.
    resolution
        Typical distance between neighbouring points in m (res of the thesis).
    T_target_source
        (4, 4) current estimate.
    transformed
        (n, 3) the source's points in the target's frame, m.
    """

    source: Points
    target: Points
    resolution: float
    T_target_source: Float64
    transformed: Float64


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of corresponding points.

    Attributes
    ----------
    source, target
        (m,) positions in ``Alignment.source.points`` and ``Alignment.target.points``; `source`
        ascending.
    distance
        (m,) distance of the points of each pair, m.
    weight
        (m,) weights of the pairs; None for equal weights.
    """

    source: Int64
    target: Int64
    distance: Float64
    weight: Float64 | None = None

    def __len__(self) -> int:
        return len(self.source)

    def keep(self, mask: Bool) -> Matches:
        """Return the pairs of the (m,) mask."""
        if mask.all():
            return self
        weight = None if self.weight is None else self.weight[mask]
        return Matches(self.source[mask], self.target[mask], self.distance[mask], weight)

    def weights(self) -> Float64:
        """Return the (m,) weights, ones where none are given."""
        return np.ones(len(self)) if self.weight is None else self.weight


@dataclass
class History:
    """Statistics of the iterations so far.

    Attributes
    ----------
    correspondences
        Number of pairs.
    errors
        E.
    steps
        RMS displacement of the source's points by the motion, in resolutions.
    """

    correspondences: list[int] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.errors)


class Selector(Protocol):
    """Selects points of a view (section 2.9.2), anew at every iteration if `each_iteration`."""

    part_kind: ClassVar[str] = "selector"
    each_iteration: ClassVar[bool] = False

    def select(self, view: Frame, rng: np.random.Generator) -> Int64:
        """Return ascending positions (n,) in ``view.points``."""
        ...


class Search(Protocol):
    """A matcher prepared for one target."""

    def match(self, alignment: Alignment, reach: float) -> Matches:
        """Pair points of the source with points of the target.

        Pairs of points further apart than `reach` (m) will be rejected anyway and may be omitted.
        """
        ...


class Matcher(Protocol):
    """Finds which point of the target corresponds to a point of the source (section 2.9.3)."""

    part_kind: ClassVar[str] = "matcher"
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def prepare(self, target: Points) -> Search:
        """Precompute what depends on the target only, a kd-tree for example."""
        ...


class Rejector(Protocol):
    """Drops pairs that are likely to be wrong (section 2.9.4)."""

    part_kind: ClassVar[str] = "rejector"

    def reach(self, resolution: float) -> float:
        """Return the distance in m beyond which all pairs are dropped; infinity if unlimited."""
        return math.inf

    def reject(self, matches: Matches, alignment: Alignment) -> Matches:
        """Return the remaining pairs, in the same order."""
        ...


class Metric(Protocol):
    """The error that the motion minimises, and the information it provides."""

    part_kind: ClassVar[str] = "metric"

    def motion(self, matches: Matches, alignment: Alignment) -> Float64:
        """Return the motion (4, 4), in the target's frame, that aligns the pairs best.

        It is applied from the left: ``T_target_source <- motion @ T_target_source``.

        Raises
        ------
        RegistrationError
            If the pairs don't determine a motion.
        """
        ...

    def information(self, matches: Matches, alignment: Alignment) -> Float64:
        """Return the information (6, 6) of the estimate, as in `Registration.information`."""
        ...

    def unobservable(self, matches: Matches, alignment: Alignment) -> Float64:
        """Return the degenerate directions (k, 6), as in `Registration`; k = 0 if unknown."""
        return np.zeros((0, 6))


class Stopping(Protocol):
    """Termination criterion of the iterations."""

    part_kind: ClassVar[str] = "stopping"

    @property
    def max_iterations(self) -> int:
        """Maximum number of iterations."""
        ...

    def met(self, history: History) -> bool:
        """Whether the estimate has converged."""
        ...
