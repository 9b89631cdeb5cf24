"""Planes in a range image, by RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Bool, Float64
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.view_points import sampled_points

# Points of a view, and hypotheses in each round of RANSAC.
_POINTS, _TRIED = 3000, 150
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
        Of the view's points, those on it.
    rms_m
        Distance of these from it.
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
    seen = sampled_points(view, _POINTS)
    p, n = seen.points.astype(float), seen.normals.astype(float)
    within = sigmas * seen.sigma.astype(float) + thickness * p[:, 2]
    weight = 1 / within**2
    left = np.ones(len(p), bool)
    planes: list[Plane] = []
    while len(planes) < max_planes and left.sum() >= max(3, min_fraction * len(p)):
        tried = rng.choice(np.flatnonzero(left), min(_TRIED, int(left.sum())), replace=False)
        offsets = (p[tried] * n[tried]).sum(1)
        on = _on(p, n, within, n[tried], offsets) & left
        mine = on[int(np.argmax(on.sum(1)))]
        for _ in range(3):
            normal, offset = fit_plane(p[mine], weight[mine])
            mine = _on(p, n, within, normal[None], np.array([offset]))[0] & left
            if mine.sum() < 3:
                break
        if mine.sum() < max(3, min_fraction * len(p)):
            break
        left &= ~mine
        rms = float(np.sqrt(((p[mine] @ normal - offset) ** 2).mean()))
        planes.append(Plane(normal, offset, float(mine.mean()), rms))
    return planes


def _on(p: Float64, n: Float64, within: Float64, normals: Float64, offsets: Float64) -> Bool:
    """Whether each point lies on each of K planes, (K, N)."""
    near = np.abs(normals @ p.T - offsets[:, None]) < within
    return near & (normals @ n.T > np.cos(_MAX_ANGLE))


def fit_plane(p: Float64, weight: Float64) -> tuple[Float64, float]:
    """Return the weighted least squares plane of points (N, 3): normal and offset along it.

    The normal (3,) points away from the camera.
    """
    mean = weight @ p / weight.sum()
    q = (p - mean) * np.sqrt(weight)[:, None]
    normal = np.linalg.eigh(q.T @ q)[1][:, 0]
    offset = float(mean @ normal)
    return (normal, offset) if offset > 0 else (-normal, -offset)
