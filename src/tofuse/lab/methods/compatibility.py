"""Rejectors of the literature: incompatible pairs, pairs beyond the overlap (section 2.9.4)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.geometry import se3
from tofuse.engine.icp import icp_kernels, interfaces
from tofuse.engine.parts import part
from tofuse.lab.methods.neighbourhoods import mean_curvature


@part("rejector", "normal", label="validated")
@dataclass(frozen=True)
class NormalCompatibility(Bounded, interfaces.Rejector):
    """Drops pairs whose normals differ in direction (Zhang 1994; Pulli 1999).

    Pairs without a normal are dropped as well.

    Attributes
    ----------
    max_angle_rad
        Largest angle between the normals, rad; Pulli: 45 degrees.
    """

    max_angle_rad: Annotated[float, Bounds(0, math.pi, exclusive=True)] = math.pi / 4

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        rotation = se3.pose(alignment.T_target_source[:3, :3])
        a = icp_kernels.transform_points(rotation, alignment.source.normals[matches.source])
        b = alignment.target.normals[matches.target]
        return matches.keep((a * b).sum(1) >= math.cos(self.max_angle_rad))


@part("rejector", "curvature", label="validated")
@dataclass(frozen=True)
class CurvatureCompatibility(Bounded, interfaces.Rejector):
    """Drops pairs of different curvature (section 2.9.4).

    Attributes
    ----------
    tolerance
        Largest difference of the mean curvatures, times the resolution.
    """

    tolerance: Annotated[float, Bounds(0, exclusive=True)] = 0.2

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        a = mean_curvature(alignment.source)[matches.source]
        b = mean_curvature(alignment.target)[matches.target]
        return matches.keep(np.abs(a - b) * alignment.resolution <= self.tolerance)


@part("rejector", "amplitude", label="validated")
@dataclass(frozen=True)
class AmplitudeCompatibility(Bounded, interfaces.Rejector):
    """Drops pairs of different amplitude (Godin et al. 1994); needs amplitude in both views.

    Attributes
    ----------
    ratio
        Largest ratio of the amplitudes, more than 1.
    """

    ratio: Annotated[float, Bounds(1, exclusive=True)] = 1.5

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        a = alignment.source.amplitude[matches.source]
        b = alignment.target.amplitude[matches.target]
        return matches.keep((a > 0) & (b > 0) & (a <= self.ratio * b) & (b <= self.ratio * a))


@part("rejector", "color", label="validated")
@dataclass(frozen=True)
class ColorCompatibility(Bounded, interfaces.Rejector):
    """Drops pairs of different colour (Pulli 1999); needs colour in both views.

    Attributes
    ----------
    tolerance
        Largest RGB distance; black and white differ by sqrt(3).
    """

    tolerance: Annotated[float, Bounds(0, exclusive=True)] = 0.2

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        difference = alignment.source.color[matches.source] - alignment.target.color[matches.target]
        return matches.keep((difference * difference).sum(1) <= self.tolerance**2)


@part("rejector", "boundary", label="validated")
@dataclass(frozen=True)
class Boundary(interfaces.Rejector):
    """Drops pairs whose target point is on the surface boundary (Turk and Levoy 1994).

    With partial overlap, all points beyond the overlap are closest to its boundary, and would bias
    the motion towards the target.
    """

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        return matches.keep(~alignment.target.shape.boundary[matches.target])


@part("rejector", "trimmed", label="validated")
@dataclass(frozen=True)
class Trimmed(Bounded, interfaces.Rejector):
    """Keeps the shortest pairs, as many as the source has points in the overlap (TrICP).

    Chetverikov, Stepanov and Krsek (2005). Of equally short pairs the first are kept.

    Attributes
    ----------
    overlap
        Fraction of the selected points of the source that lie in the overlap.
    """

    overlap: Annotated[float, Bounds(0.01, 1)] = 0.8

    def reject(
        self, matches: interfaces.Matches, alignment: interfaces.Alignment
    ) -> interfaces.Matches:
        """See `Rejector.reject`."""
        count = int(self.overlap * len(alignment.source))
        if count >= len(matches):
            return matches
        keep = np.zeros(len(matches), bool)
        keep[np.argsort(matches.distance, kind="stable")[:count]] = True
        return matches.keep(keep)
