"""A view prepared for alignment: local planes, albedo, and the uncertainty of both."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from tofuse.arrays import Bool, Float32, Float64, Int32, UInt8
from tofuse.geometry.cameras import Camera, ray_lengths
from tofuse.kernels.alignment import TargetImage, ViewImages, make_target
from tofuse.kernels.median import median
from tofuse.kernels.plane_extension import extend_planes
from tofuse.kernels.surface import (
    albedo_image,
    fit_planes,
    halve,
    smooth_and_slope,
)
from tofuse.kernels.threads import run_chunks
from tofuse.normal import MEDIAN_OF_NORMAL
from tofuse.recordings.frames import SATURATED_AMPLITUDE, RangeFrame

# Rows of a chunk: many, as chunks cost synchronisation and their windows overlap; fixed, so that
# the result does not depend on the number of threads.
_CHUNK_ROWS = 60
# Sparse images are not halved below this width and height.
_MIN_SIDE = 16
# Tangent of the incidence (80 degrees) up to which neighbouring pixels belong to one surface.
_STEEPEST = 5.67
# Relative difference of depths up to which they belong to one surface when an image is halved.
_HALVING_JUMP = 0.02
# Range of usable colour levels: darker ones are noise, brighter ones saturated.
_MIN_LEVEL, _MAX_LEVEL = 8, 254
# m. Depths and sigmas beyond are invalid, and their squares exceed the range of float32.
_MIN_DEPTH, _MAX_DEPTH = 1e-3, 1e3
_MIN_SIGMA = 1e-6
# Lower limit of the noise relative to the depth, for views that are averaged or simulated without
# noise.
_MIN_NOISE = 3e-4
# Number of pixels assumed to share a correlated error: an alignment treats pixels as independent,
# so its variance is multiplied by this.
_CORRELATED_PIXELS = 100.0
# Pixels whose noise exceeds the typical one by this ratio get planes of their own, if they are at
# least this fraction of a view.
_NOISY_RATIO, _MIN_NOISY = 2.0, 0.02
# Largest distance, in standard deviations, of a pixel that belongs to a plane.
_MAX_PLANE_SIGMAS = 3.0


# Exponent of the range by which the amplitude of a time-of-flight camera falls off.
RAW_RANGE_FALLOFF = 2.0


@dataclass(frozen=True)
class Smoothed:
    """Preparation of views that the camera has smoothed, at a finer scale.

    In such views noise is no limit, and the structures that constrain the pose may be small.

    Attributes
    ----------
    noise
        Applies to views whose noise between neighbouring pixels is below this fraction of the
        depth.
    radii, edge_margin, fill
        Replace the fields of `SurfaceOptions`.
    """

    noise: float = 0.001
    radii: tuple[int, ...] = (1, 2)
    edge_margin: int = 0
    fill: float = 0.5


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of the preparation of a view.

    Attributes
    ----------
    columns
        Images are halved until they have at most this many columns (further if they are sparse).
    radii
        Half widths of the windows of the plane fits, pixels: the smallest gives the depth, the
        widest one that contains a single surface gives the slope.
    edge_jump, edge_margin, edge_sigmas
        Pixels within `edge_margin` pixels of a depth edge are left out of the fits, as they mix
        light of both sides. An edge is a relative difference above `edge_jump`, above that of
        neighbouring pixels on a surface at an incidence of 80 degrees, and above `edge_sigmas`
        times the view's typical noise.
    misfit
        Largest ratio of the residual variance of a window to that of the smallest windows.
    flatness
        Deviations from a plane below this fraction of the depth are accepted whatever the noise of
        the view, as cameras may smooth their images.
    fill, offset
        Smallest valid fraction of a window, and largest squared offset of its valid pixels'
        centroid relative to their variance.
    albedo_radius
        Half width of the box filter of the albedo, pixels.
    falloff
        Exponent of the cosine to the optical axis by which amplitude falls off towards the corners;
        None to estimate it from the recording.
    range_falloff
        Exponent of the range by which colour (as if lit by a lamp on the camera) or infrared
        images of kind "ir" get darker; None to estimate it from the recording. A view alone is
        taken for one in ambient light, or for that of a time-of-flight camera.
    smoothed
        Options for views with hardly any noise.
    """

    columns: int = 320
    radii: tuple[int, ...] = (2, 5)
    edge_jump: float = 0.04
    edge_margin: int = 1
    edge_sigmas: float = 3.0
    misfit: float = 1.2
    flatness: float = 0.002
    fill: float = 0.7
    offset: float = 0.2
    albedo_radius: int = 1
    falloff: float | None = None
    range_falloff: float | None = None
    smoothed: Smoothed = Smoothed()

    def for_pitch(self, pitch: float) -> SurfaceOptions:
        """Return the options for images with this difference of x/z between neighbouring pixels.

        In coarse images slanted surfaces have larger differences of depth, which are no edges.
        """
        jump = max(self.edge_jump, _STEEPEST * pitch)
        return self if jump == self.edge_jump else replace(self, edge_jump=jump)

    def for_noise(self, noise: float) -> SurfaceOptions:
        """Return the options for a view with this noise between neighbours, relative to depth."""
        s = self.smoothed
        if noise >= s.noise:
            return self
        return replace(self, radii=s.radii, edge_margin=s.edge_margin, fill=s.fill)


