"""How the camera moved from one frame to the next, and what else moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from tofuse.arrays import Bool, Float64
from tofuse.geometry import se3
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Aligned, Level, ProjectiveOptions, Target, align
from tofuse.registration.view_points import landing_pixels

# Views are small, so nearly all pixels take part from the start.
_OPTIONS = ProjectiveOptions(
    levels=(Level(2, 8, 0.03, 0.1), Level(2, 3, 0.005, 0.02), Level(1, 2, 0.0, 0.0))
)
# An alignment that reaches this score from where it started needs no other start.
_GOOD_SCORE = 0.7
# Starts, in shares of the field of view, to the sides and up and down.
_STARTS = (0.2, 0.4, 0.6)
# Points in front of what the other view saw by so many sigmas and this share of z have moved.
_MOVED_SIGMAS, _MOVED_SHARE = 4.0, 0.05
_FEWEST_COMPARED = 200
# Edges that smoothing widens, or that a pose misses by a little, are narrower than this, pixels.
_WIDEST_EDGE = 5


@dataclass(frozen=True, eq=False)
class Pair:
    """Two neighbours.

    Attributes
    ----------
    i, j
        Their positions in the sample.
    first, second
        Their surfaces.
    found
        The best alignment, of the second to the first.
    """

    i: int
    j: int
    first: PreparedView
    second: PreparedView
    found: Aligned

    @property
    def T(self) -> Float64:
        """(4, 4) T_first_second."""
        return self.found.T_world_source

    @cached_property
    def angle(self) -> float:
        """Turn of the camera in rad."""
        return float(se3.angle(self.T))

    @cached_property
    def shift(self) -> float:
        """How far the image moved, as a share of the field of view: by turn and by way."""
        wide = field_of_view(self.first)
        way = float(np.linalg.norm(self.T[:3, 3])) / self.first.depth
        return (self.angle + way) / wide

    @property
    def fits(self) -> bool:
        """Whether the two views agree where they overlap."""
        return self.found.score > 0.5 and self.found.inlier_share > 0.7

    @cached_property
    def moved_share(self) -> float:
        """Share of what both see that stands where the other saw through."""
        return max(
            _in_front(self.second, self.first, self.T),
            _in_front(self.first, self.second, se3.inverse(self.T)),
        )


def field_of_view(view: PreparedView) -> float:
    """Smaller angle of the field of view, rad."""
    rays = view.rays
    x = np.arctan(rays[rays.shape[0] // 2, :, 0])
    y = np.arctan(rays[:, rays.shape[1] // 2, 1])
    return float(min(np.nanmax(x) - np.nanmin(x), np.nanmax(y) - np.nanmin(y)))


def aligned_pair(first: PreparedView, second: PreparedView, i: int, j: int) -> Pair:
    """Align two views, from no motion, and if that fails from turns to all sides."""
    best = aligned(second, first, np.eye(4))
    if best.score < _GOOD_SCORE:
        wide = field_of_view(first)
        for share in _STARTS:
            for axis in (1, 0):
                for sign in (1, -1):
                    xi = np.zeros(6)
                    xi[3 + axis] = sign * share * wide
                    other = aligned(second, first, se3.exp(xi))
                    best = max(best, other, key=lambda a: a.score)
            if best.score >= _GOOD_SCORE:
                break
    return Pair(i, j, first, second, best)


def aligned(source: PreparedView, target: PreparedView, T_target_source: Float64) -> Aligned:
    """Align two small views from a start; by their shape alone where light does not settle."""
    targets = [Target(target, np.eye(4))]
    for options in (_OPTIONS, replace(_OPTIONS, photometric=False)):
        try:
            return align(source, targets, T_target_source, options)
        except np.linalg.LinAlgError:
            continue
    # Nothing of the one is seen by the other.
    nothing = np.zeros((6, 6))
    return Aligned(
        T_world_source=T_target_source, converged=False, iterations=0, information=nothing,
        cross=nothing, unobservable=np.eye(6), points=0, landed=0, compared=0, inliers=0,
        in_front=0, rms_m=np.inf, scale=1.0, photo_scale=0.0, score=-1.0,
    )  # fmt: skip


def _in_front(source: PreparedView, target: PreparedView, T_target_source: Float64) -> float:
    """Share of the points of the source that stand where the target saw through.

    Single pixels and thin edges don't count: they fly, or the pose is off by a little.
    """
    rows, columns = target.z.shape
    on = source.z > 0
    points = np.concatenate([source.rays, np.ones_like(source.rays[..., :1])], -1)
    points = se3.transform(T_target_source, (points * source.z[..., None])[on].astype(float))
    pixels = landing_pixels(target, points)
    inside = (
        (points[:, 2] > 0.05)
        & (pixels >= 0).all(-1)
        & (pixels[:, 0] < columns)
        & (pixels[:, 1] < rows)
    )
    u, v = pixels[inside].T
    # The nearest around: an edge may be a pixel off. Where something is unknown, nothing is said.
    known = np.where(target.z > 0, target.z, 0).astype(np.float32)
    behind = ndimage.minimum_filter(known, 3, mode="nearest")[v, u]
    sigma = np.hypot(target.sigma[v, u], source.sigma[on][inside])
    gap = behind - points[inside, 2]
    front = gap > np.maximum(_MOVED_SIGMAS * sigma, _MOVED_SHARE * behind)
    compared = int(np.count_nonzero(behind > 0))
    if compared < _FEWEST_COMPARED:
        return 0.0
    image = np.zeros(source.z.shape, bool)
    where = np.flatnonzero(on.ravel())[inside]
    image.ravel()[where[front]] = True
    opened: Bool = ndimage.binary_opening(image, np.ones((_WIDEST_EDGE,) * 2, bool))
    return float(np.count_nonzero(opened)) / compared
