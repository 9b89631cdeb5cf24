"""Planes in a range image by RANSAC; and the floor, the lowest horizontal one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.search import search_kernels as kernels
from tofuse.engine.search.pair_agreement import sampled_points
from tofuse.engine.views import PreparedView

# Number of sampled points, and of hypotheses of the floor.
_FLOOR_POINTS, _FLOOR_HYPOTHESES = 1200, 200
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

# Points of a view, and hypotheses in each round of RANSAC.
_POINTS, _HYPOTHESES = 3000, 150
# Largest angle between the normals of a plane and of its inliers, rad.
_MAX_ANGLE = 0.35


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane ``normal . p = offset`` in a view.

    Attributes
    ----------
    normal
        (3,) unit, away from the camera.
    offset
        m, above 0.
    fraction
        Fraction of the view's points on it.
    rms_m
        RMS distance of these points from it.
    """

    normal: Float64
    offset: float
    fraction: float
    rms_m: float


def detect_planes(
    view: PreparedView,
    rng: np.random.Generator,
    *,
    max_planes: int = 8,
    min_fraction: float = 0.03,
    sigmas: float = 2.5,
    thickness: float = 0.005,
) -> list[Plane]:
    """Detect the planes of a view by RANSAC, the largest first.

    Each sampled point with its normal is a hypothesis. The one with the most inliers is fitted to
    them by weighted least squares, and its inliers are removed.

    Parameters
    ----------
    view
        A prepared range image.
    rng
        Draws the hypotheses.
    max_planes
        Largest number of planes.
    min_fraction
        Smallest fraction of the view's points on a plane.
    sigmas, thickness
        Largest distance of an inlier: standard deviations, plus a fraction of its depth.
    """
    sampled = sampled_points(view, _POINTS)
    p, n = sampled.points.astype(float), sampled.normals.astype(float)
    max_distance = sigmas * sampled.sigma.astype(float) + thickness * p[:, 2]
    weight = 1 / max_distance**2
    remaining = np.ones(len(p), bool)
    planes: list[Plane] = []
    while len(planes) < max_planes and remaining.sum() >= max(3, min_fraction * len(p)):
        hypotheses = rng.choice(
            np.flatnonzero(remaining), min(_HYPOTHESES, int(remaining.sum())), replace=False
        )
        offsets = (p[hypotheses] * n[hypotheses]).sum(1)
        is_inlier = _on_planes(p, n, max_distance, n[hypotheses], offsets) & remaining
        inliers = is_inlier[int(np.argmax(is_inlier.sum(1)))]
        for _ in range(3):
            normal, offset = fit_plane(p[inliers], weight[inliers])
            inliers = (
                _on_planes(p, n, max_distance, normal[None], np.array([offset]))[0] & remaining
            )
            if inliers.sum() < 3:
                break
        if inliers.sum() < max(3, min_fraction * len(p)):
            break
        remaining &= ~inliers
        rms = float(np.sqrt(((p[inliers] @ normal - offset) ** 2).mean()))
        planes.append(Plane(normal, offset, float(inliers.mean()), rms))
    return planes


def _on_planes(
    p: Float64, n: Float64, max_distance: Float64, normals: Float64, offsets: Float64
) -> Bool:
    """Whether each point lies on each of K planes, (K, N)."""
    is_near = np.abs(normals @ p.T - offsets[:, None]) < max_distance
    return is_near & (normals @ n.T > np.cos(_MAX_ANGLE))


def fit_plane(p: Float64, weight: Float64) -> tuple[Float64, float]:
    """Return the weighted least squares plane of points (N, 3): normal and offset along it.

    The normal (3,) points away from the camera.
    """
    mean = weight @ p / weight.sum()
    q = (p - mean) * np.sqrt(weight)[:, None]
    normal = np.linalg.eigh(q.T @ q)[1][:, 0]
    offset = float(mean @ normal)
    return (normal, offset) if offset > 0 else (-normal, -offset)


@dataclass(frozen=True, eq=False)
class Floor:
    """A plane n . p = height in m, n (3,) pointing down; fraction of the view's points on it."""

    normal: Float64
    height: float
    fraction: float


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
    sampled = sampled_points(view, _FLOOR_POINTS)
    p, n = sampled.points.astype(float), sampled.normals.astype(float)
    if len(p) < 20:
        return None
    facing = np.flatnonzero(n @ down > _MIN_COSINE)
    if len(facing) < _MIN_INLIERS * len(p):
        return None
    # Contiguous for any step, so that the kernel is compiled once.
    hypotheses = np.ascontiguousarray(facing[:: max(1, len(facing) // _FLOOR_HYPOTHESES)])
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