@dataclass(frozen=True, eq=False)
class Projection:
    """Rays of a grid of pixels, and the projection of rays onto it, for any camera model.

    Attributes
    ----------
    rays
        (H, W, 2) float32 ray coordinates x/z, y/z of the pixels.
    lookup
        (A, B, 2) float32 pixel (u, v) of each node of a grid over ray coordinates; far outside the
        image for rays that the camera does not see.
    frame
        (4,) origin and inverse spacing of the nodes: x0, y0, 1/dx, 1/dy.
    """

    rays: Float32
    lookup: Float32
    frame: Float64
    _subsampled: dict[int, Projection] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        # Read-only like a camera's own rays, so that each kernel is compiled for one type of them.
        self.rays.flags.writeable = False

    @cached_property
    def unknown(self) -> Bool | None:
        """(H, W) mask of pixels whose ray is unknown; None if there are none."""
        unknown: Bool = np.isnan(self.lengths2)
        return unknown if unknown.any() else None

    @cached_property
    def lengths2(self) -> Float32:
        """(H, W) squared ratio of the range to z."""
        return np.float32(1) + (self.rays * self.rays).sum(-1)

    @cached_property
    def ray_bounds(self) -> tuple[Float32, Float32]:
        """Smallest and largest (2,) x/z, y/z of the pixels."""
        return np.nanmin(self.rays, (0, 1)), np.nanmax(self.rays, (0, 1))

    @cached_property
    def pitch(self) -> float:
        """Typical difference of x/z between neighbouring pixels."""
        return float(np.nanmedian(np.abs(np.diff(self.rays[..., 0], axis=1))))

    @classmethod
    def of(cls, camera: Camera, step: int, spacing: float = 4.0) -> Projection:
        """Make the projection of a camera whose images are downsampled by `step`.

        `spacing` is the distance between nodes, in pixels of the full image.
        """
        rays = camera.rays()
        low = np.nanmin(rays, axis=(0, 1)).astype(float)
        high = np.nanmax(rays, axis=(0, 1)).astype(float)
        shape = np.maximum(
            np.ceil(np.array([camera.width, camera.height]) / spacing).astype(int), 4
        )
        margin = (high - low) / shape
        low, high = low - margin, high + margin
        x, y = (np.linspace(a, b, n + 3) for a, b, n in zip(low, high, shape, strict=True))
        nodes = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], -1)
        pixels = (camera.project(nodes) + 0.5) / step - 0.5
        lookup = np.where(np.isfinite(pixels), pixels, -1e6).astype(np.float32)
        scale = np.array([x[0], y[0], 1 / (x[1] - x[0]), 1 / (y[1] - y[0])])
        return cls(_halve_rays(rays, step), lookup, scale)

    def subsampled(self, step: int) -> Projection:
        """Return the projection of every `step`-th pixel, one object for all views."""
        if step not in self._subsampled:
            first = step // 2
            rays = np.ascontiguousarray(self.rays[first::step, first::step])
            lookup = (self.lookup - np.float32(first)) / np.float32(step)
            self._subsampled[step] = Projection(rays, lookup, self.frame)
        return self._subsampled[step]


