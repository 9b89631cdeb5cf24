"""Noise of range images, planes of their pixels, and depth edges, which get none; their options.

The noise is stated by the frame or by a law of its kind, with a scale that the planes determine.

`z` is an image (H, W) of depths in m, `w` their reciprocals, and `weight` the inverse variances of
these; all are 0 where unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float32, UInt8
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.compute import median, run_chunks
from tofuse.engine.connections import NEIGHBOURS
from tofuse.engine.frames import RangeFrame
from tofuse.engine.normal import MEDIAN_OF_NORMAL
from tofuse.engine.views.projection import Projection
from tofuse.engine.views.view_planes_kernels import fit_planes

# Rows of a chunk: many, as chunks cost synchronisation and their windows overlap; fixed, so that
# the result does not depend on the number of threads.
_CHUNK_ROWS = 60
# m. Sigmas beyond are invalid, and their squares exceed the range of float32.
_MIN_SIGMA, _MAX_SIGMA = 1e-6, 1e3
# Number of pixels assumed to share a correlated error: an alignment treats pixels as independent,
# so its variance is multiplied by this.
_CORRELATED_PIXELS = 100.0

# Tangent of the incidence (80 degrees) up to which neighbouring pixels belong to one surface.
_STEEPEST = 5.67
# Above this difference of x/z between neighbouring pixels, windows shrink: one of the same number
# of pixels would rarely cover a single surface.
_COARSE = 0.01
# Largest ratio of the residual variance of a window to that of the smallest windows.
MISFIT = 1.2


@dataclass(frozen=True)
class FineScale:
    """Preparation of views with little noise, or smoothed by the camera, at a finer scale.

    In such views noise is no limit, and the structures that constrain the pose may be small.

    Attributes
    ----------
    noise
        Applies to views whose noise between neighbouring pixels, relative to the depth, is below
        this fraction of the difference of their x/z: then few pixels determine a slope.
    radii, edge_margin, fill
        Replace the fields of `SurfaceOptions`.
    """

    noise: float = 0.3
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
        Pixels within `edge_margin` pixels of a depth edge are excluded from the fits, as they mix
        light of both sides. An edge is a relative difference above `edge_jump`, above that of
        neighbouring pixels on a surface at an incidence of 80 degrees, and above `edge_sigmas`
        times the view's typical noise.
    flatness
        Deviations from a plane below this fraction of the depth are accepted regardless of the
        noise of the view, as cameras may smooth their images.
    fill, offset
        Smallest valid fraction of a window, and largest squared offset of its valid pixels'
        centroid relative to their variance.
    falloff
        Exponent of the cosine to the optical axis by which amplitude falls off towards the corners;
        None to estimate it from the recording.
    range_falloff
        Exponent of the range by which colour (as if lit by a lamp on the camera) or infrared
        images of kind "ir" get darker; None to estimate it from the recording. A single view is
        assumed to be in ambient light, or of a time-of-flight camera.
    fine_scale
        Options for views with hardly any noise.
    """

    columns: int = 320
    radii: tuple[int, ...] = (2, 5)
    edge_jump: float = 0.04
    edge_margin: int = 1
    edge_sigmas: float = 3.0
    flatness: float = 0.002
    fill: float = 0.7
    offset: float = 0.2
    falloff: float | None = None
    range_falloff: float | None = None
    fine_scale: FineScale = FineScale()

    def for_image(self, pitch: float, noise: float = math.inf) -> SurfaceOptions:
        """Return the options for an image with this resolution and noise.

        In coarse images slanted surfaces have larger differences of depth, which are no edges, and
        a window of the same number of pixels spans more surfaces.

        Parameters
        ----------
        pitch
            Difference of x/z between neighbouring pixels.
        noise
            Between neighbouring pixels, relative to the depth.
        """
        fine, options = self.fine_scale, self
        if noise < fine.noise * pitch:
            options = replace(self, radii=fine.radii, edge_margin=fine.edge_margin, fill=fine.fill)
        scale = min(1.0, _COARSE / pitch)
        return replace(
            options,
            edge_jump=max(options.edge_jump, _STEEPEST * pitch),
            radii=tuple(max(k, round(scale * r)) for k, r in enumerate(options.radii, start=1)),
        )


