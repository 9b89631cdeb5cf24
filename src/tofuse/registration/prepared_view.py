"""A view made ready for tracking: where its surfaces are, how they reflect, how well it knows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Protocol
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from tofuse.arrays import Bool, Float32, Float64, Int32, UInt8
from tofuse.geometry.cameras import Camera, ray_lengths
from tofuse.kernels.alignment import make_target
from tofuse.kernels.median import median
from tofuse.kernels.plane_extension import extend_planes
from tofuse.kernels.surface import (
    albedo_image,
    fit_planes,
    halve,
    smooth_and_slope,
)
from tofuse.kernels.threads import run_chunks
from tofuse.recordings.frames import SATURATED_AMPLITUDE, RangeFrame

# Rows of a chunk: many, as each costs a hand-over between threads, and windows reach into the next;
# fixed, so that the number of threads changes nothing.
_CHUNK_ROWS = 60
# Depths within this share of each other are one surface when an image is halved.
_HALVING_JUMP = 0.02
# Levels of colour: below, the logarithm is noise; from the other on, a channel is saturated.
_MIN_LEVEL, _MAX_LEVEL = 8, 254
# m. Depths and sigmas beyond are no measurement, and their squares no float32.
_MIN_DEPTH, _MAX_DEPTH = 1e-3, 1e3
_MIN_SIGMA = 1e-6
# Share of the depth below which no camera's errors are: a view without noise, averaged or made by
# a program, is not known to a hundredth of a millimetre either.
_MIN_NOISE = 3e-4
# An alignment takes pixels for independent. Where so many share an error, they tell together what
# each of them would with that many times its variance.
_CORRELATED_PIXELS = 100.0
# The typical noise does not stand for pixels with so many times as much; to fit planes to them is
# worth its time where they are this share of a view.
_NOISY_RATIO, _MIN_NOISY = 2.0, 0.02
# A pixel within so many standard deviations of a plane has measured it.
_MAX_PLANE_SIGMAS = 3.0
# Of the absolute values of a normal distribution, in standard deviations.
_MEDIAN_OF_NORMAL = 0.6745


class _Windows(Protocol):
    """Options of the windows of plane fits."""

    @property
    def radii(self) -> tuple[int, ...]: ...
    @property
    def edge_margin(self) -> int: ...
    @property
    def fill(self) -> float: ...


def _check_windows(options: _Windows) -> None:
    radii = options.radii
    if not radii or list(radii) != sorted(set(radii)):
        raise ValueError(f"radii is {radii}; give ascending half widths")
    if not 1 <= radii[0] <= radii[-1] <= 50:
        raise ValueError(f"radii is {radii}, not 1 to 50 pixels")
    if not 0 <= options.edge_margin <= 20:
        raise ValueError(f"edge_margin is {options.edge_margin}, not 0 to 20 pixels")
    if not 0 < options.fill <= 1:
        raise ValueError(f"fill is {options.fill}, not above 0 and up to 1")


@dataclass(frozen=True)
class Smoothed:
    """How views are prepared whose noise the camera has smoothed away: finely, as it can be.

    What is left there are shapes, and the few that hold the camera are small.

    Attributes
    ----------
    noise
        A view is one of those if its neighbouring pixels differ by less noise than this share of
        the depth.
    radii, edge_margin, fill
        Take the place of the fields of `SurfaceOptions`.
    """

    noise: float = 0.001
    radii: tuple[int, ...] = (1, 2)
    edge_margin: int = 0
    fill: float = 0.5

    def __post_init__(self) -> None:
        if not 0 <= self.noise <= 1:
            raise ValueError(f"noise is {self.noise}, not 0 to 1")
        _check_windows(self)


@dataclass(frozen=True)
class SurfaceOptions:
    """How a view is prepared.

    Attributes
    ----------
    columns
        Images are halved until they have at most this many columns.
    radii
        Half widths of the windows of the plane fits, pixels: the smallest gives the depth, the
        widest that is one surface the slope.
    edge_jump, edge_margin, edge_sigmas
        Pixels this near (`edge_margin`, in pixels) to a jump in depth by this share are left out of
        the fits: they mix light of both sides. No jump is what differs by less than so many sigmas
        of the view's typical noise.
    misfit
        How much larger than the noise shown by small windows the variance in wider ones may be.
    flatness
        A surface that is this flat, as a share of its depth, is a plane, however little noise the
        view shows: cameras that smooth their images hide it.
    fill, offset
        Least share of a window that must be valid, and largest squared offset of its centre, as a
        share of its squared spread.
    albedo_radius
        Half width of the box that smooths the albedo, pixels.
    falloff
        Exponent of the cosine to the axis by which amplitude falls off towards the corners; None to
        estimate it from the recording, 0 where there is none.
    smoothed
        What is different for views that have hardly any noise.
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
    smoothed: Smoothed = Smoothed()

    def __post_init__(self) -> None:
        if not 16 <= self.columns <= 4096:
            raise ValueError(f"columns is {self.columns}, not 16 to 4096")
        _check_windows(self)
        if not 0 <= self.albedo_radius <= 20:
            raise ValueError(f"albedo_radius is {self.albedo_radius}, not 0 to 20 pixels")
        for name in ("edge_jump", "offset"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not above 0 and up to 1")
        if self.falloff is not None and not -20 <= self.falloff <= 20:
            raise ValueError(f"falloff is {self.falloff}, not -20 to 20")
        if not 0 <= self.edge_sigmas < 1e3:
            raise ValueError(f"edge_sigmas is {self.edge_sigmas}, not 0 or more")
        if not 0 <= self.flatness <= 1:
            raise ValueError(f"flatness is {self.flatness}, not 0 to 1")
        if not 0 < self.misfit < 1e6:
            raise ValueError(f"misfit is {self.misfit}, not above 0")

    def for_noise(self, noise: float) -> SurfaceOptions:
        """Return what to do with a view whose neighbouring pixels differ by this share."""
        s = self.smoothed
        if noise >= s.noise:
            return self
        return replace(self, radii=s.radii, edge_margin=s.edge_margin, fill=s.fill)


@dataclass(frozen=True, eq=False)
class Projection:
    """The rays of a grid of pixels, and where rays land on it, for any camera.

    Attributes
    ----------
    rays
        (H, W, 2) float32 ray coordinates x/z, y/z of the pixels.
    lookup
        (A, B, 2) float32 pixel (u, v) of each node, far outside the image where it sees nothing.
    frame
        (x0, y0, 1/dx, 1/dy) of the nodes.
    """

    rays: Float32
    lookup: Float32
    frame: Float64
    _subsampled: dict[int, Projection] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def unknown(self) -> Bool | None:
        """(H, W) whether a pixel's ray is unknown; None if no pixel's is."""
        unknown: Bool = np.isnan(self.lengths2)
        return unknown if unknown.any() else None

    @cached_property
    def lengths2(self) -> Float32:
        """(H, W) squared ratio of the range to z."""
        return np.float32(1) + (self.rays * self.rays).sum(-1)

    @cached_property
    def pitch(self) -> float:
        """Typical difference of x/z between neighbouring pixels."""
        return float(np.nanmedian(np.abs(np.diff(self.rays[..., 0], axis=1))))

    @classmethod
    def of(cls, camera: Camera, step: int, spacing: float = 4.0) -> Projection:
        """Make the lookup of a camera whose images are halved to every `step`-th pixel."""
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
        """Every `step`-th pixel; one object for all views, which is soon found in the caches."""
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
        (H, W) its standard deviation in m, as the view itself shows it.
    planes
        (H, W, 4): a, b, c of the plane a X + b Y + c Z = 1 at the pixel, and 1/z on it; 0 where
        there is none.
    plane_variance
        (H, W) variance of that 1/z, 1/m^2, as if pixels were independent.
    albedo
        (H, W, 3) logarithm of the albedo (of amplitude, else of colour), smoothed, and its slopes
        by x/z and y/z; NaN where unknown.
    projection
        Where points of this view's frame land.
    pixel_variance
        (H, W) the same as `plane_variance` for one pixel by itself: there errors that neighbours
        share count once, and not as often as they are shared. None where nothing is shared.
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
    _subsampled: dict[int, PreparedView] = field(default_factory=dict, init=False, repr=False)

    @property
    def normals(self) -> Float32:
        """(H, W, 3) unit normals away from the camera, 0 where unknown; made anew each time."""
        abc = self.planes[..., :3]
        length = np.sqrt((abc * abc).sum(-1, keepdims=True))
        return np.where(self.planes[..., 3:] > 0, abc / np.maximum(length, 1e-12), 0).astype(
            np.float32
        )

    @property
    def pixels(self) -> int:
        """How many there are, valid or not."""
        return self.z.size

    def with_pixel_variance(self) -> PreparedView:
        """Return the view with `pixel_variance` for `plane_variance`, if it has both.

        A single alignment can't but take an error that pixels share for the camera's motion, so it
        must rely little on such pixels. Where each view is compared with many others, which saw
        the same surfaces from elsewhere, they know more than that.
        """
        if self.pixel_variance is None:
            return self
        return replace(self, plane_variance=self.pixel_variance, pixel_variance=None)

    def without_caches(self) -> PreparedView:
        """Return the view without what was derived from it, which takes as much memory again."""
        return replace(self)

    def subsampled(self, columns: int) -> PreparedView:
        """Return the view at every n-th pixel, so that it has at most so many columns.

        A plane fits beyond its own pixel, so for comparing views few pixels are enough. All who
        ask for as many get one object, so that it is kept once.
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
        )
        return self._subsampled[step]

    @cached_property
    def depth(self) -> float:
        """Median z in m; 1 where nothing is valid."""
        valid = self.z[self.z > 0]
        return median(valid) if len(valid) else 1.0

    @cached_property
    def target(self) -> Float32:
        """(H, W, PIXEL_SIZE) what points of other views are compared with, see `make_target`."""
        return make_target(self.rays, self.planes, self.plane_variance, self.albedo)

    @cached_property
    def planar_fraction(self) -> float:
        """Share of the pixels at which a plane was fitted."""
        return float(np.count_nonzero(self.planes[..., 3] > 0)) / self.z.size


def prepare_view(frame: RangeFrame, options: SurfaceOptions) -> PreparedView:
    """Prepare a view.

    The noise is taken from the frame's own `sigma_image` where it has one, else from a law of the
    sensor family (one over the amplitude, or the square of the depth); its scale is measured on
    the view itself, as the median misfit of small planes. What a frame states of its noise is not
    made less: planes don't show noise that neighbouring pixels share.
    """
    projection, z, light, own = _at_working_resolution(frame, options.columns)
    rays = projection.rays
    w = _inverse(z, z > 0)
    lit = frame.amplitude_image is not None
    sigma = _noise_law(frame, z, light if lit else None, projection) if own is None else own
    # d(1/z) = dz / z^2
    weight = _inverse((sigma * w * w) ** 2, (z > 0) & (sigma > 0))
    noise = _typical_noise(w, weight)
    options = options.for_noise(noise)
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
    has_albedo = light is not None
    if light is not None:
        albedo = np.full((rows, columns, 3), np.nan, np.float32)
        albedo = np.empty((rows, columns), np.float32)
        falls = lit and frame.amplitude_kind == "raw"
        albedo_image(planes, rays, light, falls, lit, options.falloff or 0.0, albedo)
        run_chunks(
            lambda a, b: smooth_and_slope(
                albedo, planes, rays, options.albedo_radius, 0.05, albedo, a, b
            ),
            rows,
            _chunks(rows),
        )
    shared = _shared_sigma(frame, projection.lengths2)
    variance, own_variance = _add_shared_error(quality[..., 1] * np.float32(scale), planes, shared)
    return PreparedView(
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
    )


@lru_cache(maxsize=16)
def _no_albedo(rows: int, columns: int) -> Float32:
    """NaN (H, W, 3), never written to: one image for all views, as there are many of them."""
    return np.full((rows, columns, 3), np.nan, np.float32)


def with_extended_planes(
    surface: PreparedView, frame: RangeFrame, options: SurfaceOptions
) -> PreparedView:
    """Return the view of `frame` with planes where the tracker does well to have none.

    Where pixels are noisier than the typical one, and at outlines. Planes that were fitted before
    stay; variances are those of `PreparedView.with_pixel_variance`.
    """
    surface = surface.with_pixel_variance()
    known = (surface.z > 0) & (surface.sigma > 0)
    if not known.any():
        return surface
    w = _inverse(surface.z, known)
    noise = np.where(known, surface.sigma * w, np.float32(0))
    typical = median(noise[known])
    options = options.for_noise(float(np.sqrt(2) * typical))
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
    """Return the view with planes where it is noisier than its typical pixel.

    `prepare_view` takes what differs by more than the typical noise for a jump in depth. Here a
    jump is what differs by more than the noise of the pixels next to it, unless one of these is
    much noisier than the other. `noise` (H, W) is a share of the depth.
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
    """Return the view with the planes of their neighbours at pixels that have measured these.

    No window fits next to an outline. But a surface goes on up to there, and a pixel that mixes its
    light with that of another one is on neither plane. Only planes (H, W, 4) of the `quiet` part of
    the view are carried: of what is dark much of the light comes by other ways, so that it is wrong
    by more than its noise tells.
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
    """Steps to the pixels near one, the nearest first, and the growth of variance on the way.

    That of a plane fitted to a window of this radius: with the squared distance over the window's
    mean square. They go one pixel beyond the window's radius, as edges are left out on either side.
    """
    reach = radius + 2
    around = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    squares = (around**2).sum(1)
    order = np.argsort(squares, kind="stable")[1:]
    growth = 1 + squares[order] / (radius * (radius + 1) / 3)
    return around[order].astype(np.int32), growth.astype(np.float32)


def _edge_pixels_by_noise(w: Float32, noise: Float32, options: SurfaceOptions) -> Bool:
    """As `_edge_pixels`, where each pixel has a noise (H, W) of its own, as a share of its depth."""
    edge = np.zeros(w.shape, np.uint8)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        n, m = noise[a] ** 2, noise[b] ** 2
        # A quiet surface ends where a noisy one begins.
        differs = np.float32(options.edge_sigmas) * np.sqrt(np.minimum(n + m, 4 * np.minimum(n, m)))
        share = np.minimum(np.maximum(differs, np.float32(options.edge_jump)), np.float32(0.9))
        across = np.abs(w[a] - w[b]) > share * np.maximum(w[a], w[b])
        edge[a] |= across
        edge[b] |= across
    return _dilate(edge, options.edge_margin)


def _dilate(edge: UInt8, margin: int) -> Bool:
    size = 2 * margin + 1
    return cv2.dilate(edge, np.ones((size, size), np.uint8)) > 0


def _add_shared_error(
    variance: Float32, planes: Float32, shared: Float32 | None
) -> tuple[Float32, Float32 | None]:
    """Variances of planes where pixels also share errors: for alignments, and of one pixel."""
    if shared is None:
        return variance, None
    once = (shared * planes[..., 3] ** 2) ** 2
    return variance + np.float32(_CORRELATED_PIXELS) * once, variance + once


def _inverse(values: Float32, known: Bool) -> Float32:
    """One over each value, 0 where it is not known: at once for all, which is faster."""
    return np.reciprocal(np.where(known, values, np.float32(np.inf)))


def _projection(camera: Camera, step: int) -> Projection:
    known = _projections.setdefault(camera, {})
    if step not in known:
        known[step] = Projection.of(camera, step)
    return known[step]


def _at_working_resolution(
    frame: RangeFrame, columns: int
) -> tuple[Projection, Float32, Float32 | None, Float32 | None]:
    """Grid, z, amplitude (or colour's) and the frame's own sigma of z at the working resolution."""
    z = frame.z
    z = np.where(frame.valid & (z > _MIN_DEPTH) & (z < _MAX_DEPTH), z, np.float32(0))
    light = _amplitude(frame)
    sigma = _own_sigma(frame)
    step = 1
    while z.shape[1] > columns and z.shape[0] > 1:
        variance = z if sigma is None else sigma * sigma
        halves = _halve(z, z if light is None else light, variance)
        z = halves[0]
        light = None if light is None else halves[1]
        sigma = None if sigma is None else np.sqrt(halves[2])
        step *= 2
    projection = _projection(frame.camera, step)
    if step > 1 and projection.unknown is not None:
        # The mean of a block of rays that holds an unknown one is unknown.
        z[projection.unknown] = 0
    return projection, z, light, sigma


def _amplitude(frame: RangeFrame) -> Float32 | None:
    """Amplitude, or without it the luminance of the colour; 0 where saturated or too dark.

    Colour is coded by a power of the light, which its logarithm turns into a factor.
    """
    light = frame.amplitude_image
    if light is not None:
        return np.where(light < SATURATED_AMPLITUDE, light, np.float32(0)).astype(np.float32)
    if frame.color_image is None or not frame.color_registered:
        return None
    grey = cv2.cvtColor(np.ascontiguousarray(frame.color_image), cv2.COLOR_RGB2GRAY)
    seen = (grey >= _MIN_LEVEL) & (frame.color_image.max(-1) < _MAX_LEVEL)
    return np.where(seen, grey, 0).astype(np.float32)


def _own_sigma(frame: RangeFrame) -> Float32 | None:
    """Sigma of z that the frame states, m; 0 where it does not."""
    if frame.sigma_image is None:
        return None
    known = (frame.sigma_image > _MIN_SIGMA) & (frame.sigma_image < _MAX_DEPTH)
    # The noise is that of the range, along the ray.
    sigma = np.where(known, frame.sigma_image / ray_lengths(frame.camera), np.float32(0))
    return np.asarray(sigma, np.float32)


def _shared_sigma(frame: RangeFrame, lengths2: Float32) -> Float32 | None:
    """Sigma of z (H, W) in m that pixels share, where rays have these squared lengths (H, W)."""
    image = frame.shared_sigma_image
    if image is None:
        return None
    rows, columns = lengths2.shape
    step = image.shape[1] // columns
    # It varies slowly: a pixel of each block will do.
    picked = image[step // 2 :: step, step // 2 :: step][:rows, :columns]
    known = np.isfinite(picked) & (picked > 0)
    return np.asarray(np.where(known, picked, 0) / np.sqrt(lengths2), np.float32)


def _halve(z: Float32, light: Float32, variance: Float32) -> list[Float32]:
    out = [np.empty((z.shape[0] // 2, z.shape[1] // 2), np.float32) for _ in range(3)]
    run_chunks(
        lambda a, b: halve(z, light, variance, _HALVING_JUMP, out[0], out[1], out[2], a, b),
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
    """Planes (H, W, 4) and their quality (H, W, 2) where they are wanted, see `fit_planes`."""
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


def _edge_pixels(w: Float32, jump: float, margin: int) -> Bool:
    """Pixels within `margin` of a jump in depth by a share `jump`, or of a missing pixel.

    There a pixel mixes light of both sides, as far as the lens blurs.
    """
    edge = np.zeros(w.shape, np.uint8)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        across = np.abs(w[a] - w[b]) > np.float32(min(jump, 0.9)) * np.maximum(w[a], w[b])
        edge[a] |= across
        edge[b] |= across
    return _dilate(edge, margin)


def _typical_noise(w: Float32, weight: Float32) -> float:
    """Standard deviation of the difference of two neighbours, as a share of their depth.

    That of the typical pixel: its law's scale is the median of second differences along some of
    the rows, as most pixels are on surfaces, and few of those are at edges.
    """
    rows = np.s_[::4]
    some = [w[rows, k : w.shape[1] - 2 + k] for k in range(3)]
    known = np.logical_and.reduce([weight[rows, k : w.shape[1] - 2 + k] > 0 for k in range(3)])
    if not known.any():
        return 0.0
    before, here, after = (values[known] for values in some)
    bend = np.abs(before - 2 * here + after) / here
    # sqrt(6) in a second difference, sqrt(2) in a first one.
    return median(bend) / _MEDIAN_OF_NORMAL / np.sqrt(3.0)


def _noise_law(
    frame: RangeFrame, z: Float32, light: Float32 | None, projection: Projection
) -> Float32:
    """Sigma of z in m up to a factor."""
    if light is None or frame.amplitude_kind == "ir":
        return np.float32(0.001) + np.float32(0.003) * z * z
    if frame.amplitude_kind == "raw":
        raw = light
    else:
        r2 = z * z * projection.lengths2
        raw = light * _inverse(r2, r2 > 0)
    lit = raw[::2, ::2]
    lit = lit[lit > 0]
    if len(lit) == 0:
        return np.float32(0.001) + np.float32(0.003) * z * z
    typical = np.float32(median(lit))
    # The least that is above 0 stands for no light: the law ends far before.
    law = np.asarray(typical / np.fmax(raw, np.float32(1e-6) * typical), np.float32)
    return np.float32(0.01) * np.clip(law, np.float32(0.15), np.float32(20))


def _scale_at(share: float, z: Float32, sigma: Float32) -> float:
    """Scale of the variance at which a typical pixel's sigma is a share of its depth."""
    z, sigma = z[::4, ::4], sigma[::4, ::4]
    known = (z > 0) & (sigma > 0)
    if not known.any():
        return 0.0
    return median(share * z[known] / sigma[known]) ** 2


def _noise_scale(w: Float32, rays: Float32, weight: Float32, radius: int) -> float:
    """Median misfit of the smallest windows on a sparse set of rows: the variance's true scale."""
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