def _halve_rays(rays: Float32, step: int) -> Float32:
    while step > 1:
        rows, columns = rays.shape[0] // 2, rays.shape[1] // 2
        rays = rays[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 2).mean((1, 3))
        step //= 2
    return np.ascontiguousarray(rays)


_projections: WeakKeyDictionary[Camera, dict[int, Projection]] = WeakKeyDictionary()


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
        Whether the camera measures radial range, of which z was computed.
    """

    index: int
    rays: Float32
    z: Float32
    sigma: Float32
    planes: Float32
    plane_variance: Float32
    albedo: Float32
    projection: Projection
    has_albedo: bool = field(default=False)
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
        """Return the view with an albedo that is compensated for this falloff (further)."""
        if exponent == 0 or not self.has_albedo:
            return self
        x, y = np.moveaxis(self.rays, -1, 0)
        length2 = 1 + x * x + y * y
        more = np.stack([0.5 * np.log(length2), x / length2, y / length2], -1)
        return replace(self, albedo=np.asarray(self.albedo + exponent * more, np.float32))

    def with_range_falloff(self, exponent: float) -> PreparedView:
        """Return the view with an albedo that is compensated for this falloff with the range."""
        if exponent == 0 or not self.has_albedo:
            return self
        # The range is the length of the ray over w = 1/z, of which a and b are the slopes.
        a, b, _, w = np.moveaxis(self.planes, -1, 0)
        w = np.where(w > 0, w, np.float32(np.nan))
        near = np.stack([np.log(w), a / w, b / w], -1)
        view = self.with_falloff(exponent)
        return replace(view, albedo=np.asarray(view.albedo - exponent * near, np.float32))

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
        first = step // 2
        kept = (slice(first, None, step),) * 2
        z, sigma, planes, variance = (
            np.ascontiguousarray(image[kept])
            for image in (self.z, self.sigma, self.planes, self.plane_variance)
        )
        albedo = (
            np.ascontiguousarray(self.albedo[kept]) if self.has_albedo else _no_albedo(*z.shape)
        )
        projection = self.projection.subsampled(step)
        rays = projection.rays
        own = self.pixel_variance
        self._subsampled[step] = PreparedView(
            self.index,
            rays,
            z,
            sigma,
            planes,
            variance,
            albedo,
            projection,
            self.has_albedo,
            pixel_variance=None if own is None else np.ascontiguousarray(own[kept]),
            unknown_falloff=self.unknown_falloff,
            measures_range=self.measures_range,
        )
        return self._subsampled[step]

    @cached_property
    def depth(self) -> float:
        """Median z in m; 1 without valid pixels."""
        valid = self.z[self.z > 0]
        return median(valid) if len(valid) else 1.0

    @cached_property
    def target(self) -> Float32:
        """(H, W, PIXEL_SIZE) target image for alignment, see `make_target`."""
        return make_target(self.images)

    @property
    def images(self) -> ViewImages:
        """The images as the kernels take them."""
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
    projection, z, amplitude, own = _at_working_resolution(frame, options.columns)
    rays = projection.rays
    w = _inverse(z, z > 0)
    lit = frame.amplitude_image is not None
    sigma = _noise_law(frame, z, amplitude if lit else None, projection) if own is None else own
    # d(1/z) = dz / z^2
    weight = _inverse((sigma * w * w) ** 2, (z > 0) & (sigma > 0))
    noise = _typical_noise(w, weight)
    given, options = options, options.for_noise(noise).for_pitch(projection.pitch)
    columns = _columns_without_gaps(frame, z, options)
    if columns < z.shape[1]:
        return prepare_view(frame, replace(given, columns=columns))
    if options.edge_margin:
        jump = max(options.edge_jump, options.edge_sigmas * noise)
        weight[_edge_pixels(w, jump, options.edge_margin)] = 0
    known = weight > 0
    rows, columns = z.shape
    scale = max(
        _noise_scale(w, rays, weight, options.radii[0]),
        _scale_at(_MIN_NOISE, z, sigma) if own is None else 1.0,
    )
    limit = options.misfit * max(scale, _scale_at(options.flatness, z, sigma))
    planes, quality = _fit(w, rays, weight, known, limit, options)
    albedo = _no_albedo(rows, columns)
    has_albedo = amplitude is not None
    if amplitude is not None:
        albedo = np.full((rows, columns, 3), np.nan, np.float32)
        raw_albedo = np.empty((rows, columns), np.float32)
        falls = lit and frame.amplitude_kind == "raw"
        albedo_image(planes, rays, amplitude, falls, lit, options.falloff or 0.0, raw_albedo)
        run_chunks(
            lambda a, b: smooth_and_slope(
                raw_albedo, planes, rays, options.albedo_radius, 0.05, albedo, a, b
            ),
            rows,
            _chunks(rows),
        )
    shared = _shared_sigma(frame, projection.lengths2)
    variance, own_variance = _add_shared_error(quality[..., 1] * np.float32(scale), planes, shared)
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
        pixel_variance=own_variance,
        unknown_falloff=(
            lit and options.falloff is None and frame.amplitude_kind != "range_compensated"
        ),
        measures_range=frame.depth_kind == "range",
    )
    if lit and frame.amplitude_kind != "ir":
        return view
    by_kind = RAW_RANGE_FALLOFF if lit else 0.0
    exponent = by_kind if options.range_falloff is None else options.range_falloff
    return view.with_range_falloff(exponent)


@lru_cache(maxsize=16)
def _no_albedo(rows: int, columns: int) -> Float32:
    """Return a NaN image (H, W, 3) that all views without albedo share; it must not be changed."""
    return np.full((rows, columns, 3), np.nan, np.float32)


def with_extended_planes(
    surface: PreparedView, frame: RangeFrame, options: SurfaceOptions
) -> PreparedView:
    """Return the view of `frame` with more planes, for fusion: at noisy pixels and depth edges.

    They are left out for tracking. Existing planes stay; variances are those of
    `PreparedView.with_pixel_variance`.
    """
    surface = surface.with_pixel_variance()
    known = (surface.z > 0) & (surface.sigma > 0)
    if not known.any():
        return surface
    w = _inverse(surface.z, known)
    noise = np.where(known, surface.sigma * w, np.float32(0))
    typical = median(noise[known])
    options = options.for_noise(float(np.sqrt(2) * typical)).for_pitch(surface.projection.pitch)
    missing = known & (surface.planes[..., 3] == 0)
    quiet = surface.planes
    if np.count_nonzero(missing & (noise > _NOISY_RATIO * typical)) >= _MIN_NOISY * known.size:
        surface = _with_planes_at_noisy_pixels(surface, frame, w, noise, missing, options)
        missing = known & (surface.planes[..., 3] == 0)
    return _with_planes_of_neighbours(surface, quiet, w, noise, missing, options)


def _with_planes_at_noisy_pixels(
    surface: PreparedView,
    frame: RangeFrame,
    w: Float32,
    noise: Float32,
    missing: Bool,
    options: SurfaceOptions,
) -> PreparedView:
    """Return the view with planes at pixels that are noisier than its typical pixel.

    `prepare_view` detects depth edges by the typical noise. Here the noise (H, W), relative to the
    depth, of the two adjacent pixels is used, unless one of them is much noisier than the other.
    """
    edge = _edge_pixels_by_noise(w, noise, options)
    missing = missing & ~edge
    weight = _inverse((noise * w) ** 2, (w > 0) & ~edge)
    limit = options.misfit * max(1.0, _scale_at(options.flatness, surface.z, surface.sigma))
    planes, quality = _fit(w, surface.rays, weight, missing, limit, options)
    new = missing & (planes[..., 3] > 0)
    shared = _shared_sigma(frame, surface.projection.lengths2)
    variance, own = _add_shared_error(quality[..., 1], planes, shared)
    return replace(
        surface,
        planes=np.where(new[..., None], planes, surface.planes),
        plane_variance=np.where(new, variance if own is None else own, surface.plane_variance),
    )


def _with_planes_of_neighbours(
    surface: PreparedView,
    quiet: Float32,
    w: Float32,
    noise: Float32,
    missing: Bool,
    options: SurfaceOptions,
) -> PreparedView:
    """Return the view with the planes of neighbours at pixels whose depth agrees with these.

    No window fits next to a depth edge, yet the surface extends up to it; a pixel that mixes light
    of both sides agrees with neither plane. Only the planes `quiet` (H, W, 4) of pixels with
    typical noise are extended: dark surfaces are biased by multipath beyond their noise.
    """
    steps, growth = _steps(options.radii[0])
    planes, variance = surface.planes.copy(), surface.plane_variance.copy()
    extend_planes(
        w, noise * w, surface.rays, missing, quiet, surface.plane_variance, steps, growth,
        _MAX_PLANE_SIGMAS, options.edge_jump, planes, variance,
    )  # fmt: skip
    return replace(surface, planes=planes, plane_variance=variance)


@lru_cache(maxsize=8)
def _steps(radius: int) -> tuple[Int32, Float32]:
    """Return offsets to the pixels around one, nearest first, and the growth of variance to them.

    The variance of a plane fitted to a window of this radius grows with the squared distance
    relative to the window's mean square. Offsets reach two pixels beyond the window's radius, as
    pixels on both sides of an edge are left out.
    """
    reach = radius + 2
    around = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    squares = (around**2).sum(1)
    order = np.argsort(squares, kind="stable")[1:]
    growth = 1 + squares[order] / (radius * (radius + 1) / 3)
    return around[order].astype(np.int32), growth.astype(np.float32)


def _edge_pixels_by_noise(w: Float32, noise: Float32, options: SurfaceOptions) -> Bool:
    """Do the same as `_edge_pixels` with an individual noise (H, W), relative to the depth."""
    edge = np.zeros(w.shape, np.uint8)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        n, m = noise[a] ** 2, noise[b] ** 2
        # A large change of the noise is an edge between surfaces.
        differs = np.float32(options.edge_sigmas) * np.sqrt(np.minimum(n + m, 4 * np.minimum(n, m)))
        limit = np.minimum(np.maximum(differs, np.float32(options.edge_jump)), np.float32(0.9))
        across = np.abs(w[a] - w[b]) > limit * np.maximum(w[a], w[b])
        edge[a] |= across
        edge[b] |= across
    return dilated(edge, options.edge_margin)


def dilated(mask: UInt8, margin: int) -> Bool:
    """Return the pixels within `margin`, in rows and columns, of one that is not 0."""
    size = 2 * margin + 1
    return cv2.dilate(mask, np.ones((size, size), np.uint8)) > 0


def _add_shared_error(
    variance: Float32, planes: Float32, shared: Float32 | None
) -> tuple[Float32, Float32 | None]:
    """Return `plane_variance` and `pixel_variance` with the shared sigma of z (H, W) in m added."""
    if shared is None:
        return variance, None
    once = (shared * planes[..., 3] ** 2) ** 2
    return variance + np.float32(_CORRELATED_PIXELS) * once, variance + once


def _inverse(values: Float32, known: Bool) -> Float32:
    """Return the reciprocal of each value, 0 where it is not known."""
    return np.reciprocal(np.where(known, values, np.float32(np.inf)))


def _projection(camera: Camera, step: int) -> Projection:
    known = _projections.setdefault(camera, {})
    if step not in known:
        known[step] = Projection.of(camera, step)
    return known[step]


def _at_working_resolution(
    frame: RangeFrame, columns: int
) -> tuple[Projection, Float32, Float32 | None, Float32 | None]:
    """Return projection, z, amplitude (or luminance) and the frame's sigma of z, downsampled."""
    z = frame.z
    z = np.where(frame.valid & (z > _MIN_DEPTH) & (z < _MAX_DEPTH), z, np.float32(0))
    amplitude = _amplitude(frame)
    sigma = _own_sigma(frame)
    step = 1
    while z.shape[1] > columns and z.shape[0] > 1:
        variance = z if sigma is None else sigma * sigma
        halves = _halve(z, z if amplitude is None else amplitude, variance)
        z = halves[0]
        amplitude = None if amplitude is None else halves[1]
        sigma = None if sigma is None else np.sqrt(halves[2])
        step *= 2
    projection = _projection(frame.camera, step)
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
    seen = (grey >= _MIN_LEVEL) & unsaturated
    return np.where(seen, grey, 0).astype(np.float32)


