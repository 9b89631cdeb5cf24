"""A view prepared for alignment: local planes, albedo, and the uncertainty of both."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np

from tofuse.engine.arrays import Float32
from tofuse.engine.compute import median, run_chunks
from tofuse.engine.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.views.projection import Projection, projection_of
from tofuse.engine.views.residual_kernels import TargetImage, ViewImages, make_target
from tofuse.engine.views.view_planes import (
    MISFIT,
    SurfaceOptions,
    edge_pixels,
    fitted_planes,
    inverse,
    noise_law,
    noise_scale,
    pixels_with_plane,
    row_chunks,
    scale_at,
    shared_sigma,
    stated_sigma,
    typical_noise,
    with_shared_error,
)
from tofuse.engine.views.view_planes_kernels import albedo_image, halve, smooth_and_slope

# Sparse images are not halved below this width and height.
_MIN_SIDE = 16
# Relative difference of depths up to which they belong to one surface when an image is halved.
_HALVING_JUMP = 0.02
# Range of usable colour levels: darker ones are noise, brighter ones saturated.
_MIN_LEVEL, _MAX_LEVEL = 8, 254
# m. Depths beyond are invalid, and their squares exceed the range of float32.
_MIN_DEPTH, _MAX_DEPTH = 1e-3, 1e3
# Lower limit of the noise relative to the depth, for views that are averaged or simulated without
# noise.
_MIN_NOISE = 3e-4
# The median noise of a view is that of every n-th pixel of every n-th row.
_NOISE_STEP = 4
# Half width of the box filter of the albedo, pixels.
_ALBEDO_RADIUS = 1

# Exponent of the range by which the amplitude of a time-of-flight camera falls off.
RAW_RANGE_FALLOFF = 2.0


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A view on a grid of at most `SurfaceOptions.columns` columns.

    Attributes
    ----------
    index
        Index of the frame.
    rays
        (H, W, 2) ray coordinates x/z, y/z.
    z
        (H, W) measured z in m, 0 where invalid.
    sigma
        (H, W) standard deviation of z in m, scaled to the noise observed in the view.
    planes
        (H, W, 4): a, b, c of the plane a X + b Y + c Z = 1 at the pixel, and 1/z on it; 0 where
        there is none.
    plane_variance
        (H, W) variance of 1/z on the plane, 1/m^2, for an alignment that treats pixels as
        independent: it contains correlated errors multiple times.
    albedo
        (H, W, 3) log albedo (from amplitude, else from colour), smoothed, and its slopes by x/z and
        y/z; NaN where unknown.
    projection
        Projection of points in this view's frame.
    has_albedo
        Whether `albedo` is known anywhere.
    pixel_variance
        (H, W) `plane_variance` with correlated errors counted once; None without such errors.
    unknown_falloff
        Whether `albedo` includes an unknown falloff of the amplitude towards the corners.
    measures_range
        Whether the camera measures radial range, from which z was computed.
    """

    index: int
    rays: Float32
    z: Float32
    sigma: Float32
    planes: Float32
    plane_variance: Float32
    albedo: Float32
    projection: Projection
    has_albedo: bool = False
    pixel_variance: Float32 | None = None
    unknown_falloff: bool = False
    measures_range: bool = False
    _subsampled: dict[int, PreparedView] = field(default_factory=dict, init=False, repr=False)

    @property
    def normals(self) -> Float32:
        """(H, W, 3) unit normals away from the camera, 0 where unknown; not cached."""
        abc = self.planes[..., :3]
        length = np.sqrt((abc * abc).sum(-1, keepdims=True))
        return np.where(self.planes[..., 3:] > 0, abc / np.maximum(length, 1e-12), 0).astype(
            np.float32
        )

    @property
    def pixels(self) -> int:
        """Number of pixels, valid or not."""
        return self.z.size

    def with_pixel_variance(self) -> PreparedView:
        """Return the view with `plane_variance` replaced by `pixel_variance`, if it has both.

        In a single alignment a correlated error is indistinguishable from motion, so such pixels
        get a low weight. Joint refinement compares each view with many others, which observe the
        same surfaces from other viewpoints, and can average such errors.
        """
        if self.pixel_variance is None:
            return self
        return replace(self, plane_variance=self.pixel_variance, pixel_variance=None)

    def without_caches(self) -> PreparedView:
        """Return the view without its cached derived images, which double its memory."""
        return replace(self)

    def with_falloff(self, exponent: float) -> PreparedView:
        """Return the view with its albedo compensated for this falloff, beyond any earlier one."""
        if exponent == 0 or not self.has_albedo:
            return self
        x, y = np.moveaxis(self.rays, -1, 0)
        length2 = 1 + x * x + y * y
        compensation = np.stack([0.5 * np.log(length2), x / length2, y / length2], -1)
        return replace(self, albedo=np.asarray(self.albedo + exponent * compensation, np.float32))

    def with_range_falloff(self, exponent: float) -> PreparedView:
        """Return the view with its albedo compensated for this falloff with the range."""
        if exponent == 0 or not self.has_albedo:
            return self
        # The range is the length of the ray over w = 1/z, of which a and b are the slopes.
        a, b, _, w = np.moveaxis(self.planes, -1, 0)
        w = np.where(w > 0, w, np.float32(np.nan))
        compensation = np.stack([np.log(w), a / w, b / w], -1)
        view = self.with_falloff(exponent)
        return replace(view, albedo=np.asarray(view.albedo - exponent * compensation, np.float32))

    def subsampled(self, columns: int) -> PreparedView:
        """Return the view at every n-th pixel, so that it has at most `columns` columns.

        Planes extend beyond their pixel, so that comparing views needs few pixels. The result is
        cached.
        """
        step = -(-self.z.shape[1] // columns)
        if step == 1:
            return self
        if step in self._subsampled:
            return self._subsampled[step]
        pixels = (slice(step // 2, None, step),) * 2
        images: dict[str, Any] = {
            name: np.ascontiguousarray(image[pixels])
            for name in ("z", "sigma", "planes", "plane_variance", "albedo", "pixel_variance")
            if (image := getattr(self, name)) is not None
        }
        if not self.has_albedo:
            images["albedo"] = _no_albedo(*images["z"].shape)
        projection = self.projection.subsampled(step)
        self._subsampled[step] = replace(
            self, rays=projection.rays, projection=projection, **images
        )
        return self._subsampled[step]

    @cached_property
    def depth(self) -> float:
        """Median z in m; 1 without valid pixels."""
        valid = self.z[self.z > 0]
        return median(valid) if len(valid) else 1.0

    @cached_property
    def noise(self) -> float:
        """Median standard deviation of the planes, relative to z; 0 without a plane."""
        w = self.planes[::_NOISE_STEP, ::_NOISE_STEP, 3]
        variance = self.plane_variance[::_NOISE_STEP, ::_NOISE_STEP][w > 0]
        return math.sqrt(median(variance / w[w > 0] ** 2)) if len(variance) else 0.0

    @cached_property
    def target(self) -> Float32:
        """(H, W, PIXEL_SIZE) target image for alignment, see `make_target`."""
        return make_target(self.images)

    @property
    def images(self) -> ViewImages:
        """The images as input of the kernels."""
        return ViewImages(self.rays, self.planes, self.plane_variance, self.albedo)

    @property
    def target_image(self) -> TargetImage:
        """The target image and its projection."""
        return TargetImage(self.target, self.projection.lookup, self.projection.frame)

    @cached_property
    def planar_fraction(self) -> float:
        """Fraction of the pixels that have a plane."""
        return float(np.count_nonzero(self.planes[..., 3] > 0)) / self.z.size


def prepare_view(frame: RangeFrame, options: SurfaceOptions) -> PreparedView:
    """Prepare a frame for alignment.

    The noise is the frame's own `sigma_image` if there is one, else a law of the sensor family
    (inversely proportional to the amplitude, or quadratic in the depth). Its scale is estimated
    from the view, as the median misfit of small planes; stated noise is never scaled down, as
    planes do not reveal noise that is correlated between neighbours. Images with so many scattered
    missing pixels that most pixels have no plane are halved further, until the gaps are closed:
    those of cameras that drop single pixels, of spot projectors, and depth that was projected into
    an image of higher resolution.
    """
    projection, z, amplitude, stated = _at_working_resolution(frame, options.columns)
    rays = projection.rays
    w = inverse(z, z > 0)
    from_amplitude = frame.amplitude_image is not None
    sigma = (
        noise_law(frame, z, amplitude if from_amplitude else None, projection)
        if stated is None
        else stated
    )
    # d(1/z) = dz / z^2
    weight = inverse((sigma * w * w) ** 2, (z > 0) & (sigma > 0))
    noise = typical_noise(w, weight)
    requested, options = options, options.for_image(projection.pitch, noise)
    columns = _columns_without_gaps(frame, z, options)
    if columns < z.shape[1]:
        return prepare_view(frame, replace(requested, columns=columns))
    if options.edge_margin:
        jump = max(options.edge_jump, options.edge_sigmas * noise)
        weight[edge_pixels(w, jump, options.edge_margin)] = 0
    valid = weight > 0
    rows, columns = z.shape
    scale = max(
        noise_scale(w, rays, weight, options.radii[0]),
        scale_at(_MIN_NOISE, z, sigma) if stated is None else 1.0,
    )
    limit = MISFIT * max(scale, scale_at(options.flatness, z, sigma))
    planes, quality = fitted_planes(w, rays, weight, valid, limit, options)
    albedo = _no_albedo(rows, columns)
    has_albedo = amplitude is not None
    if amplitude is not None:
        albedo = np.full((rows, columns, 3), np.nan, np.float32)
        raw_albedo = np.empty((rows, columns), np.float32)
        falls_off = from_amplitude and frame.amplitude_kind == "raw"
        albedo_image(
            planes, rays, amplitude, falls_off, from_amplitude, options.falloff or 0.0, raw_albedo
        )
        run_chunks(
            lambda a, b: smooth_and_slope(
                raw_albedo, planes, rays, _ALBEDO_RADIUS, 0.05, albedo, a, b
            ),
            rows,
            row_chunks(rows),
        )
    shared = shared_sigma(frame, projection.lengths2)
    variance, pixel_variance = with_shared_error(
        quality[..., 1] * np.float32(scale), planes, shared
    )
    view = PreparedView(
        frame.index,
        rays,
        z,
        sigma * np.float32(np.sqrt(scale)),
        planes,
        variance,
        albedo,
        projection,
        has_albedo,
        pixel_variance=pixel_variance,
        unknown_falloff=(
            from_amplitude
            and options.falloff is None
            and frame.amplitude_kind != "range_compensated"
        ),
        measures_range=frame.depth_kind == "range",
    )
    if from_amplitude and frame.amplitude_kind != "ir":
        return view
    default_exponent = RAW_RANGE_FALLOFF if from_amplitude else 0.0
    exponent = default_exponent if options.range_falloff is None else options.range_falloff
    return view.with_range_falloff(exponent)


@lru_cache(maxsize=16)
def _no_albedo(rows: int, columns: int) -> Float32:
    """Return a NaN image (H, W, 3) that all views without albedo share; it must not be changed."""
    return np.full((rows, columns, 3), np.nan, np.float32)


def _at_working_resolution(
    frame: RangeFrame, columns: int
) -> tuple[Projection, Float32, Float32 | None, Float32 | None]:
    """Return projection, z, amplitude (or luminance) and the frame's sigma of z, downsampled."""
    z = frame.z
    z = np.where(frame.valid & (z > _MIN_DEPTH) & (z < _MAX_DEPTH), z, np.float32(0))
    amplitude = _amplitude(frame)
    sigma = stated_sigma(frame)
    step = 1
    while z.shape[1] > columns and z.shape[0] > 1:
        variance = z if sigma is None else sigma * sigma
        halved = _halve(z, z if amplitude is None else amplitude, variance)
        z = halved[0]
        amplitude = None if amplitude is None else halved[1]
        sigma = None if sigma is None else np.sqrt(halved[2])
        step *= 2
    projection = projection_of(frame.camera, step)
    if step > 1 and projection.unknown is not None:
        # The mean ray of a block with an unknown ray is unknown.
        z[projection.unknown] = 0
    return projection, z, amplitude, sigma


def _amplitude(frame: RangeFrame) -> Float32 | None:
    """Return the amplitude, else the luminance of the colour; 0 where saturated or too dark.

    The gamma of colours becomes a constant factor of the log albedo.
    """
    amplitude = frame.amplitude_image
    if amplitude is not None:
        return np.where(amplitude < SATURATED_AMPLITUDE, amplitude, np.float32(0)).astype(
            np.float32
        )
    if frame.color_image is None or not frame.color_registered:
        return None
    color = np.ascontiguousarray(frame.color_image)
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    unsaturated = cv2.inRange(color, (0, 0, 0), (_MAX_LEVEL - 1,) * 3) > 0
    return np.where((grey >= _MIN_LEVEL) & unsaturated, grey, 0).astype(np.float32)


def _halve(z: Float32, amplitude: Float32, variance: Float32) -> list[Float32]:
    halved = [np.empty((z.shape[0] // 2, z.shape[1] // 2), np.float32) for _ in range(3)]
    run_chunks(
        lambda a, b: halve(
            z, amplitude, variance, _HALVING_JUMP, halved[0], halved[1], halved[2], a, b
        ),
        len(halved[0]),
        row_chunks(len(halved[0])),
    )
    return halved


def _columns_without_gaps(frame: RangeFrame, z: Float32, options: SurfaceOptions) -> int:
    """Return the columns of the resolution at which most pixels can have a plane.

    It is that of the image z (H, W), unless most of its valid pixels lack neighbours. Halving it
    closes gaps of scattered pixels; larger ones stay, and halving costs pixels.
    """
    best, valid = pixels_with_plane(z, options)
    columns = z.shape[1]
    if 2 * best >= valid:
        return columns
    rows, halved = z.shape[0] // 2, columns // 2
    while min(rows, halved) >= _MIN_SIDE:
        with_plane, _ = pixels_with_plane(_at_working_resolution(frame, halved)[1], options)
        if with_plane > best:
            best, columns = with_plane, halved
        rows, halved = rows // 2, halved // 2
    return columns
