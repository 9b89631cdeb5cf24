"""Detection of the floor in a range image: the lowest horizontal plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.search import search_kernels as kernels
from tofuse.engine.search.plane_detection import fit_plane
from tofuse.engine.search.view_points import sampled_points
from tofuse.engine.views import PreparedView


@dataclass(frozen=True, eq=False)
class Floor:
    """A plane n . p = height in m, n (3,) pointing down; fraction of the view's points on it."""

    normal: Float64
    height: float
    fraction: float


# Number of sampled points, and of plane hypotheses.
_POINTS, _HYPOTHESES = 1200, 200
# Inlier tolerances: angle between the normals, rad, and distance from the plane, m plus a fraction
# of the depth. They cover the systematic errors of ToF cameras, which exceed their noise.
_ANGLE, _BAND_M, _BAND_FRACTION = 0.15, 0.02, 0.01
# Minimum fraction of the view's points on the floor, and maximum fraction below it.
_MIN_INLIERS, _MAX_BELOW = 0.04, 0.02
# Bands below a plane from which on a point counts as below it.
_BELOW = 3.0
# Candidates for down in the frame of an unknown camera: +y, or sideways in portrait orientation.
_DOWN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
# Minimum cosine between the floor's normal and down: any usual attitude of the camera.
_MIN_COSINE = float(np.cos(0.9))


def find_floors(source: PreparedView, target: PreparedView) -> tuple[Floor, Floor] | None:
    """Find the floor in two views of one camera, on the same side of both images, or None."""
    for down in _DOWN:
        first = find_floor(source, down)
        second = first and find_floor(target, down)
        if first is not None and second is not None:
            return first, second
    return None


def find_floor(view: PreparedView, down: Float64) -> Floor | None:
    """Find the largest plane about perpendicular to `down`, without points below it, or None.

    Parameters
    ----------
    view
        The prepared view.
    down
        (3,) unit vector, the approximate direction of gravity in the camera's frame.
    """
    sampled = sampled_points(view, _POINTS)
    p, n = sampled.points.astype(float), sampled.normals.astype(float)
    if len(p) < 20:
        return None
    facing = np.flatnonzero(n @ down > _MIN_COSINE)
    if len(facing) < _MIN_INLIERS * len(p):
        return None
    hypotheses = facing[:: max(1, len(facing) // _HYPOTHESES)]
    weight = 1 / np.maximum(sampled.sigma.astype(float), 1e-4) ** 2
    band = _BAND_M + _BAND_FRACTION * p[:, 2]
    # A table may be larger than the visible floor, but has points below it.
    cosine, max_below = float(np.cos(_ANGLE)), _MAX_BELOW * len(p)
    best = kernels.lowest_plane(p, n, band, hypotheses, cosine, max_below, _BELOW)
    normal, height = n[best], float(p[best] @ n[best])
    inliers = _on_plane(p, n, band, normal, height, cosine)
    for _ in range(3):  # least squares over the inliers
        normal, height = fit_plane(p[inliers], weight[inliers])
        inliers = _on_plane(p, n, band, normal, height, cosine)
        if inliers.sum() < max(20, _MIN_INLIERS * len(p)):
            return None
    below = np.count_nonzero(p @ normal > height + _BELOW * band)
    if below > _MAX_BELOW * len(p) or normal @ down < _MIN_COSINE or height <= 0:
        return None
    return Floor(normal, height, float(inliers.mean()))


def _on_plane(
    p: Float64, n: Float64, band: Float64, normal: Float64, height: float, cosine: float
) -> Bool:
    """Whether points p (N, 3) with normals n (N, 3) lie on a plane, (N,)."""
    return np.asarray((np.abs(p @ normal - height) < band) & (n @ normal > cosine))
