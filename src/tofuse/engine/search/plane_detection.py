"""Planes in a range image, by RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.search.view_points import sampled_points
from tofuse.engine.views import PreparedView

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