def fitted_planes(
    w: Float32,
    rays: Float32,
    weight: Float32,
    mask: Bool,
    limit: float,
    options: SurfaceOptions,
    chunks: int | None = None,
) -> tuple[Float32, Float32]:
    """Return planes (H, W, 4) and quality (H, W, 2) at the pixels of the mask, see `fit_planes`.

    `chunks` is the number of chunks of rows, `row_chunks` unless given.
    """
    rows, columns = w.shape
    planes = np.empty((rows, columns, 4), np.float32)
    quality = np.empty((rows, columns, 2), np.float32)
    radii = np.array(options.radii, np.int64)

    def fit(start: int, stop: int) -> None:
        fit_planes(
            w, rays, weight, mask, radii, limit, options.fill, options.offset,
            planes, quality, start, stop,
        )  # fmt: skip

    run_chunks(fit, rows, chunks or row_chunks(rows))
    return planes, quality


def edge_pixels(w: Float32, jump: float, margin: int) -> Bool:
    """Return the pixels within `margin` of an invalid pixel or a relative depth step of `jump`.

    Due to the blur of the lens they mix light of both sides.
    """
    return _edge_pixels(w, [np.float32(min(jump, 0.9))] * 2, margin)


def edge_pixels_by_noise(w: Float32, noise: Float32, options: SurfaceOptions) -> Bool:
    """Return `edge_pixels` for the noise (H, W) of each pixel, relative to the depth."""
    limits = []
    for a, b in NEIGHBOURS:
        n, m = noise[a] ** 2, noise[b] ** 2
        # A large change of the noise is an edge between surfaces.
        noise_step = np.float32(options.edge_sigmas) * np.sqrt(
            np.minimum(n + m, 4 * np.minimum(n, m))
        )
        limit = np.maximum(noise_step, np.float32(options.edge_jump))
        limits.append(np.minimum(limit, np.float32(0.9)))
    return _edge_pixels(w, limits, options.edge_margin)


def _edge_pixels(w: Float32, limits: Sequence[Float32 | np.float32], margin: int) -> Bool:
    """Return the pixels near relative steps above the limits between columns and between rows."""
    edge = np.zeros(w.shape, np.uint8)
    for (a, b), limit in zip(NEIGHBOURS, limits, strict=True):
        is_step = np.abs(w[a] - w[b]) > limit * np.maximum(w[a], w[b])
        edge[a] |= is_step
        edge[b] |= is_step
    return dilated(edge, margin)


def dilated(mask: UInt8, margin: int) -> Bool:
    """Return the pixels within `margin`, in rows and columns, of one that is not 0."""
    size = 2 * margin + 1
    return cv2.dilate(mask, np.ones((size, size), np.uint8)) > 0


def pixels_with_plane(z: Float32, options: SurfaceOptions) -> tuple[int, int]:
    """Return the numbers of pixels with enough neighbours for a plane fit, and of valid pixels."""
    missing = (z <= 0).view(np.uint8)
    usable = z > 0
    if options.edge_margin:
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        near_missing = np.asarray(cv2.dilate(missing, cross), np.uint8)
        usable = ~dilated(near_missing, options.edge_margin)
    size = 2 * options.radii[0] + 1
    density = cv2.blur(usable.astype(np.float32), (size, size))
    with_plane = (density >= options.fill) & (z > 0)
    return int(np.count_nonzero(with_plane)), int(np.count_nonzero(z > 0))


