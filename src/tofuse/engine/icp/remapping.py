"""Solution remapping: degenerate directions keep the guess (Zhang, Kaess and Singh 2016)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3


@dataclass(frozen=True, eq=False)
class Remapping:
    """Directions of the right perturbation along which a registration must not move.

    Attributes
    ----------
    directions
        (k, 6) about the source's origin, as in `Registration.unobservable`.
    centre
        (3,) centroid of the source's points, m.
    size
        Their rms distance from it, m, which scales angles to lengths.
    """

    directions: Float64
    centre: Float64
    size: float

    @classmethod
    def of(cls, directions: Float64, points: Float64) -> Remapping:
        """Fix `directions` (k, 6) of a source with points (n, 3)."""
        centre = points.mean(0)
        size = float(np.sqrt(((points - centre) ** 2).sum(1).mean()))
        return cls(directions, centre, size or 1.0)

    def along(self, T: Float64) -> Float64:
        """Return the component (4, 4) of a small motion T in the source's frame along them."""
        return self._project(T, along=True)

    def across(self, T: Float64) -> Float64:
        """Return the component (4, 4) of a small motion T in the source's frame across them."""
        return self._project(T, along=False)

    def _project(self, T: Float64, *, along: bool) -> Float64:
        T_centre_source = np.eye(4)
        T_centre_source[:3, 3] = -self.centre
        scale = np.array([1, 1, 1, self.size, self.size, self.size])
        scaled = (self.directions @ se3.adjoint(T_centre_source).T) * scale
        basis = np.linalg.svd(scaled, full_matrices=False)[2]
        xi = se3.log(se3.about(-self.centre, T)) * scale
        component = sum((b * float((b * xi).sum()) for b in basis), np.zeros(6))
        return se3.about(self.centre, se3.exp((component if along else xi - component) / scale))
