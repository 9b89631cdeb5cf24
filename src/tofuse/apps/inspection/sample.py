"""The frames that are checked: evenly spaced ones, the successor of each, and their alignment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from scipy import ndimage

from tofuse.apps.inspection.planar import Distortion, Region, fit_distortion, regions_of
from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames import Frame, RangeFrame, Recording, evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.search import pair_agreement
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

# Faults affect the full image; a higher resolution would only take longer.
VIEW_COLUMNS = 128
# Views are small, so nearly all pixels are used at all levels.
_OPTIONS = projective.ProjectiveOptions(
    levels=(
        projective.Level(2, 8, 0.03, 0.1),
        projective.Level(2, 3, 0.005, 0.02),
        projective.Level(1, 2, 0.0, 0.0),
    )
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
class Sample:
    """A sample of frames of a recording, with lazily computed views, pairs and regions.

    Attributes
    ----------
    recording
        The full recording, for its timestamps.
    frames
        The readable frames of the sample, in order.
    steps
        (i, j) positions in `frames` of consecutive frames of the recording.
    unreadable
        Errors of the unreadable frames.
    turning
        Whether, according to the user, an object turns in front of a stationary camera.
    """

    recording: Recording
    frames: tuple[Frame, ...]
    steps: tuple[tuple[int, int], ...]
    unreadable: tuple[UnreadableFrameError, ...] = ()
    turning: bool = False

    @classmethod
    def of(cls, recording: Recording, count: int, *, turning: bool = False) -> Sample:
        """Read up to `count` pairs of neighbours, evenly spaced, including the first and the last.

        Parameters
        ----------
        recording
            The recording to sample.
        count
            Number of pairs.
        turning
            Whether an object turns in front of a stationary camera.
        """
        n = len(recording)
        first_of_pair = evenly_spaced(np.arange(max(n - 1, 1)), count)
        selected = np.unique(np.concatenate([first_of_pair, np.minimum(first_of_pair + 1, n - 1)]))
        frames: list[Frame] = []
        unreadable: list[UnreadableFrameError] = []
        position_of: dict[int, int] = {}
        for k in selected.tolist():
            try:
                frames.append(recording[k])
            except UnreadableFrameError as error:
                unreadable.append(error)
                continue
            position_of[k] = len(frames) - 1
        breaks = set(part_starts(recording))
        steps = [
            (position_of[k], position_of[k + 1])
            for k in sorted(position_of)
            if k + 1 in position_of and k + 1 not in breaks
        ]
        return cls(recording, tuple(frames), tuple(steps), tuple(unreadable), turning)

    @cached_property
    def images(self) -> tuple[RangeFrame, ...]:
        """The range images with valid pixels."""
        return tuple(f for f in self.frames if isinstance(f, RangeFrame) and f.valid.any())

    @cached_property
    def views(self) -> dict[int, PreparedView]:
        """Prepared views of the range images, by position in `frames`."""
        options = SurfaceOptions(columns=VIEW_COLUMNS)
        return {
            k: prepare_view(f, options)
            for k, f in enumerate(self.frames)
            if isinstance(f, RangeFrame) and f.valid.any()
        }

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The aligned pairs of consecutive frames."""
        return tuple(
            aligned_pair(self.views[i], self.views[j], i, j)
            for i, j in self.steps
            if i in self.views and j in self.views
        )

    @cached_property
    def distant_pairs(self) -> tuple[Pair, ...]:
        """The first view aligned with each other one."""
        first, *others = self.views
        return tuple(aligned_pair(self.views[first], self.views[k], first, k) for k in others)

    @cached_property
    def regions(self) -> tuple[Region, ...]:
        """The smooth regions of all views."""
        return tuple(
            region for k, view in self.views.items() for region in regions_of(view, frame=k)
        )

    @cached_property
    def radius(self) -> float:
        """Largest distance of the rays (x/z, y/z) of the first image from the axis."""
        rays = self.images[0].camera.rays()
        return float(np.sqrt(np.nanmax((rays * rays).sum(-1))))

    @cached_property
    def distortion(self) -> Distortion | None:
        """The distortion of planes, in the model for a wrong depth kind."""
        return fit_distortion(self.regions, self.radius, "kind")

    @cached_property
    def period_m(self) -> float | None:
        """Range in m after which the phase repeats; None if not known."""
        periods = {f.ambiguity_m for f in self.images}
        period = periods.pop() if len(periods) == 1 else None
        if period is None:
            stated = self.recording.metadata.get("ambiguity_m")
            period = float(stated) if isinstance(stated, int | float) and stated > 0 else None
        return period


def part_starts(recording: Recording) -> list[int]:
    """Return the positions in a recording at which further joined recordings begin."""
    parts = recording.metadata.get("parts", ())
    starts = list(accumulate(part["frames"] for part in parts))[:-1]
    indices: Intp = recording.indices
    return [int(np.searchsorted(indices, s)) for s in starts]


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
    alignment: projective.Aligned

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


def aligned(
    source: PreparedView, target: PreparedView, T_target_source: Float64
) -> projective.Aligned:
    """Align two small views from an initial pose; without photometric terms if that fails."""
    targets = [projective.Target(target, np.eye(4))]
    for options in (_OPTIONS, replace(_OPTIONS, photometric=False)):
        try:
            return projective.align(source, targets, T_target_source, options)
        except np.linalg.LinAlgError:
            continue
    # The views do not overlap.
    zeros = np.zeros((6, 6))
    return projective.Aligned(
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
    pixels = pair_agreement.landing_pixels(target, points)
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