def _own_sigma(frame: RangeFrame) -> Float32 | None:
    """Return the sigma of z (H, W) that the frame states, m; 0 where unknown."""
    if frame.sigma_image is None:
        return None
    known = (frame.sigma_image > _MIN_SIGMA) & (frame.sigma_image < _MAX_DEPTH)
    # The stated noise is that of the radial range.
    sigma = np.where(known, frame.sigma_image / ray_lengths(frame.camera), np.float32(0))
    return np.asarray(sigma, np.float32)


def _shared_sigma(frame: RangeFrame, lengths2: Float32) -> Float32 | None:
    """Return the correlated sigma of z (H, W) in m, given the squared ray lengths (H, W)."""
    image = frame.shared_sigma_image
    if image is None:
        return None
    rows, columns = lengths2.shape
    step = image.shape[1] // columns
    # It varies slowly: one pixel per block is enough.
    picked = image[step // 2 :: step, step // 2 :: step][:rows, :columns]
    known = np.isfinite(picked) & (picked > 0)
    return np.asarray(np.where(known, picked, 0) / np.sqrt(lengths2), np.float32)


def _halve(z: Float32, amplitude: Float32, variance: Float32) -> list[Float32]:
    out = [np.empty((z.shape[0] // 2, z.shape[1] // 2), np.float32) for _ in range(3)]
    run_chunks(
        lambda a, b: halve(z, amplitude, variance, _HALVING_JUMP, out[0], out[1], out[2], a, b),
        len(out[0]),
        _chunks(len(out[0])),
    )
    return out


def _fit(
    w: Float32,
    rays: Float32,
    weight: Float32,
    wanted: Bool,
    limit: float,
    options: SurfaceOptions,
) -> tuple[Float32, Float32]:
    """Return planes (H, W, 4) and quality (H, W, 2) at the wanted pixels, see `fit_planes`."""
    rows, columns = w.shape
    planes = np.empty((rows, columns, 4), np.float32)
    quality = np.empty((rows, columns, 2), np.float32)
    radii = np.array(options.radii, np.int64)

    def fit(start: int, stop: int) -> None:
        fit_planes(
            w, rays, weight, wanted, radii, limit, options.fill, options.offset,
            planes, quality, start, stop,
        )  # fmt: skip

    run_chunks(fit, rows, _chunks(rows))
    return planes, quality


def _chunks(rows: int) -> int:
    return max(2, rows // _CHUNK_ROWS)


def _columns_without_gaps(frame: RangeFrame, z: Float32, options: SurfaceOptions) -> int:
    """Return the columns of the resolution at which most pixels can have a plane.

    It is that of the image z (H, W), unless most of its valid pixels lack neighbours. Halving it
    closes gaps of scattered pixels; larger ones stay, and halving costs pixels.
    """
    best, valid = _filled(z, options)
    columns = z.shape[1]
    if 2 * best >= valid:
        return columns
    rows, halved = z.shape[0] // 2, columns // 2
    while min(rows, halved) >= _MIN_SIDE:
        filled, _ = _filled(_at_working_resolution(frame, halved)[1], options)
        if filled > best:
            best, columns = filled, halved
        rows, halved = rows // 2, halved // 2
    return columns


def _filled(z: Float32, options: SurfaceOptions) -> tuple[int, int]:
    """Return how many pixels have the neighbours for a plane fit, and how many are valid."""
    missing = (z <= 0).view(np.uint8)
    usable = z > 0
    if options.edge_margin:
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        beside = np.asarray(cv2.dilate(missing, cross), np.uint8)
        usable = ~dilated(beside, options.edge_margin)
    size = 2 * options.radii[0] + 1
    density = cv2.blur(usable.astype(np.float32), (size, size))
    filled = (density >= options.fill) & (z > 0)
    return int(np.count_nonzero(filled)), int(np.count_nonzero(z > 0))


def _edge_pixels(w: Float32, jump: float, margin: int) -> Bool:
    """Return the pixels within `margin` of an invalid pixel or a relative depth step of `jump`.

    Due to the blur of the lens they mix light of both sides.
    """
    edge = np.zeros(w.shape, np.uint8)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        across = np.abs(w[a] - w[b]) > np.float32(min(jump, 0.9)) * np.maximum(w[a], w[b])
        edge[a] |= across
        edge[b] |= across
    return dilated(edge, margin)


def _typical_noise(w: Float32, weight: Float32) -> float:
    """Return the standard deviation of the difference between neighbours, relative to their depth.

    A robust estimate from the median of second differences along some of the rows.
    """
    rows = np.s_[::4]
    some = [w[rows, k : w.shape[1] - 2 + k] for k in range(3)]
    known = np.logical_and.reduce([weight[rows, k : w.shape[1] - 2 + k] > 0 for k in range(3)])
    if not known.any():
        return 0.0
    before, here, after = (values[known] for values in some)
    bend = np.abs(before - 2 * here + after) / here
    # sqrt(6) in a second difference, sqrt(2) in a first one.
    return median(bend) / MEDIAN_OF_NORMAL / np.sqrt(3.0)


def _noise_law(
    frame: RangeFrame, z: Float32, amplitude: Float32 | None, projection: Projection
) -> Float32:
    """Return the sigma of z (H, W) in m up to a factor, by a law of the sensor family."""
    if amplitude is None or frame.amplitude_kind == "ir":
        return np.float32(0.001) + np.float32(0.003) * z * z
    if frame.amplitude_kind == "raw":
        raw = amplitude
    else:
        r2 = z * z * projection.lengths2
        raw = amplitude * _inverse(r2, r2 > 0)
    lit = raw[::2, ::2]
    lit = lit[lit > 0]
    if len(lit) == 0:
        return np.float32(0.001) + np.float32(0.003) * z * z
    typical = np.float32(median(lit))
    # A tiny amplitude stands for none, far below the limit of the law.
    law = np.asarray(typical / np.fmax(raw, np.float32(1e-6) * typical), np.float32)
    return np.float32(0.01) * np.clip(law, np.float32(0.15), np.float32(20))


def _scale_at(relative: float, z: Float32, sigma: Float32) -> float:
    """Return the variance scale at which a typical pixel's sigma is `relative` times its depth."""
    z, sigma = z[::4, ::4], sigma[::4, ::4]
    known = (z > 0) & (sigma > 0)
    if not known.any():
        return 0.0
    return median(relative * z[known] / sigma[known]) ** 2


def _noise_scale(w: Float32, rays: Float32, weight: Float32, radius: int) -> float:
    """Estimate the variance scale: median misfit of the smallest windows on some of the rows."""
    rows, columns = w.shape
    planes = np.empty((rows, columns, 4), np.float32)
    quality = np.empty((rows, columns, 2), np.float32)
    values = []
    known = weight > 0
    radii = np.array([radius], np.int64)
    for i in range(radius, rows - radius, max(1, rows // 12)):
        fit_planes(w, rays, weight, known, radii, np.inf, 0.7, 0.2, planes, quality, i, i + 1)
        values.append(quality[i, :, 0])
    found = np.concatenate(values) if values else np.zeros(0)
    found = found[np.isfinite(found)]
    if len(found) == 0:
        return 1.0
    return min(max(median(found), 1e-6), 1e6)
