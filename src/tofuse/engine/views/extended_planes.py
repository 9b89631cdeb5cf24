"""More planes of a view than tracking uses.

For fusion: at noisy pixels and at depth edges. For the search with views that are too noisy for
tracking: wide ones with a looser tolerance.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float32, Int32
from tofuse.engine.compute import median
from tofuse.engine.frames import RangeFrame
from tofuse.engine.views.prepared_view import PreparedView
from tofuse.engine.views.view_planes import (
    MISFIT,
    SurfaceOptions,
    edge_pixels_by_noise,
    fitted_planes,
    inverse,
    scale_at,
    shared_sigma,
    with_shared_error,
)
from tofuse.engine.views.view_planes_kernels import extend_planes

_CHUNKS = 4
# Deviation from a plane as a fraction of the depth, and half width of a plane's window as a
# fraction of the image.
_DEVIATION, _WINDOW = 0.01, 0.016

# Pixels whose noise exceeds the typical one by this ratio get planes of their own, if they are at
# least this fraction of a view.
_NOISY_RATIO, _MIN_NOISY = 2.0, 0.02


def with_extended_planes(
    surface: PreparedView, frame: RangeFrame, options: SurfaceOptions
) -> PreparedView:
    """Return the view of `frame` with more planes, for fusion: at noisy pixels and depth edges.

    Tracking does not use these. Existing planes stay; variances are those of
    `PreparedView.with_pixel_variance`.
    """
    surface = surface.with_pixel_variance()
    valid = (surface.z > 0) & (surface.sigma > 0)
    if not valid.any():
        return surface
    w = inverse(surface.z, valid)
    noise = np.where(valid, surface.sigma * w, np.float32(0))
    typical = median(noise[valid])
    options = options.for_image(surface.projection.pitch, float(np.sqrt(2) * typical))
    missing = valid & (surface.planes[..., 3] == 0)
    typical_planes = surface.planes
    if np.count_nonzero(missing & (noise > _NOISY_RATIO * typical)) >= _MIN_NOISY * valid.size:
        surface = _with_planes_at_noisy_pixels(surface, frame, w, noise, missing, options)
        missing = valid & (surface.planes[..., 3] == 0)
    return _with_planes_of_neighbours(surface, typical_planes, w, noise, missing, options)


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
    edge = edge_pixels_by_noise(w, noise, options)
    missing = missing & ~edge
    weight = inverse((noise * w) ** 2, (w > 0) & ~edge)
    limit = MISFIT * max(1.0, scale_at(options.flatness, surface.z, surface.sigma))
    planes, quality = fitted_planes(w, surface.rays, weight, missing, limit, options)
    new = missing & (planes[..., 3] > 0)
    shared = shared_sigma(frame, surface.projection.lengths2)
    variance, pixel_variance = with_shared_error(quality[..., 1], planes, shared)
    return replace(
        surface,
        planes=np.where(new[..., None], planes, surface.planes),
        plane_variance=np.where(
            new, variance if pixel_variance is None else pixel_variance, surface.plane_variance
        ),
    )


def _with_planes_of_neighbours(
    surface: PreparedView,
    typical_planes: Float32,
    w: Float32,
    noise: Float32,
    missing: Bool,
    options: SurfaceOptions,
) -> PreparedView:
    """Return the view with the planes of neighbours at pixels whose depth agrees with these.

    No window fits next to a depth edge, yet the surface extends up to it; a pixel that mixes light
    of both sides agrees with neither plane. Only the `typical_planes` (H, W, 4) of pixels with
    typical noise are extended: dark surfaces are biased by multipath beyond their noise.
    """
    steps, growth = _steps(options.radii[0])
    planes, variance = surface.planes.copy(), surface.plane_variance.copy()
    extend_planes(
        w, noise * w, surface.rays, missing, typical_planes, surface.plane_variance, steps, growth,
        options.edge_jump, planes, variance,
    )  # fmt: skip
    return replace(surface, planes=planes, plane_variance=variance)


@lru_cache(maxsize=8)
def _steps(radius: int) -> tuple[Int32, Float32]:
    """Return offsets to the pixels around one, nearest first, and the growth of variance to them.

    The variance of a plane fitted to a window of this radius grows with the squared distance
    relative to the window's mean square. Offsets reach two pixels beyond the window's radius, as
    pixels on both sides of an edge are excluded.
    """
    reach = radius + 2
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    squares = (offsets**2).sum(1)
    order = np.argsort(squares, kind="stable")[1:]
    growth = 1 + squares[order] / (radius * (radius + 1) / 3)
    return offsets[order].astype(np.int32), growth.astype(np.float32)


def with_rough_planes(view: PreparedView) -> PreparedView:
    """Return the view with wide planes, fitted to median depths, where it has none.

    Tracking uses only planes that match the view's noise. A floor at grazing incidence is noisier,
    but constrains a search.
    """
    z = cv2.medianBlur(view.z, 5)
    z[(view.z <= 0) | (np.abs(z - view.z) > 5 * _DEVIATION * view.z)] = 0
    w = np.divide(1, z, out=np.zeros_like(z), where=z > 0)
    weight = np.divide(1, (_DEVIATION * w) ** 2, out=np.zeros_like(z), where=z > 0)
    options = SurfaceOptions(radii=(max(2, round(_WINDOW * z.shape[1])),), fill=0.7, offset=0.2)
    planes, quality = fitted_planes(w, view.rays, weight, weight > 0, 1.0, options, _CHUNKS)
    has_plane = view.planes[..., 3] > 0
    misfit = quality[..., 0]
    variance: Float32 = quality[..., 1] * np.where(np.isfinite(misfit), misfit, 0)
    return replace(
        view,
        planes=np.where(has_plane[..., None], view.planes, planes),
        plane_variance=np.where(has_plane, view.plane_variance, variance).astype(np.float32),
    )
