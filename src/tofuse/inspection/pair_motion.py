"""Camera motion between pairs of frames, and the part of the image with moving objects."""

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

# Views are small, so nearly all pixels are used at all levels.
_OPTIONS = ProjectiveOptions(
    levels=(Level(2, 8, 0.03, 0.1), Level(2, 3, 0.005, 0.02), Level(1, 2, 0.0, 0.0))
)
# An alignment with this score needs no other initial pose.
_SUFFICIENT_SCORE = 0.7
# Rotations of further initial poses, as fractions of the field of view, in all four directions.
_START_ROTATIONS = (0.2, 0.4, 0.6)
# Points in front of the other view's surface by this number of sigmas and fraction of z have moved.
_MOVED_SIGMAS, _MOVED_FRACTION = 4.0, 0.05
_MIN_COMPARED = 200
# Maximum width in pixels of false detections at edges, from smoothing and pose errors.
_MAX_EDGE = 5


@dataclass(frozen=True, eq=False)
class Pair:
    """Two aligned views.

    Attributes
    ----------
    i, j
        Positions of their frames in the sample.
    first, second
        The views.
    alignment
        The best alignment of the second to the first.
    """

    i: int
    j: int
    first: PreparedView
    second: PreparedView
    alignment: Aligned

    @property
    def T_first_second(self) -> Float64:
        """(4, 4) pose of the second camera in the frame of the first."""
        return self.alignment.T_world_source

    @cached_property
    def angle(self) -> float:
        """Rotation angle of the camera, rad."""
        return float(se3.angle(self.T_first_second))

    @cached_property
    def shift(self) -> float:
        """Image motion by rotation and translation, as a fraction of the field of view."""
        distance = float(np.linalg.norm(self.T_first_second[:3, 3])) / self.first.depth
        return (self.angle + distance) / field_of_view(self.first)

    @property
    def fits(self) -> bool:
        """Whether the two views are consistent where they overlap."""
        return self.alignment.score > 0.5 and self.alignment.inlier_ratio > 0.7

    @cached_property
    def moved_fraction(self) -> float:
        """Fraction of the overlap where one view has a surface in the free space of the other."""
        return max(
            _in_front(self.second, self.first, self.T_first_second),
            _in_front(self.first, self.second, se3.inverse(self.T_first_second)),
        )


def field_of_view(view: PreparedView) -> float:
    """Return the smaller angle of the field of view, rad."""
    rays = view.rays
    x = np.arctan(rays[rays.shape[0] // 2, :, 0])
    y = np.arctan(rays[:, rays.shape[1] // 2, 1])
    return float(min(np.nanmax(x) - np.nanmin(x), np.nanmax(y) - np.nanmin(y)))


def aligned_pair(first: PreparedView, second: PreparedView, i: int, j: int) -> Pair:
    """Align views of frames `i` and `j`, from the identity, and if that fails from rotations."""
    best = aligned(second, first, np.eye(4))
    if best.score < _SUFFICIENT_SCORE:
        fov = field_of_view(first)
        for fraction in _START_ROTATIONS:
            for axis in (1, 0):
                for sign in (1, -1):
                    xi = np.zeros(6)
                    xi[3 + axis] = sign * fraction * fov
                    candidate = aligned(second, first, se3.exp(xi))
                    best = max(best, candidate, key=lambda a: a.score)
            if best.score >= _SUFFICIENT_SCORE:
                break
    return Pair(i, j, first, second, best)


def aligned(source: PreparedView, target: PreparedView, T_target_source: Float64) -> Aligned:
    """Align two small views from an initial pose; without photometric terms if that fails."""
    targets = [Target(target, np.eye(4))]
    for options in (_OPTIONS, replace(_OPTIONS, photometric=False)):
        try:
            return align(source, targets, T_target_source, options)
        except np.linalg.LinAlgError:
            continue
    # The views do not overlap.
    zeros = np.zeros((6, 6))
    return Aligned(
        T_world_source=T_target_source, converged=False, iterations=0, information=zeros,
        cross=zeros, unobservable=np.eye(6), points=0, projected=0, compared=0, inliers=0,
        in_front=0, rms_m=np.inf, scale=1.0, photo_scale=0.0, score=-1.0,
    )  # fmt: skip


def _in_front(source: PreparedView, target: PreparedView, T_target_source: Float64) -> float:
    """Fraction of the source's points that are in the free space of the target.

    Single pixels and thin edges are ignored: they are flying pixels, or due to pose errors.
    """
    rows, columns = target.z.shape
    is_valid = source.z > 0
    points = np.concatenate([source.rays, np.ones_like(source.rays[..., :1])], -1)
    points = se3.transform(T_target_source, (points * source.z[..., None])[is_valid].astype(float))
    pixels = landing_pixels(target, points)
    inside = (
        (points[:, 2] > 0.05)
        & (pixels >= 0).all(-1)
        & (pixels[:, 0] < columns)
        & (pixels[:, 1] < rows)
    )
    u, v = pixels[inside].T
    # The nearest of 3 x 3 pixels, as edges may be displaced by one; 0 where any is invalid.
    z = np.where(target.z > 0, target.z, 0).astype(np.float32)
    surface_z = ndimage.minimum_filter(z, 3, mode="nearest")[v, u]
    sigma = np.hypot(target.sigma[v, u], source.sigma[is_valid][inside])
    clearance = surface_z - points[inside, 2]
    is_in_front = clearance > np.maximum(_MOVED_SIGMAS * sigma, _MOVED_FRACTION * surface_z)
    compared = int(np.count_nonzero(surface_z > 0))
    if compared < _MIN_COMPARED:
        return 0.0
    image = np.zeros(source.z.shape, bool)
    flat_index = np.flatnonzero(is_valid.ravel())[inside]
    image.ravel()[flat_index[is_in_front]] = True
    cleaned: Bool = ndimage.binary_opening(image, np.ones((_MAX_EDGE,) * 2, bool))
    return float(np.count_nonzero(cleaned)) / compared