def row_chunks(rows: int) -> int:
    """Return the number of chunks of the rows of an image."""
    return max(2, rows // _CHUNK_ROWS)


def stated_sigma(frame: RangeFrame) -> Float32 | None:
    """Return the sigma of z (H, W) that the frame states, m; 0 where unknown."""
    if frame.sigma_image is None:
        return None
    valid = (frame.sigma_image > _MIN_SIGMA) & (frame.sigma_image < _MAX_SIGMA)
    # The stated noise is that of the radial range.
    sigma = np.where(valid, frame.sigma_image / ray_lengths(frame.camera), np.float32(0))
    return np.asarray(sigma, np.float32)


def noise_law(
    frame: RangeFrame, z: Float32, amplitude: Float32 | None, projection: Projection
) -> Float32:
    """Return the sigma of z (H, W) in m up to a factor, by a law of the sensor family."""
    if amplitude is None or frame.amplitude_kind == "ir":
        return np.float32(0.001) + np.float32(0.003) * z * z
    if frame.amplitude_kind == "raw":
        raw = amplitude
    else:
        r2 = z * z * projection.lengths2
        raw = amplitude * inverse(r2, r2 > 0)
    positive = raw[::2, ::2]
    positive = positive[positive > 0]
    if len(positive) == 0:
        return np.float32(0.001) + np.float32(0.003) * z * z
    typical = np.float32(median(positive))
    # A tiny amplitude stands for none, far below the limit of the law.
    law = np.asarray(typical / np.fmax(raw, np.float32(1e-6) * typical), np.float32)
    return np.float32(0.01) * np.clip(law, np.float32(0.15), np.float32(20))


def typical_noise(w: Float32, weight: Float32) -> float:
    """Return the standard deviation of the difference between neighbours, relative to their depth.

    A robust estimate from the median of second differences along a subset of rows.
    """
    rows = np.s_[::4]
    neighbours = [w[rows, k : w.shape[1] - 2 + k] for k in range(3)]
    valid = np.logical_and.reduce([weight[rows, k : w.shape[1] - 2 + k] > 0 for k in range(3)])
    if not valid.any():
        return 0.0
    before, here, after = (values[valid] for values in neighbours)
    second_difference = np.abs(before - 2 * here + after) / here
    # sqrt(6) in a second difference, sqrt(2) in a first one.
    return median(second_difference) / MEDIAN_OF_NORMAL / np.sqrt(3.0)


def noise_scale(w: Float32, rays: Float32, weight: Float32, radius: int) -> float:
    """Estimate the variance scale: median misfit of the smallest windows on a subset of rows."""
    rows, columns = w.shape
    planes = np.empty((rows, columns, 4), np.float32)
    quality = np.empty((rows, columns, 2), np.float32)
    values = []
    valid = weight > 0
    radii = np.array([radius], np.int64)
    for i in range(radius, rows - radius, max(1, rows // 12)):
        fit_planes(w, rays, weight, valid, radii, np.inf, 0.7, 0.2, planes, quality, i, i + 1)
        values.append(quality[i, :, 0])
    misfit = np.concatenate(values) if values else np.zeros(0)
    misfit = misfit[np.isfinite(misfit)]
    if len(misfit) == 0:
        return 1.0
    return min(max(median(misfit), 1e-6), 1e6)


def scale_at(relative: float, z: Float32, sigma: Float32) -> float:
    """Return the variance scale at which a typical pixel's sigma is `relative` times its depth."""
    z, sigma = z[::4, ::4], sigma[::4, ::4]
    valid = (z > 0) & (sigma > 0)
    if not valid.any():
        return 0.0
    return median(relative * z[valid] / sigma[valid]) ** 2


def shared_sigma(frame: RangeFrame, lengths2: Float32) -> Float32 | None:
    """Return the correlated sigma of z (H, W) in m, given the squared ray lengths (H, W)."""
    image = frame.shared_sigma_image
    if image is None:
        return None
    rows, columns = lengths2.shape
    step = image.shape[1] // columns
    # It varies slowly: one pixel per block is enough.
    sampled = image[step // 2 :: step, step // 2 :: step][:rows, :columns]
    valid = np.isfinite(sampled) & (sampled > 0)
    return np.asarray(np.where(valid, sampled, 0) / np.sqrt(lengths2), np.float32)


def with_shared_error(
    variance: Float32, planes: Float32, shared: Float32 | None
) -> tuple[Float32, Float32 | None]:
    """Return `plane_variance` and `pixel_variance` with the shared sigma of z (H, W) in m added."""
    if shared is None:
        return variance, None
    shared_variance = (shared * planes[..., 3] ** 2) ** 2
    return variance + np.float32(_CORRELATED_PIXELS) * shared_variance, variance + shared_variance


def inverse(values: Float32, valid: Bool) -> Float32:
    """Return the reciprocal of each value, 0 where invalid."""
    return np.reciprocal(np.where(valid, values, np.float32(np.inf)))
