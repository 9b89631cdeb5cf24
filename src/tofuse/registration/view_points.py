"""Pixels of a view, one property an array, as what compares whole views takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels.alignment import LIGHT, NORMAL, POINT, SIGMA
from tofuse.maps.surface_map import SurfaceMap
from tofuse.registration.projective import points_of

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ViewPoints:
    """Points on the planes of a view.

    Attributes
    ----------
    points, normals
        (N, 3) m, and unit, away from the camera.
    sigma
        (N,) of their z, m.
    light
        (N,) log albedo, NaN where unknown.
    """

    points: Float32
    normals: Float32
    sigma: Float32
    light: Float32

    @classmethod
    def of(cls, view: SurfaceMap, count: int) -> ViewPoints:
        """Take about `count` pixels that have a plane, evenly over the image."""
        there = view.planar_share * view.z.size
        packed = points_of(view, max(1, round(float(np.sqrt(there / count)))))
        points = np.ascontiguousarray(packed[:, POINT : POINT + 3])
        return cls(
            points,
            np.ascontiguousarray(packed[:, NORMAL : NORMAL + 3]),
            packed[:, SIGMA] * points[:, 2],
            packed[:, LIGHT].copy(),
        )
