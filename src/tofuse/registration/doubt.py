"""Information that errors fixed to the camera can fake: what has to be left of it to be believed.

Independent noise cancels in the symmetrised cross-information of two views. What bends both views
alike does not: light by way of other surfaces rounds corners and bows walls, scattering and the
lens shade the albedo, and range errs with the brightness. Such errors tilt normals and slope the
albedo in both Jacobians, and a flat wall seems to hold what it can't. How much they can fake at
most follows from how large such tilts and slopes are known to be.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


def faked_information(
    points: Float32,
    normals: Float32,
    variance: Float32 | Float64,
    photo_variance: float,
    lit: NDArray[np.bool_],
    tilt: float,
    slope: float,
) -> Float64:
    """(6, 6) expected information of random tilts and slopes that two views have in common.

    Parameters
    ----------
    points, normals
        (N, 3) of the source, m and unit.
    variance
        (N,) of the distances between the views, m^2.
    photo_variance
        Of the log albedo; 0 if it takes no part.
    lit
        (N,) whether the albedo of a point is known.
    tilt
        Standard deviation of the common error of normals along either tangent, rad.
    slope
        The same of the log albedo's slopes by ray coordinate.
    """
    p = points.astype(float)
    n = normals.astype(float)
    out = np.zeros((6, 6))
    if not len(p):
        return out
    # Two tangents of each plane, from the axis that it faces least.
    axis = np.eye(3)[np.argmin(np.abs(n), axis=1)]
    first = np.cross(n, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    weight = tilt**2 / np.maximum(variance, 1e-12)
    for tangent in (first, np.cross(n, first)):
        J = np.concatenate([tangent, np.cross(p, tangent)], 1)
        out += (J * weight[:, None]).T @ J
    if photo_variance > 0 and slope > 0:
        p = p[lit]
        for k in range(2):
            m = np.zeros_like(p)
            m[:, k] = 1 / p[:, 2]
            m[:, 2] = -p[:, k] / p[:, 2] ** 2
            J = np.concatenate([m, np.cross(p, m)], 1)
            out += slope**2 / photo_variance * J.T @ J
    return out
