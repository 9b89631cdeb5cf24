"""Whether views measure through an opening what the reflection of the room predicts.

The image in a mirror is that of the mirrored room, so its points are projected into the views. A
camera that illuminates the scene also illuminates what it sees in the mirror, by two paths: by the
mirror and back, and directly and back by the mirror, which is shorter. How the two add up depends
on the camera: as phasors of its modulation, in proportion to their strengths, or the stronger one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tofuse.apps.mirrors.openings import Opening, Plane
from tofuse.apps.mirrors.views import Noise, View, wrapped
from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.frames import evenly_spaced

_REFLECTANCE = 0.9  # of a mirror; the result hardly depends on it
# Share of light that the shorter path may have more or less than predicted. The more it may, the
# more of the ranges agree with wrong planes, too.
_DIVISION = 0.03
# Wavelengths of the modulation that are tried, on so many pixels.
_PERIODS_M, _LIT = (0.0, np.inf, *np.geomspace(0.7, 6.0, 38)), 1500
# Beyond this multiple of the corner's angle, lamps don't shine.
_LAMP = 1.3
# Planes that are compared: shifted by so much, or by so many tolerances, and tilted.
_SHIFT_M, _SHIFT_TOLERANCES, _TILT_RAD = 0.2, 5.0, 0.2
# Edge of a patch of the room, whose points are one piece of evidence, and how many it has.
_PATCH_M, _MIN_IN_PATCH = 0.2, 5
_MIN_PATCHES = 15  # fewest that can decide
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
    length
        (N,) distance from the camera to the image of the point, m.
    direct
        (N,) distance from the camera to the point, and the share of the light on that path.
    direct_share
        (N,) 0 where the camera does not illuminate it directly.
    measured, ambiguity_m
        (N,) m; up to multiples of the latter.
    pixels
        (N,) numbers of the pixels, through all views.
    weak
        (N,) whether the amplitude is low: often unwrapped wrongly.
    """

    points: Float64
    length: Float64
    direct: Float64
    direct_share: Float64
    measured: Float64
    ambiguity_m: Float64
    pixels: Int64
    weak: Bool

    def __len__(self) -> int:
        return len(self.points)

    def is_room(self, noise: Noise) -> Bool:
        """Which of the measured ranges agree, with a room in place of the image."""
        off = wrapped(self.measured - self.length, self.ambiguity_m)
        return np.abs(off) < self._tolerance(noise)

    def _tolerance(self, noise: Noise) -> Float64:
        return 2 * noise.tolerance_m * np.maximum(1, self.length / noise.range_m)

    def coincides(self, noise: Noise) -> Bool:
        """Which of the measured ranges agree, with a mirror.

        How the two paths add up depends on the camera: the law under which most ranges agree.
        """
        shorter = 0.5 * (self.length - self.direct)
        off = self.measured - self.length
        tolerance = self._tolerance(noise)

        def agree(rows: Int64, period_m: float) -> Bool:
            share, d = self.direct_share[rows], shorter[rows]
            less, most = (
                _shortened(np.clip(share + change, 0, 1), d, period_m)
                for change in (-_DIVISION, _DIVISION)
            )
            near = wrapped(off[rows] + (less + most) / 2, self.ambiguity_m[rows])
            return np.abs(near) < tolerance[rows] + np.abs(most - less) / 2

        lit = np.flatnonzero((self.direct_share > 0) & (self.direct_share < 1))
        out = np.abs(wrapped(off + self.direct_share * shorter, self.ambiguity_m)) < tolerance
        if len(lit):
            some = evenly_spaced(lit, _LIT)
            out[lit] = agree(lit, max(_PERIODS_M, key=lambda p: int(agree(some, p).sum())))
        return out


