"""Points and unit vectors along rays, which cameras give as (x/z, y/z)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64


def homogeneous(rays: ArrayLike) -> Float64:
    """Return the points (..., 3) at z = 1 of rays (..., 2)."""
    rays = np.asarray(rays, float)
    return np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], -1)


def unit_rays(rays: ArrayLike) -> Float64:
    """Return the unit vectors (..., 3) of rays (..., 2)."""
    points = homogeneous(rays)
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True), np.float64)
