"""Planes of the pixels of range images, and the depth edges that are excluded from them.

`z` is an image (H, W) of depths in m, `w` their reciprocals, and `weight` the inverse variances of
these; all are 0 where unknown.
"""

from __future__ import annotations

import cv2
import numpy as np

from tofuse.arrays import Bool, Float32, UInt8
from tofuse.kernels.threads import run_chunks
from tofuse.kernels.view_planes import fit_planes
from tofuse.registration.surface_options import SurfaceOptions

# Rows of a chunk: many, as chunks cost synchronisation and their windows overlap; fixed, so that
# the result does not depend on the number of threads.
_CHUNK_ROWS = 60


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
    edge = np.zeros(w.shape, np.uint8)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        is_step = np.abs(w[a] - w[b]) > np.float32(min(jump, 0.9)) * np.maximum(w[a], w[b])
        edge[a] |= is_step
        edge[b] |= is_step
    return dilated(edge, margin)


def edge_pixels_by_noise(w: Float32, noise: Float32, options: SurfaceOptions) -> Bool:
    """Return `edge_pixels` for the noise (H, W) of each pixel, relative to the depth."""
    edge = np.zeros(w.shape, np.uint8)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        n, m = noise[a] ** 2, noise[b] ** 2
        # A large change of the noise is an edge between surfaces.
        noise_step = np.float32(options.edge_sigmas) * np.sqrt(
            np.minimum(n + m, 4 * np.minimum(n, m))
        )
        limit = np.minimum(np.maximum(noise_step, np.float32(options.edge_jump)), np.float32(0.9))
        is_step = np.abs(w[a] - w[b]) > limit * np.maximum(w[a], w[b])
        edge[a] |= is_step
        edge[b] |= is_step
    return dilated(edge, options.edge_margin)


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
