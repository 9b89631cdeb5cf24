"""The texture of a surface, blended from the views that observe each point best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, UInt8
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.compute import run_chunks
from tofuse.engine.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.fusion.atlas import MARGIN, Atlas, unwrap
from tofuse.engine.fusion.atlas_kernels import (
    NO_TRIANGLE,
    Blending,
    ColoredView,
    add_view,
    draw_triangles,
)
from tofuse.engine.fusion.cloud import NO_COLOR, display_colors, grey_of, has_color
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.views import Projection

# Depth tolerance of the visibility test: m, plus a fraction of the depth.
_TOLERANCE_M, _TOLERANCE_FRACTION = 0.02, 0.02
_BORDER = 0.08  # margin that is blended out, as a fraction of the image's height
# Exponent of the weights, by which the best view dominates.
_WEIGHT_EXPONENT = 4.0
_CHUNKS = 16
_MAX_SAMPLES = 20_000  # vertices at which exposures are compared
_CHUNK_TEXELS = 1 << 14
# Robust limit of residuals of the log intensity, and iterations.
_ROBUST_LIMIT, _ITERATIONS = 0.15, 4
_MAX_LOG_GAIN = 1.0
# Minimum intensity that is compared, as a fraction of the maximum.
_MIN_INTENSITY = 0.02
# For colours of vertices: texels per vertex, vertices that a texel interpolates, minimum size.
_TEXELS_PER_VERTEX, _NEIGHBOURS, _MIN_SIZE = 2.0, 4, 64


@dataclass(frozen=True, eq=False)
class Textured:
    """A surface with a texture.

    Attributes
    ----------
    mesh
        The surface.
    atlas
        The layout of its triangles.
    image
        (H, W, 3) uint8 RGB.
    gains
        (V, C) exposure factor of each view.
    coverage
        Fraction of the texture that views observed; the rest has the colours of the vertices.
    """

    mesh: Mesh
    atlas: Atlas
    image: UInt8
    gains: Float64
    coverage: float


@dataclass(frozen=True, eq=False)
class TextureView:
    """A view prepared for texturing.

    Attributes
    ----------
    z
        (H, W) m, 0 where unknown.
    intensity
        (H, W, 3) RGB, or (H, W, 1) albedo in counts times m^2; negative where unknown.
    projection
        Projection of points into the image.
    """

    z: Float32
    intensity: Float32
    projection: Projection

    @classmethod
    def of(cls, frame: RangeFrame) -> TextureView | None:
        """Take the colour of a frame, or its amplitude; None if it has neither."""
        z = np.asarray(frame.z, np.float32)
        projection = Projection.of(frame.camera, 1)
        if frame.color_image is not None:
            intensity = frame.color_image.astype(np.float32)
            intensity[~frame.color_image.any(-1)] = -1  # the colour camera didn't see it
            return cls(z, np.ascontiguousarray(intensity), projection)
        if frame.amplitude_image is None:
            return None
        amplitude = frame.amplitude_image
        unknown = ~(amplitude > 0) | (amplitude >= SATURATED_AMPLITUDE) | (z <= 0)
        if frame.amplitude_kind != "range_compensated":
            amplitude = amplitude * np.square(z * ray_lengths(frame.camera))
        intensity = np.where(unknown, -1, np.nan_to_num(amplitude)).astype(np.float32)
        return cls(z, np.ascontiguousarray(intensity[..., None]), projection)


def textured(mesh: Mesh, views: Sequence[TextureView], poses: Float64, size: int) -> Textured:
    """Texture a surface with the views.

    Each texel is the weighted mean of the views that observe it; close views with a small angle of
    incidence dominate. Exposures are equalised beforehand.

    Parameters
    ----------
    mesh
        With faces.
    views
        With colour or with amplitude, at least one.
    poses
        (V, 4, 4) T_world_camera.
    size
        Edge of the texture.
    """
    texels = _Texels.of(mesh, size)
    points, normals = texels.points, texels.normals
    gains = exposures(mesh, views, poses)
    channels = views[0].intensity.shape[2]
    sums = np.zeros((len(points), channels), np.float32)
    weights = np.zeros(len(points), np.float32)
    for view, T, gain in zip(views, poses, gains, strict=True):
        _accumulate(view, T, points, normals, sums, weights, gain)
    observed = weights > 0
    intensity = sums[observed] / weights[observed, None]
    if channels == 3:
        rgb = np.round(intensity.clip(0, 255)).astype(np.uint8)
    else:
        rgb = grey_of(intensity[:, 0].astype(float))
    colors = np.empty((len(points), 3), np.uint8)
    colors[observed] = rgb
    colors[~observed] = NO_COLOR
    if mesh.color is not None:
        vertex_colors = texels.at_texels(display_colors(mesh.color), ~observed)
        colors[~observed] = np.round(vertex_colors.clip(0, 255)).astype(np.uint8)
    fraction = float(observed.mean()) if len(observed) else 0.0
    return Textured(mesh, texels.atlas, texels.filled(colors), gains, fraction)


def baked(mesh: Mesh, faces: int, size: int) -> Textured:
    """Decimate a surface, and bake the colours of all its vertices into a texture.

    Each texel is the distance-weighted mean of the four nearest vertices on the same side of the
    surface. A texture keeps more colours than a decimated surface has vertices, and unlike colours
    of vertices all programs display it equally.

    Parameters
    ----------
    mesh
        With faces and colours.
    faces
        Maximum number of triangles.
    size
        Maximum edge of the texture, in texels; smaller for fewer vertices.
    """
    assert mesh.color is not None
    decimated = mesh.decimated(faces)
    size = int(np.clip(np.ceil(np.sqrt(_TEXELS_PER_VERTEX * len(mesh))), _MIN_SIZE, size))
    texels = _Texels.of(decimated, size)
    if decimated is mesh:
        colors = texels.at_texels(display_colors(mesh.color))
    else:
        nearest, distance2 = KdTree(mesh.vertices).neighbours(texels.points, _NEIGHBOURS)
        facing = np.einsum("nki,ni->nk", mesh.normals[nearest], texels.normals) > 0
        facing |= ~facing.any(1, keepdims=True)
        closest = distance2.min(1, keepdims=True)
        weights = np.where((nearest >= 0) & facing, 1 / (distance2 + closest + 1e-12), 0)
        colored = has_color(mesh.color)
        colored_weights = weights * colored[nearest]
        weights = np.where(colored_weights.any(1, keepdims=True), colored_weights, weights)
        colors = np.einsum("nk,nki->ni", weights, display_colors(mesh.color)[nearest].astype(float))
        colors /= weights.sum(1, keepdims=True)
    image = texels.filled(np.round(colors.clip(0, 255)).astype(np.uint8))
    return Textured(decimated, texels.atlas, image, np.zeros((0, 3)), 0.0)


@dataclass(frozen=True, eq=False)
class _Texels:
    """The texels on the triangles of a mesh.

    Attributes
    ----------
    mask
        (size, size) True at these texels; there are K.
    points, normals
        (K, 3) of the surface at these texels.
    """

    atlas: Atlas
    mask: Bool
    corners: Int32
    barycentric: Float32
    points: Float32
    normals: Float32

    @classmethod
    def of(cls, mesh: Mesh, size: int) -> _Texels:
        atlas = unwrap(mesh, size)
        owner = np.full((atlas.size, atlas.size), NO_TRIANGLE, np.int32)
        coordinates = np.zeros((atlas.size, atlas.size, 2), np.float32)
        draw_triangles(atlas.texels[atlas.faces], MARGIN, owner, coordinates)
        mask = owner != NO_TRIANGLE
        corners = atlas.vertices[atlas.faces[owner[mask]]]
        barycentric = coordinates[mask]
        points = _interpolated(mesh.vertices, corners, barycentric)
        normals = _interpolated(mesh.normals, corners, barycentric)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        return cls(atlas, mask, corners, barycentric, points, normals)

    def at_texels(self, values: NDArray[np.generic], where: Bool | None = None) -> Float32:
        """Interpolate values of the vertices (N, C) at the texels (K, C), or at a subset."""
        if where is None:
            return _interpolated(values, self.corners, self.barycentric)
        return _interpolated(values, self.corners[where], self.barycentric[where])

    def filled(self, colors: UInt8) -> UInt8:
        """Return the image (size, size, 3) of the colours (K, 3), without empty texels."""
        image = np.zeros((*self.mask.shape, 3), np.uint8)
        image[self.mask] = colors
        return _dilate_colors(image, self.mask)


def _interpolated(values: NDArray[np.generic], corners: Int32, barycentric: Float32) -> Float32:
    out = np.empty((len(corners), values.shape[1]), np.float32)
    # In chunks, as allocating large temporaries takes longer than the sums.
    for start in range(0, len(out), _CHUNK_TEXELS):
        rows = slice(start, start + _CHUNK_TEXELS)
        b, c = barycentric[rows].T[:, :, None]
        corner_values = values[corners[rows]].astype(np.float32)
        out[rows] = (
            corner_values[:, 0] * (1 - b - c) + corner_values[:, 1] * b + corner_values[:, 2] * c
        )
    return out


def exposures(mesh: Mesh, views: Sequence[TextureView], poses: Float64) -> Float64:
    """Return exposure factors (V, C) of the views at their poses (V, 4, 4).

    Robust least squares of the differences between the log intensities of all pairs of views of a
    point. The mean of the logarithms of the factors is 0.
    """
    step = max(1, len(mesh) // _MAX_SAMPLES)
    points = np.ascontiguousarray(mesh.vertices[::step])
    normals = np.ascontiguousarray(mesh.normals[::step])
    count, channels = len(views), views[0].intensity.shape[2]
    logs = np.zeros((count, len(points), channels))
    weights = np.zeros((count, len(points)))
    max_intensity = max(float(np.percentile(view.intensity, 99)) for view in views)
    for k, (view, T) in enumerate(zip(views, poses, strict=True)):
        sums, weight = (
            np.zeros((len(points), channels), np.float32),
            np.zeros(len(points), np.float32),
        )
        _accumulate(view, T, points, normals, sums, weight, np.ones(channels))
        observed = weight > 0
        intensity = sums[observed] / weight[observed, None]
        # Nearly black or saturated intensities are not compared.
        usable = (intensity > _MIN_INTENSITY * max_intensity).all(1) & (
            (intensity < 250).all(1) if channels == 3 else True
        )
        logs[k, observed] = np.log(np.maximum(intensity, _MIN_INTENSITY * max_intensity))
        weights[k, observed] = usable
    return np.stack([_gains(logs[..., c], weights) for c in range(channels)], -1)


def _gains(logs: Float64, weights: Float64) -> Float64:
    """Return factors (V,) for log intensities (V, N) with weights (V, N)."""
    gain = np.zeros(len(logs))
    w = weights
    for _ in range(_ITERATIONS):
        total = np.maximum(w.sum(0), 1e-9)
        mean = (w * logs).sum(0) / total
        # Normal equations of the views, with the intensities of the points eliminated.
        A = np.diag(w.sum(1)) - (w / total) @ w.T
        b = (w * (mean - logs)).sum(1)
        A += np.eye(len(A)) * (1e-3 * max(np.trace(A) / len(A), 1.0)) + 1e-3
        gain = np.linalg.solve(A, b)
        gain -= gain.mean()
        fitted = logs + gain[:, None]
        residuals = np.abs(fitted - (w * fitted).sum(0) / total)
        w = weights * np.minimum(1, _ROBUST_LIMIT / np.maximum(residuals, 1e-9))
    return np.asarray(np.exp(gain.clip(-_MAX_LOG_GAIN, _MAX_LOG_GAIN)), np.float64)


def _accumulate(
    view: TextureView,
    T_world_camera: Float64,
    points: Float32,
    normals: Float32,
    sums: Float32,
    weights: Float32,
    gain: Float64,
) -> None:
    intensity = np.where(
        view.intensity < 0, view.intensity, view.intensity * gain.astype(np.float32)
    )
    T = se3.inverse(T_world_camera)
    border = max(2.0, _BORDER * view.z.shape[0])
    colored_view = ColoredView(view.z, intensity, view.projection.lookup, view.projection.frame)
    blending = Blending(_TOLERANCE_M, _TOLERANCE_FRACTION, border, _WEIGHT_EXPONENT)
    run_chunks(
        lambda a, b: add_view(points, normals, colored_view, T, blending, sums, weights, a, b),
        len(points),
        _CHUNKS,
    )


def _dilate_colors(image: UInt8, mask: Bool) -> UInt8:
    """Fill empty texels with the nearest colour, so that mipmaps don't darken."""
    if mask.all() or not mask.any():
        return image
    _, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    label_colors = np.zeros((int(labels.max()) + 1, 3), np.uint8)
    label_colors[labels[mask]] = image[mask]
    return label_colors[labels]
