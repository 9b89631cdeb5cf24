"""Whether views measure through an opening what the reflection of the room predicts.

The image in a mirror is that of the mirrored room, so its points are projected into the views. A
camera that illuminates the scene also illuminates what it sees in the mirror, by two paths: by the
mirror and back, and directly and back by the mirror, which is shorter. The range is between the
two, by their strengths; where one of them is negligible, it is the other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tofuse.apps.mirrors.openings import Opening, Plane
from tofuse.apps.mirrors.views import Noise, View
from tofuse.engine.arrays import Bool, Float64, Int64

_REFLECTANCE = 0.9  # of a mirror; the result hardly depends on it
# Beyond this multiple of the corner's angle, lamps don't shine.
_LAMP = 1.3
# Planes that are compared: wrong by so much.
_SHIFTS_M, _TILT_RAD = (-0.4, -0.2, 0.2, 0.4), 0.2
# Edge of a patch of the room, whose points are one piece of evidence, and how many it has.
_PATCH_M, _MIN_IN_PATCH = 0.2, 5
# Fewest patches that can decide, and smallest share of agreeing pixels worth a comparison.
_MIN_PATCHES, _MIN_SHARE = 15, 0.5
# A mirror explains one of these shares of the pixels that chance does not: weak pixels, which are
# unwrapped wrongly, are not explained. Chance before any comparison.
_EXPLAINED, _CHANCE = np.linspace(0.05, 0.95, 10), 0.3


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
    pixels
        (N,) numbers of the pixels, through all views.
    """

    points: Float64
    origins: Float64
    direct: Float64
    direct_share: Float64
    measured: Float64
    pixels: Int64

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
    opening: Opening,
    mirror: Plane,
    views: Sequence[View],
    points: Float64,
    normals: Float64,
    noise: Noise,
) -> Prediction:
    """Predict what views see through an opening if there is a mirror behind it.

    Parameters
    ----------
    mirror
        The plane that reflects: that of the opening, or a wrong one for comparison.
    points, normals
        (N, 3) of the model.
    """
    plane = opening.plane
    in_front = plane.height(points) > 2 * noise.tolerance_m
    points, normals = points[in_front], normals[in_front]
    phantom = mirror.reflected(points)
    points_of_none, none = np.zeros((0, 3)), np.zeros(0)
    parts = [
        Prediction(points_of_none, points_of_none, none, none, none, np.zeros(0, np.int64)),
    ]
    first = 0
    for view in views:
        if plane.height(view.origin) > 2 * noise.tolerance_m:
            part = _of_view(opening, mirror, view, points, normals, phantom, noise)
            parts.append(replace(part, pixels=part.pixels + first))
        first += view.ranges.size
    names = [field.name for field in fields(Prediction)]
    return Prediction(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _of_view(
    opening: Opening,
    mirror: Plane,
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
    number = np.ravel_multi_index(tuple(pixels[used].T), view.ranges.shape)
    p, n = points[rows], normals[rows]
    in_camera, at, inside = view.project(p)
    distance = np.linalg.norm(in_camera, axis=1)
    angle = np.arccos(np.clip(in_camera[:, 2] / np.maximum(distance, 1e-9), -1, 1))
    seen = view.at(view.ranges, at)
    lit = inside & ((seen <= 0) | (seen > distance - 2 * noise.tolerance_m))
    # Outside of the image, whether it is lit is not known.
    known = inside | (angle > _LAMP * view.corner_rad)
    reflected = rays - 2 * (rays @ mirror.normal)[:, None] * mirror.normal
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
        number[known],
    )


@dataclass(frozen=True)
class Evidence:
    """For or against a mirror in an opening.

    Attributes
    ----------
    share
        Of the pixels whose ranges agree with the reflection.
    log_ratio
        Logarithm of the likelihood ratio of a mirror to chance.
    patches
        How many patches of the room should be seen in the mirror: the independent pieces.
    """

    share: float
    log_ratio: float
    patches: int


def weigh(
    opening: Opening,
    views: Sequence[View],
    points: Float64,
    normals: Float64,
    noise: Noise,
    *,
    compare: bool = True,
) -> Evidence:
    """Weigh whether an opening is a mirror, or only see how far it agrees.

    The arguments are those of `predict`.

    A pixel tells little if wrong planes predict its range as well: a floor is its own reflection in
    all walls, and directly illuminated surfaces are seen at nearly the same range in any mirror.
    """
    seen = predict(opening, opening.plane, views, points, normals, noise)
    agrees = seen.coincides(opening.plane, noise)
    found = patches(seen)
    share = float(agrees.mean()) if len(seen) else 0.0
    if not compare or found < _MIN_PATCHES or share < _MIN_SHARE:
        return Evidence(share, 0.0, found)
    by_chance, compared = np.full(len(seen), _CHANCE), np.ones(len(seen))
    for plane in wrong_planes(opening):
        other = predict(opening, plane, views, points, normals, noise)
        numbers, first = np.unique(other.pixels, return_index=True)
        if not len(numbers):
            continue
        at = np.searchsorted(numbers, seen.pixels).clip(max=len(numbers) - 1)
        both = numbers[at] == seen.pixels
        by_chance += both * other.coincides(plane, noise)[first][at]
        compared += both
    chance = by_chance / compared
    explained = _EXPLAINED[:, None]
    ratios = np.where(agrees, (chance + explained * (1 - chance)) / chance, 1 - explained)
    return Evidence(share, found * float(np.log(ratios).mean(1).max()), found)


def wrong_planes(opening: Opening) -> list[Plane]:
    """Return planes that would be mirrors by chance only: shifted and tilted ones."""
    plane, centre = opening.plane, opening.corners.mean(0)
    shifted = [Plane(plane.normal, plane.offset + s) for s in _SHIFTS_M]
    tilted = []
    for axis in (*plane.axes, *-plane.axes):
        normal = plane.normal + np.tan(_TILT_RAD) * axis
        normal /= np.linalg.norm(normal)
        tilted.append(Plane(normal, float(normal @ centre)))
    return shifted + tilted


def patches(prediction: Prediction) -> int:
    """Return how many patches of the room should be seen in the mirror."""
    if not len(prediction):
        return 0
    cells = np.floor(prediction.points / _PATCH_M).astype(np.int64)
    return int((np.unique(cells, axis=0, return_counts=True)[1] >= _MIN_IN_PATCH).sum())
