"""Distinct surfaces of a cloud: all points on one plane count as one.

Two walls and a floor can be laid over those of any other room, whatever fraction of the points lies
on them.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64

# Cosine of the largest angle between normals of points on one plane, and points compared at once.
_COPLANAR_COSINE, _CHUNK = 0.9, 500


def shares(points: Float64, normals: Float64, tolerance_m: float) -> Float64:
    """Return the share (n,) of each point in its plane: 1 / the number of points on that.

    Parameters
    ----------
    points, normals
        (n, 3) points in m, and unit normals of either sign.
    tolerance_m
        Largest distance of a point from a plane that it is on, m.
    """
    count = np.empty(len(points))
    for k in range(0, len(points), _CHUNK):
        p, n = points[k : k + _CHUNK], normals[k : k + _CHUNK]
        beside = np.abs((p * n).sum(1)[:, None] - n @ points.T)
        parallel = np.abs(n @ normals.T) > _COPLANAR_COSINE
        count[k : k + _CHUNK] = (parallel & (beside < tolerance_m)).sum(1)
    return 1 / np.maximum(count, 1)
