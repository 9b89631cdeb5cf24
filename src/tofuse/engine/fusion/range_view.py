"""Compact range images, as stored until they are fused at their final poses.

The stored views of a recording: in memory up to a limit, the others on disk.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Int8, UInt8, UInt16
from tofuse.engine.cameras import RayTable, lens, ray_lengths
from tofuse.engine.compute import Spill, median
from tofuse.engine.frames import SATURATED_AMPLITUDE, CloudFrame, RangeFrame
from tofuse.engine.fusion.tsdf_kernels import StoredView, mark_jumps, pack_view, shrink_to_planes
from tofuse.engine.refinement import fixed_pattern
from tofuse.engine.views import (
    PreparedView,
    Projection,
    SurfaceOptions,
    dilated,
    prepare_view,
    with_extended_planes,
)

# Weights, in 1/m^2, are stored as logarithms: six steps per octave, from 2^-14 on.
_STEPS_PER_OCTAVE, _MIN_LOG2 = 6.0, -14.0
DECODED = np.r_[0.0, 2.0 ** (np.arange(255) / _STEPS_PER_OCTAVE + _MIN_LOG2)].astype(np.float32)
_SIGMAS = 1 / np.sqrt(np.maximum(DECODED, DECODED[1]))
# Weight factor of pixels near a jump: they matter only where nothing else was measured.
_JUMP_WEIGHT = 0.1
_QUANTILES = (np.arange(17) + 0.5) / 17  # of depths in a summary
# Relief of smaller extent, as a fraction of the depth, is lost in the noise.
_MIN_DETAIL = 0.004
# Options of planes in addition to those of the tracker: minimum fill of windows, maximum offset.
_MIN_PLANE_FILL, _MAX_PLANE_OFFSET = 0.4, 1.0


@dataclass(frozen=True, eq=False)
class RangeView:
    """A range image for fusion, of at most 320 columns and 8 to 10 bytes per pixel.

    Attributes
    ----------
    index, timestamp
        Of the frame.
    projection
        Rays of the pixels, and projection of points.
    z
        (H, W) uint16, z in counts of `unit` m, 0 where invalid.
    normals
        (H, W, 3) int8, 127 times the unit normals away from the camera.
    strength
        (H, W) uint8 code of the weight, see `DECODED`; 0 for pixels that are not integrated.
    intensity
        (H, W) float16, root of the albedo in the recording's counts times m^2; or (H, W, 3) uint8
        RGB; None if neither is known.
    sigma_m
        Typical standard deviation of z.
    measures_range
        Whether its camera measures radial range, not z.
    """

    index: int
    timestamp: float
    projection: Projection
    z: UInt16
    unit: float
    normals: Int8
    strength: UInt8
    intensity: NDArray[np.float16] | UInt8 | None
    sigma_m: float
    measures_range: bool = False

    @classmethod
    def of(
        cls,
        frame: RangeFrame,
        surface: PreparedView | None = None,
        options: SurfaceOptions | None = None,
    ) -> RangeView:
        """Reduce the valid pixels of a frame.

        A pixel's weight is one over the variance of the distance from its plane: that of its depth
        times the squared cosine of the incidence. It is 0 next to depth jumps, where pixels mix
        both sides, unless the pixel is on the plane of its neighbours. Its depth is smoothed
        towards its plane, the more the noisier it is.

        Parameters
        ----------
        frame
            The filtered frame.
        surface
            The same image as prepared for tracking, before filters of the model, if it was.
        options
            How it is prepared if not.
        """
        options = options or SurfaceOptions()
        if surface is None:
            surface = prepare_view(frame, options)
        surface = with_extended_planes(
            surface, frame, replace(options, fill=_MIN_PLANE_FILL, offset=_MAX_PLANE_OFFSET)
        )
        options = options.for_image(surface.projection.pitch)
        shape = surface.z.shape
        smoothed, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
        measured, jump = np.empty(shape, bool), np.zeros(shape, np.uint8)
        shrink_to_planes(
            surface.z, surface.sigma, surface.planes, surface.plane_variance,
            smoothed, variance, measured,
        )  # fmt: skip
        mark_jumps(surface.z, surface.sigma, options.edge_jump, jump)
        density = _area_mean(frame.valid.astype(np.float32), shape)
        # Half of the pixels of a block; of a sparse image, half of what a block usually has.
        valid = density >= 0.5 * (median(density[density > 0]) if density.any() else 1.0)
        valid |= measured & dilated(valid.view(np.uint8), 1) & (jump == 0)
        z = np.where(valid, smoothed, np.float32(0))
        usable = (z > 0) & (surface.sigma > 0) & ((jump == 0) | (surface.planes[..., 3] > 0))
        normals = np.empty((*shape, 3), np.int8)
        weight = np.empty(shape, np.float32)
        lengths2 = surface.projection.lengths2
        pack_view(surface.planes, surface.rays, lengths2, variance, usable, normals, weight)
        weight[dilated(jump, options.edge_margin)] *= _JUMP_WEIGHT
        usable = weight > 0
        max_z = float(z.max(initial=0.0))
        unit = max(max_z, 1e-3) / 65535
        return cls(
            frame.index,
            frame.timestamp,
            surface.projection,
            np.round(z / unit).astype(np.uint16),
            unit,
            normals,
            _weight_codes(weight),
            _intensity(frame, shape),
            _typical_sigma(variance, usable),
            frame.depth_kind == "range",
        )

    @property
    def stored(self) -> StoredView:
        """The view in the format of the kernels."""
        return StoredView(self.z, self.unit, self.normals, self.strength, self.projection.rays)

    @property
    def nbytes(self) -> int:
        """Size of the view's own images."""
        intensity = 0 if self.intensity is None else self.intensity.nbytes
        return self.z.nbytes + self.normals.nbytes + self.strength.nbytes + intensity

    @property
    def depths(self) -> Float64:
        """Evenly spaced quantiles of z in m, the median in the middle; none without valid pixels.

        They are those of every fourth pixel if any of these is valid.
        """
        for step in (2, 1):
            sampled = self.z[::step, ::step]
            valid = np.sort(sampled[sampled > 0], kind="stable")  # by radix
            if len(valid):
                return np.asarray(self.unit * valid[(_QUANTILES * len(valid)).astype(int)])
        return np.zeros(0)

    @property
    def detail(self) -> float:
        """Extent of the smallest visible detail relative to its z.

        It is the typical difference of x/z between neighbouring pixels, unless that is finer than
        the noise, which grows with depth.
        """
        return max(self.projection.pitch, _MIN_DETAIL)

    @property
    def resolution(self) -> Float32:
        """(H, W) what a pixel resolves, m: its distance to the next one, or its sigma if larger."""
        return np.maximum(np.float32(self.detail * self.unit) * self.z, _SIGMAS[self.strength])

    @property
    def channels(self) -> int:
        """3 for colour, 1 for albedo, else 0."""
        if self.intensity is None:
            return 0
        return 3 if self.intensity.ndim == 3 else 1

    def as_cloud(self, pixels: int | None = None) -> CloudFrame:
        """Return the valid pixels as a cloud, with amplitude that is not range-compensated.

        Of an image with more than `pixels` pixels every n-th of every n-th row is taken.
        """
        valid = (self.z > 0) & np.isfinite(self.projection.rays).all(-1)
        if pixels is not None:
            step = max(1, round(np.sqrt(self.z.size / pixels)))
            sampled = np.zeros_like(valid)
            sampled[step // 2 :: step, step // 2 :: step] = True
            valid &= sampled
        z = self.z[valid].astype(np.float32) * np.float32(self.unit)
        points = np.concatenate([self.projection.rays[valid] * z[:, None], z[:, None]], 1)
        color = amplitude = None
        if self.channels == 3:
            assert self.intensity is not None
            color = self.intensity[valid].astype(np.uint8)
        elif self.intensity is not None:
            squared_range = np.einsum("ni,ni->n", points, points)
            amplitude = self.intensity[valid].astype(np.float32) ** 2 / np.maximum(
                squared_range, 1e-6
            )
        return CloudFrame(self.index, self.timestamp, points, color=color, amplitude=amplitude)


def _typical_sigma(variance: Float32, usable: Bool) -> float:
    """Return the median sigma of every fourth pixel, or of all if none of these is usable."""
    for step in (2, 1):
        sampled = variance[::step, ::step][usable[::step, ::step]]
        if len(sampled):
            return float(np.sqrt(median(sampled)))
    return 0.0


class CameraCorrection:
    """Removes errors of the camera from its views.

    Parameters
    ----------
    errors, pattern
        As of `Refinement`.
    """

    def __init__(
        self, errors: Mapping[str, float], pattern: fixed_pattern.FixedPattern = fixed_pattern.NONE
    ) -> None:
        self._errors, self._pattern = errors, pattern
        # Shared by views, as what they are of.
        self._projections: dict[int, tuple[Projection, Projection]] = {}
        self._patterns: dict[tuple[int, ...], Float32] = {}

    def __bool__(self) -> bool:
        """Whether there are any."""
        return self._pattern.z is not None or any(self._errors.values())

    def __call__(self, view: RangeView) -> RangeView:
        """Return a view without these errors."""
        errors, projection = self._errors, view.projection
        z = view.z * np.float32(view.unit)
        if self._pattern.z is not None:
            shape = z.shape
            if shape not in self._patterns:
                resized = cv2.resize(self._pattern.z, shape[::-1])
                self._patterns[shape] = np.asarray(resized, np.float32)
            lengths = np.sqrt(projection.lengths2)
            z += np.where(z > 0, self._pattern.at(z, self._patterns[shape], lengths), 0)
        z = z * np.float32(1 + errors.get("scale", 0.0)) + np.where(
            z > 0, np.float32(errors.get("offset", 0.0)) / np.sqrt(projection.lengths2), 0
        )
        corrected = self._corrected(projection)
        if view.measures_range:  # along another ray
            z *= np.sqrt(projection.lengths2 / corrected.lengths2)
        z = np.maximum(np.nan_to_num(z), 0)
        unit = max(float(z.max(initial=0.0)), 1e-3) / 65535
        counts = np.round(z / unit).astype(np.uint16)
        return replace(view, z=counts, unit=unit, projection=corrected)

    def _corrected(self, projection: Projection) -> Projection:
        focal = self._errors.get("focal", 0.0)
        if not focal:
            return projection
        if id(projection) not in self._projections:
            camera = RayTable(lens.moved_rays(projection.rays, focal, (0.0, 0.0)))
            self._projections[id(projection)] = projection, Projection.of(camera, 1)
        return self._projections[id(projection)][1]


def _weight_codes(weight: Float32) -> UInt8:
    positive = weight > 0
    code = 1 + np.round(_STEPS_PER_OCTAVE * (np.log2(np.where(positive, weight, 1)) - _MIN_LOG2))
    return np.where(positive, np.clip(code, 1, 255), 0).astype(np.uint8)


def albedo(frame: RangeFrame) -> Float32 | None:
    """Return the albedo (H, W) of a frame in counts times m^2, -1 where unknown.

    None if it has no amplitude.
    """
    if frame.amplitude_image is None:
        return None
    z, amplitude = np.asarray(frame.z, np.float32), frame.amplitude_image
    unknown = ~(amplitude > 0) | (amplitude >= SATURATED_AMPLITUDE) | (z <= 0)
    if frame.amplitude_kind != "range_compensated":
        amplitude = amplitude * np.square(z * ray_lengths(frame.camera))
    return np.where(unknown, -1, np.nan_to_num(amplitude)).astype(np.float32)


def _intensity(frame: RangeFrame, shape: tuple[int, ...]) -> NDArray[np.float16] | UInt8 | None:
    """Return the means of the known colours, or albedos, of blocks of pixels; 0 where unknown."""
    if frame.color_image is not None:
        known = np.asarray((frame.color_image > 0).any(-1), np.bool_)
        return np.round(_known_mean(frame.color_image, known, shape)).astype(np.uint8)
    light = albedo(frame)
    if light is None:
        return None
    known = np.asarray(light >= 0, np.bool_)
    intensity = np.sqrt(_known_mean(np.where(known, light, 0), known, shape))
    return np.minimum(intensity, 65000).astype(np.float16)


def _known_mean(image: NDArray[np.generic], known: Bool, shape: tuple[int, ...]) -> Float32:
    """Return means of the known pixels of blocks; the others of `image` are 0."""
    mean = _area_mean(image.astype(np.float32), shape)
    if known.all():
        return mean
    share = _area_mean(known.astype(np.float32), shape)
    return np.asarray((mean.T / np.maximum(share, 1e-6).T).T, np.float32)


def _area_mean(image: Float32, shape: tuple[int, ...]) -> Float32:
    """Return means over blocks of pixels, an image of shape (H, W)."""
    step = image.shape[1] // shape[1]
    if step == 1:
        return image
    cropped = np.ascontiguousarray(image[: step * shape[0], : step * shape[1]])
    means = cv2.resize(cropped, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(means, np.float32)


@dataclass(frozen=True, eq=False)
class ViewSummary:
    """Properties of a view that are needed without its images.

    Attributes
    ----------
    index, depths, detail, sigma_m, channels
        See `RangeView`.
    """

    index: int
    depths: Float64
    detail: float
    sigma_m: float
    channels: int

    @classmethod
    def of(cls, view: RangeView) -> ViewSummary:
        """Return the summary of a view."""
        return cls(view.index, view.depths, view.detail, view.sigma_m, view.channels)


class Views(Protocol):
    """A sequence of views: a list, or those of a store."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> RangeView: ...

    def __iter__(self) -> Iterator[RangeView]: ...


class StoredViews:
    """Views in a store, read on demand.

    Attributes
    ----------
    summaries
        Of all views, without reading them.
    """

    def __init__(self, spill: Spill[RangeView], correction: CameraCorrection | None = None) -> None:
        self.summaries: list[ViewSummary] = []
        self._spill, self._correction = spill, correction
        self._numbers: list[int] = []

    def add(self, view: RangeView) -> None:
        """Store a view.

        Raises
        ------
        OutputError
            If there is no space on the disk.
        """
        self._numbers.append(self._spill.put(view))
        self.summaries.append(ViewSummary.of(view))

    def of(self, indices: Container[int]) -> StoredViews:
        """Select the views of these frame indices, in the same store."""
        selected = StoredViews(self._spill)
        for number, summary in zip(self._numbers, self.summaries, strict=True):
            if summary.index in indices:
                selected._numbers.append(number)
                selected.summaries.append(summary)
        return selected

    def corrected(self, correction: CameraCorrection) -> StoredViews:
        """Return these views, without some errors whenever they are read."""
        corrected = StoredViews(self._spill, correction)
        corrected.summaries, corrected._numbers = self.summaries, self._numbers
        return corrected

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int, /) -> RangeView:
        view = self._spill.get(self._numbers[index])
        return view if self._correction is None else self._correction(view)

    def __iter__(self) -> Iterator[RangeView]:
        return (self[k] for k in range(len(self)))


def summaries(views: Views) -> Sequence[ViewSummary]:
    """Return the summaries of all views, without reading those that are on disk."""
    if isinstance(views, StoredViews):
        return views.summaries
    return [ViewSummary.of(view) for view in views]
