"""Some views of a recording at their final poses, and how well they agree with the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int64
from tofuse.engine.cameras import Camera
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames import RangeFrame, Recording, evenly_spaced
from tofuse.engine.geometry import se3, unit_rays
from tofuse.engine.results import Reconstruction
from tofuse.engine.sensor import CameraErrors

_VIEWS = 60
# Rays of a view that are tested, and views that tell which of their ranges are too short.
RAYS, _WITNESSES = 6000, 20
# A cell of the depth buffer, in pixels, and how far behind the nearest point of its cell another
# one may be, as a fraction of its range, to be visible as well.
_CELL, _VISIBLE = 3, 0.03
_NEAREST_M = 0.05
# Quantile of the residuals of surfaces that are seen directly, of which the tolerance is made, and
# of their amplitudes: weaker pixels are noise.
_TOLERANCE_QUANTILE, _WEAKEST_QUANTILE = 0.9, 0.02


@dataclass(frozen=True, eq=False)
class View:
    """A range image at its pose in the world.

    Attributes
    ----------
    ranges, amplitude
        (H, W) radial ranges, m, 0 where invalid, and amplitudes, if there are any.
    corner_rad
        Angle between the axis and the corner of the image.
    ambiguity_m
        Ranges are known up to multiples of it.
    too_short
        Which of every `step`-th pixel, by row and column, measure a range that is too short by such
        a multiple; see `with_too_short`.
    """

    camera: Camera
    T_world_camera: Float64
    ranges: Float64
    amplitude: Float32 | None
    corner_rad: float
    ambiguity_m: float
    too_short: Bool

    @property
    def step(self) -> int:
        """Step of the rows and columns of the pixels whose rays are tested."""
        return step_of(self.ranges.shape)

    @property
    def origin(self) -> Float64:
        """(3,) the camera's centre in the world."""
        return self.T_world_camera[:3, 3]

    def project(self, points: Float64) -> tuple[Float64, Int64, Bool]:
        """Return points (N, 3) in the camera's frame, their pixels (row, column), which are seen.

        "Seen" is: in the image. Pixels of others are 0.
        """
        p = se3.transform(se3.inverse(self.T_world_camera), points)
        pixels = np.nan_to_num(self.camera.project(p), nan=-1.0)[:, ::-1].round()
        inside = (p[:, 2] > _NEAREST_M) & ((pixels >= 0) & (pixels < self.ranges.shape)).all(1)
        return p, np.where(inside[:, None], pixels, 0).astype(np.int64), inside

    def visible(self, points: Float64) -> tuple[Int64, Int64]:
        """Return rows and pixels of those of the points (N, 3) that don't hide each other."""
        p, pixels, inside = self.project(points)
        rows = np.flatnonzero(inside)
        distance = np.linalg.norm(p[rows], axis=1)
        cells = pixels[rows] // _CELL
        key = cells[:, 0] * self.ranges.shape[1] + cells[:, 1]
        nearest = np.full(self.ranges.size + 1, np.inf)
        np.minimum.at(nearest, key, distance)
        front = distance < (1 + _VISIBLE) * nearest[key]
        return rows[front], pixels[rows[front]]

    def beyond(self, points: Float64) -> Float64:
        """How much farther than points (N, 3) the view measures, m; -inf where it does not."""
        in_camera, pixels, inside = self.project(points)
        measured = self.at(self.ranges, pixels)
        known = inside & (measured > 0)
        return np.where(known, measured - np.linalg.norm(in_camera, axis=1), -np.inf)

    def at(self, image: Float64 | Float32, pixels: Int64) -> Float64:
        """Values (N,) of an image (H, W) at pixels (N, 2)."""
        return np.asarray(image[pixels[:, 0], pixels[:, 1]], np.float64)


