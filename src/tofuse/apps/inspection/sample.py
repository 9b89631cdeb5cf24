"""The frames that are checked: evenly spaced ones, the successor of each, and their alignment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import accumulate, pairwise, product

import numpy as np

from tofuse.apps.inspection.planar import Distortion, Region, fit_distortion, regions_of
from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import run_all
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames import Frame, RangeFrame, Recording, evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

# Faults affect the full image; a higher resolution would only take longer.
_VIEW = SurfaceOptions(columns=128)
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
        read: dict[int, Frame] = {}
        unreadable: list[UnreadableFrameError] = []
        for k in selected.tolist():
            try:
                read[k] = recording[k]
            except UnreadableFrameError as error:
                unreadable.append(error)
        breaks = set(part_starts(recording))
        steps = [
            (position, position + 1)
            for position, (k, following) in enumerate(pairwise(read))
            if following == k + 1 and following not in breaks
        ]
        return cls(recording, tuple(read.values()), tuple(steps), tuple(unreadable), turning)

    @cached_property
    def images(self) -> tuple[RangeFrame, ...]:
        """The range images with valid pixels."""
        return tuple(f for f in self.frames if isinstance(f, RangeFrame) and f.valid.any())

    @property
    def consecutive_images(self) -> tuple[tuple[RangeFrame, RangeFrame], ...]:
        """The pairs of consecutive frames that are images."""
        pairs = [(self.frames[i], self.frames[j]) for i, j in self.steps]
        return tuple(
            (a, b) for a, b in pairs if isinstance(a, RangeFrame) and isinstance(b, RangeFrame)
        )

    @cached_property
    def views(self) -> dict[int, PreparedView]:
        """Prepared views of the range images, by position in `frames`."""
        images = {
            k: f for k, f in enumerate(self.frames) if isinstance(f, RangeFrame) and f.valid.any()
        }
        prepared = run_all([partial(prepare, image) for image in images.values()])
        return dict(zip(images, prepared, strict=True))

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The aligned pairs of consecutive frames."""
        views = self.views
        steps = [(i, j) for i, j in self.steps if i in views and j in views]
        return tuple(run_all([partial(Pair.of, views[i], views[j]) for i, j in steps]))

    @cached_property
    def distant_pairs(self) -> tuple[Pair, ...]:
        """The first view aligned with each other one."""
        first, *others = self.views.values()
        return tuple(run_all([partial(Pair.of, first, other) for other in others]))

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
        if len(periods) == 1 and (period := periods.pop()) is not None:
            return period
        stated = self.recording.metadata.get("ambiguity_m")
        return float(stated) if isinstance(stated, int | float) and stated > 0 else None


def prepare(image: RangeFrame) -> PreparedView:
    """Return the view of an image with valid pixels, as it is compared."""
    return prepare_view(image, _VIEW)


def part_starts(recording: Recording) -> list[int]:
    """Return the positions in a recording at which further joined recordings begin."""
    parts = recording.metadata.get("parts", ())
    starts = list(accumulate(part["frames"] for part in parts))[:-1]
    return [int(start) for start in np.searchsorted(recording.indices, starts)]


@dataclass(frozen=True, eq=False)
class Pair:
    """Two aligned views.

    Attributes
    ----------
    first, second
        The view that is aligned to, and the other one.
    alignment
        The best alignment.
    """

    first: PreparedView
    second: PreparedView
    alignment: projective.Aligned

    @classmethod
    def of(cls, first: PreparedView, second: PreparedView) -> Pair:
        """Align two views, from the identity, and if that fails from rotations."""
        best = _aligned(second, first, np.eye(4))
        fov = field_of_view(first)
        for fraction in _START_ROTATIONS:
            if best.score >= _SUFFICIENT_SCORE:
                break
            for axis, sign in product((1, 0), (1, -1)):
                xi = np.zeros(6)
                xi[3 + axis] = sign * fraction * fov
                candidate = _aligned(second, first, se3.exp(xi))
                best = max(best, candidate, key=lambda a: a.score)
        return cls(first, second, best)

    @cached_property
    def angle(self) -> float:
        """Rotation angle of the camera, rad."""
        return float(se3.angle(self.alignment.T_world_source))

    @cached_property
    def distance(self) -> float:
        """Distance of the cameras, m."""
        return float(np.linalg.norm(self.alignment.T_world_source[:3, 3]))

    @cached_property
    def shift(self) -> float:
        """Median motion of the image, as a fraction of its smaller side.

        Around an object the camera moves and turns far, and the image hardly moves.
        """
        rays, z = self.second.rays, self.second.z
        points = np.dstack([rays * z[..., None], z])[z > 0]
        moved = se3.transform(self.alignment.T_world_source, points)
        in_front = moved[:, 2] > 0
        motion = moved[in_front, :2] / moved[in_front, 2:] - rays[z > 0][in_front]
        size = np.nanmin(np.nanmax(rays, axis=(0, 1)) - np.nanmin(rays, axis=(0, 1)))
        return float(np.nanmedian(np.linalg.norm(motion, axis=1)) / size)

    @property
    def fits(self) -> bool:
        """Whether the two views are consistent where they overlap."""
        return self.alignment.score > 0.5 and self.alignment.inlier_ratio > 0.7


def field_of_view(view: PreparedView) -> float:
    """Return the smaller angle of the field of view, rad."""
    rays = view.rays
    x = np.arctan(rays[rays.shape[0] // 2, :, 0])
    y = np.arctan(rays[:, rays.shape[1] // 2, 1])
    return float(min(np.nanmax(x) - np.nanmin(x), np.nanmax(y) - np.nanmin(y)))


def _aligned(
    source: PreparedView, target: PreparedView, T_target_source: Float64
) -> projective.Aligned:
    """Align two small views from an initial pose; without photometric terms if that fails."""
    targets = [projective.Target(target)]
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
