"""Colours for the eye, and images of a surface as it is seen from somewhere."""

from __future__ import annotations

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Intp, UInt8
from tofuse.engine.fusion.atlas_kernels import NO_TRIANGLE, draw_triangles
from tofuse.engine.fusion.cloud import NO_COLOR, has_color
from tofuse.engine.fusion.mesh import Mesh

SAMPLES = 2  # per column and per row of a pixel
_BAND = 64  # rows that are coloured at once, for less memory


def display_colors(colors: UInt8) -> UInt8:
    """Return colours (N, 3) with a neutral grey for unknown ones."""
    shown = colors.copy()
    shown[~has_color(colors)] = NO_COLOR
    return shown


def drawn(
    mesh: Mesh,
    pixels: Float64,
    depths: Float64,
    shown: Bool,
    size: tuple[int, int],
    texture: tuple[Float32, UInt8] | None = None,
) -> tuple[Float32, Float64]:
    """Draw a surface with colours or with a texture, from the farthest triangle to the nearest.

    Parameters
    ----------
    mesh
        The surface.
    pixels, depths
        (V, 2) column and row of the vertices in the image, and (V,) their depths, which are above
        0 for shown triangles.
    shown
        (F,) triangles to draw.
    size
        Width and height of the image.
    texture
        Used instead of the colours of the vertices: their columns and rows (V, 2) in an image
        (H, W, 3).

    Returns
    -------
    The image (H, W, 3), 0 to 255, and the depth (H, W), 0 where no triangle covers a whole pixel.
    """
    width, height = SAMPLES * size[0], SAMPLES * size[1]
    corners, depth = (pixels[mesh.faces] + 0.5) * SAMPLES - 0.5, depths[mesh.faces]
    inside = (corners.max(1) >= 0).all(1) & (corners.min(1) < [width, height]).all(1)
    order = np.flatnonzero(shown & inside)
    order = order[np.argsort(-depth[order].mean(1), kind="stable")]
    owner = np.full((height, width), NO_TRIANGLE, np.int32)
    place = np.zeros((height, width, 2), np.float32)
    draw_triangles(corners[order].astype(np.float32), 0.0, owner, place)
    image = np.zeros((size[1], size[0], 3), np.float32)
    distance = np.zeros((size[1], size[0]))
    for top in range(0, size[1], _BAND):
        band = slice(top, min(top + _BAND, size[1]))
        rows = slice(SAMPLES * band.start, SAMPLES * band.stop)
        covered = owner[rows] != NO_TRIANGLE
        if not covered.any():
            continue
        faces, (b, c) = order[owner[rows][covered]], place[rows][covered].T
        weight = np.stack([1 - b - c, b, c], -1) / depth[faces]  # interpolated in perspective
        far = 1 / weight.sum(-1)
        samples = np.zeros((*covered.shape, 4), np.float32)
        samples[covered, :3] = _colors(mesh, texture, faces, weight * far[:, None])
        samples[covered, 3] = far
        blocks = samples.reshape(-1, SAMPLES, size[0], SAMPLES, 4).mean((1, 3))
        whole = covered.reshape(-1, SAMPLES, size[0], SAMPLES).all((1, 3))
        image[band], distance[band] = blocks[..., :3], np.where(whole, blocks[..., 3], 0.0)
    return image, distance


def _colors(
    mesh: Mesh, texture: tuple[Float32, UInt8] | None, faces: Intp, weight: Float64
) -> Float32:
    """Return the colours (N, 3) in triangles (N,), by the weights (N, 3) of their corners."""
    if texture is not None:
        texel = np.einsum("nk,nki->in", weight, texture[0][mesh.faces[faces]])
        return _sampled(texture[1], texel.astype(np.float32))
    assert mesh.color is not None
    return np.asarray(np.einsum("nk,nki->ni", weight, mesh.color[mesh.faces[faces]]), np.float32)


def _sampled(image: np.ndarray, at: Float32) -> Float32:
    """Interpolate an image at (2, N) columns and rows; in blocks, as OpenCV limits their length."""
    count, side = at.shape[1], 16_384
    rows = -(-count // side)
    u, v = (np.pad(x, (0, rows * side - count)).reshape(rows, side) for x in at)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR).reshape(-1, 3)[:count], np.float32)