def wrapped(difference: Float64, ambiguity_m: Float64 | float) -> Float64:
    """Differences (N,) of ranges without multiples of the ambiguity range (or infinite)."""
    periods = np.where(np.isfinite(ambiguity_m), np.round(difference / ambiguity_m), 0.0)
    return difference - periods * np.where(np.isfinite(ambiguity_m), ambiguity_m, 0.0)


def step_of(shape: tuple[int, ...]) -> int:
    """Return the step of rows and columns that leaves about `RAYS` pixels of an image."""
    return max(1, int(np.sqrt(np.prod(shape) / RAYS)))


def views_of(recording: Recording, result: Reconstruction) -> list[View]:
    """Read evenly spaced frames that have a pose."""
    correctors = CameraErrors.made_with(result.config)
    views = []
    for k in evenly_spaced(np.flatnonzero(result.has_pose), _VIEWS).tolist():
        try:
            frame = recording[k]
        except UnreadableFrameError:
            continue
        for corrector in correctors:
            frame = corrector.apply(frame)
        if not isinstance(frame, RangeFrame) or not frame.valid.any():
            continue
        rays = frame.camera.rays()
        step = step_of(frame.valid.shape)
        views.append(
            View(
                frame.camera,
                result.trajectory[k],
                np.where(frame.valid, frame.radial_range, 0).astype(np.float64),
                frame.amplitude_image,
                float(np.arctan(np.nanmax(np.linalg.norm(rays, axis=-1)))),
                frame.ambiguity_m or np.inf,
                np.zeros(frame.valid[::step, ::step].shape, np.bool_),
            )
        )
    return views


def with_too_short(views: Sequence[View], margin: float) -> list[View]:
    """Find the ranges that are too short by a multiple of the ambiguity range.

    Most other views that look at their ends measure more than `margin` m farther.
    """
    witnesses = [views[k] for k in evenly_spaced(np.arange(len(views)), _WITNESSES)]
    return [
        replace(view, too_short=_too_short(view, witnesses, margin))
        if np.isfinite(view.ambiguity_m)
        else view
        for view in views
    ]


def _too_short(view: View, witnesses: Sequence[View], margin: float) -> Bool:
    ranges = view.ranges[:: view.step, :: view.step]
    valid = ranges > 0
    rays = view.camera.rays()[:: view.step, :: view.step]
    points = unit_rays(rays[valid]) * ranges[valid][:, None]
    points = se3.transform(view.T_world_camera, points)
    votes = np.zeros(len(points), np.int64)
    for other in witnesses:
        if other is view:
            continue
        beyond = other.beyond(points)
        votes += np.where(beyond > -margin, np.where(beyond > margin, 1, -1), 0)
    out = np.zeros(ranges.shape, np.bool_)
    out[valid] = votes > 0
    return out


@dataclass(frozen=True)
class Noise:
    """How exactly views measure what the model has in front of them.

    Attributes
    ----------
    tolerance_m
        Most of the ranges differ less.
    range_m
        Median range.
    weakest
        Lower amplitudes are not trusted.
    """

    tolerance_m: float
    range_m: float
    weakest: float

    @classmethod
    def of(cls, views: Sequence[View], points: Float64) -> Noise:
        """Measure it on points (N, 3) of the model."""
        residuals, ranges, amplitudes = [], [], []
        for view in views:
            rows, pixels = view.visible(points)
            measured = view.at(view.ranges, pixels)
            distance = np.linalg.norm(points[rows] - view.origin, axis=1)
            valid = measured > 0
            residuals.append(np.abs(wrapped(measured - distance, view.ambiguity_m))[valid])
            ranges.append(distance[valid])
            if view.amplitude is not None:
                amplitudes.append(view.at(view.amplitude, pixels)[valid])
        if not sum(map(len, residuals)):
            return cls(np.inf, 1.0, 0.0)
        return cls(
            float(np.quantile(np.concatenate(residuals), _TOLERANCE_QUANTILE)),
            float(np.median(np.concatenate(ranges))),
            float(np.quantile(np.concatenate(amplitudes), _WEAKEST_QUANTILE)) if amplitudes else 0,
        )
