"""Whether views measure through an opening what the reflection of the room predicts.

The image in a mirror is that of the mirrored room, so its points are projected into the views. A
camera that illuminates the scene also illuminates what it sees in the mirror, by two paths: by the
mirror and back, and directly and back by the mirror, which is shorter. The range is between the
two, by their strengths; where one of them is negligible, it is the other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from tofuse.apps.mirrors.openings import Opening, Plane
from tofuse.apps.mirrors.views import Noise, View
from tofuse.engine.arrays import Bool, Float64, Int64

_REFLECTANCE = 0.9  # of a mirror; the result hardly depends on it
# Beyond this multiple of the corner's angle, lamps don't shine.
_LAMP = 1.3
# Edge of a patch, whose points are one piece of evidence, relative to the extent of the opening.
_PATCH = 0.15


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted and measured ranges of N pixels that look through an opening.

    Attributes
    ----------
    points
        (N, 3) of the model in front of the plane whose reflection is seen.
    origins
        (N, 3) of the camera.
    direct
        (N,) distance from the camera to the point, and the share of the light on that path.
    direct_share
        (N,) 0 where the camera does not illuminate it directly.
    measured
        (N,) m.
    """

    points: Float64
    origins: Float64
    direct: Float64
    direct_share: Float64
    measured: Float64

    def __len__(self) -> int:
        return len(self.points)

    def residuals(self, plane: Plane) -> Float64:
        """Measured minus predicted ranges (N,), m, with the mirror in this plane."""
        by_mirror = np.linalg.norm(plane.reflected(self.points) - self.origins, axis=1)
        return self.measured - by_mirror + 0.5 * self.direct_share * (by_mirror - self.direct)

    def coincides(self, plane: Plane, noise: Noise) -> Bool:
        """Which of the measured ranges agree."""
        by_mirror = np.linalg.norm(plane.reflected(self.points) - self.origins, axis=1)
        # Two phases add up to one in between, in a ratio that depends on the frequency.
        mixed = np.minimum(self.direct_share, 1 - self.direct_share) * (by_mirror - self.direct) / 2
        tolerance = noise.tolerance_m * np.maximum(1, by_mirror / noise.range_m)
        return np.abs(self.residuals(plane)) < 2 * tolerance + mixed


def predict(
    opening: Opening, views: Sequence[View], points: Float64, normals: Float64, noise: Noise
) -> Prediction:
    """Predict what views see through an opening if there is a mirror in it.

    Parameters
    ----------
    points, normals
        (N, 3) of the model.
    """
    plane = opening.plane
    in_front = plane.height(points) > 2 * noise.tolerance_m
    points, normals = points[in_front], normals[in_front]
    phantom = plane.reflected(points)
    parts = [_empty()]
    for view in views:
        if plane.height(view.origin) > 2 * noise.tolerance_m:
            parts.append(_of_view(opening, view, points, normals, phantom, noise))
    names = ("points", "origins", "direct", "direct_share", "measured")
    return Prediction(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _empty() -> Prediction:
    return Prediction(np.zeros((0, 3)), np.zeros((0, 3)), *np.zeros((3, 0)))


def _of_view(
    opening: Opening,
    view: View,
    points: Float64,
    normals: Float64,
    phantom: Float64,
    noise: Noise,
) -> Prediction:
    plane, origin = opening.plane, view.origin
    rows, pixels = view.visible(phantom)
    rays = phantom[rows] - origin
    length = np.linalg.norm(rays, axis=1)
    rays /= length[:, None]
    reached = plane.crossings(origin, rays)
    measured = view.at(view.ranges, pixels)
    used = (measured > 0) & np.isfinite(reached)
    if view.amplitude is not None:
        used &= view.at(view.amplitude, pixels) >= noise.weakest
    used[used] = opening.contains(origin + reached[used, None] * rays[used])
    rows, rays, length, measured = rows[used], rays[used], length[used], measured[used]
    p, n = points[rows], normals[rows]
    in_camera, at, inside = view.project(p)
    distance = np.linalg.norm(in_camera, axis=1)
    angle = np.arccos(np.clip(in_camera[:, 2] / np.maximum(distance, 1e-9), -1, 1))
    seen = view.at(view.ranges, at)
    lit = inside & ((seen <= 0) | (seen > distance - 2 * noise.tolerance_m))
    # Outside of the image, whether it is lit is not known.
    known = inside | (angle > _LAMP * view.corner_rad)
    reflected = rays - 2 * (rays @ plane.normal)[:, None] * plane.normal
    by_mirror = _REFLECTANCE * np.maximum(-(n * reflected).sum(1), 0) / length**2
    toward = (p - origin) / np.maximum(distance, 1e-9)[:, None]
    direct = lit * np.maximum(-(n * toward).sum(1), 0) / np.maximum(distance, 1e-9) ** 2
    share = direct / np.maximum(direct + by_mirror, 1e-12)
    return Prediction(
        p[known],
        np.tile(origin, (int(known.sum()), 1)),
        distance[known],
        share[known],
        measured[known],
    )


def refined(opening: Opening, prediction: Prediction, noise: Noise) -> Opening:
    """Move the plane of an opening to where the reflection agrees best."""
    centre = opening.corners.mean(0)

    def moved(x: Float64) -> Plane:
        normal = opening.plane.normal + x[:2] @ opening.plane.axes
        normal /= np.linalg.norm(normal)
        return Plane(normal, float(normal @ centre + x[2]))

    found = least_squares(
        lambda x: prediction.residuals(moved(x)) / noise.tolerance_m,
        np.zeros(3),
        loss="cauchy",
        max_nfev=20,
    )
    plane = moved(found.x)
    corners = opening.corners
    corners = corners - plane.height(corners)[:, None] * plane.normal
    return replace(opening, plane=plane, outline=corners @ plane.axes.T)


def agreement(prediction: Prediction, agrees: Bool, patch: float) -> tuple[int, int]:
    """Return the numbers of patches of the room that are seen, and that are seen in the mirror."""
    if not len(prediction):
        return 0, 0
    cells = np.floor(prediction.points / patch).astype(np.int64)
    _, patches = np.unique(cells, axis=0, return_inverse=True)
    count = np.bincount(patches.ravel())
    hits = np.bincount(patches.ravel(), agrees)
    return len(count), int((hits > 0.5 * count).sum())