def _shortened(share: Float64, shorter: Float64, period_m: float) -> Float64:
    """How much two paths reduce a range (N,), if one of them has a share of the light (N,).

    Phases of a period add up as phasors, unwrapped by a much longer period. An infinite period:
    in proportion to the shares; 0: of pulses, the stronger one counts.
    """
    if period_m == 0:
        return np.where(share > 0.5, shorter, 0.0)
    if np.isinf(period_m):
        return share * shorter
    phasor = 1 - share + share * np.exp(2j * np.pi / period_m * shorter)
    fine = period_m / (2 * np.pi) * np.angle(phasor)
    return np.asarray(fine + period_m * np.round((share * shorter - fine) / period_m))


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
    in_front = opening.plane.height(points) > 2 * noise.tolerance_m
    points, normals = points[in_front], normals[in_front]
    phantom = mirror.reflected(points)
    points_of_none, none = np.zeros((0, 3)), np.zeros(0)
    parts = [
        Prediction(
            points_of_none, none, none, none, none, none, np.zeros(0, np.int64), np.zeros(0, bool)
        )
    ]
    first = 0
    for view in views:
        if opening.seen_by(view, 2 * noise.tolerance_m):
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
    # What stands in front of the mirror hides what it shows.
    rows, pixels = view.visible(np.concatenate([phantom, points]))
    rows, pixels = rows[rows < len(phantom)], pixels[rows < len(phantom)]
    rays = phantom[rows] - origin
    length = np.linalg.norm(rays, axis=1)
    rays /= length[:, None]
    reached = plane.crossings(origin, rays)
    measured = view.at(view.ranges, pixels)
    # Glass and wall scatter light, too: a range of the plane itself tells nothing.
    used = (measured > 0) & (np.abs(measured - reached) > 2 * noise.tolerance_m)
    used &= np.isfinite(reached)
    weak = np.zeros(len(used), bool)
    if view.amplitude is not None:
        weak = view.at(view.amplitude, pixels) < noise.weakest
    used[used] = opening.contains(origin + reached[used, None] * rays[used])
    rows, rays, length, measured = rows[used], rays[used], length[used], measured[used]
    weak = weak[used]
    number = np.ravel_multi_index(tuple(pixels[used].T), view.ranges.shape)
    p, n = points[rows], normals[rows]
    in_camera, at, inside = view.project(p)
    distance = np.linalg.norm(in_camera, axis=1)
    angle = np.arccos(np.clip(in_camera[:, 2] / np.maximum(distance, 1e-9), -1, 1))
    seen = view.at(view.ranges, at)
    lit = inside & ((seen <= 0) | (seen > distance - 2 * noise.tolerance_m))
    reflected = rays - 2 * (rays @ mirror.normal)[:, None] * mirror.normal
    facing = -(n * reflected).sum(1)
    # Outside of the image, whether it is lit is not known; nor the front of what shows its back.
    known = (inside | (angle > _LAMP * view.corner_rad)) & (facing > 0)
    by_mirror = _REFLECTANCE * np.maximum(facing, 0) / length**2
    toward = (p - origin) / np.maximum(distance, 1e-9)[:, None]
    direct = lit * np.maximum(-(n * toward).sum(1), 0) / np.maximum(distance, 1e-9) ** 2
    share = direct / np.maximum(direct + by_mirror, 1e-12)
    return Prediction(
        p[known],
        length[known],
        distance[known],
        share[known],
        measured[known],
        np.full(int(known.sum()), view.ambiguity_m),
        number[known],
        weak[known],
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
    agrees = seen.coincides(noise)
    found = patches(seen)
    share = float(agrees.mean()) if len(seen) else 0.0
    # A room that is the reflection of the one in front, as in an aisle of shelves, has no second
    # path. It may fit a little better by chance: by a patch.
    more = float(seen.is_room(noise).sum()) - float(agrees.sum())
    if not compare or found < _MIN_PATCHES or found * more > len(seen):
        return Evidence(share, 0.0, found)
    by_chance, compared = np.full(len(seen), _CHANCE), np.ones(len(seen))
    for plane in wrong_planes(opening, noise):
        other = predict(opening, plane, views, points, normals, noise)
        numbers, first = np.unique(other.pixels, return_index=True)
        if not len(numbers):
            continue
        at = np.searchsorted(numbers, seen.pixels).clip(max=len(numbers) - 1)
        both = numbers[at] == seen.pixels
        by_chance += both * other.coincides(noise)[first][at]
        compared += both
    chance = by_chance / compared
    explained = _EXPLAINED[:, None]
    ratios = np.log(np.where(agrees, (chance + explained * (1 - chance)) / chance, 1 - explained))
    # Of weak pixels, the mirror may explain less.
    total = sum(ratios[:, k].sum(1).max() for k in (seen.weak, ~seen.weak))
    return Evidence(share, found * float(total) / len(seen), found)


def wrong_planes(opening: Opening, noise: Noise) -> list[Plane]:
    """Return planes that would be mirrors by chance only: shifted and tilted ones."""
    plane, centre = opening.plane, opening.corners.mean(0)
    shift = max(_SHIFT_M, _SHIFT_TOLERANCES * noise.tolerance_m)
    shifted = [Plane(plane.normal, plane.offset + k * shift) for k in (-2, -1, 1, 2)]
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
