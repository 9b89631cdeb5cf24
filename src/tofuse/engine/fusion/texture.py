"""The texture of a surface, blended from the views that observe each point best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, UInt8
from tofuse.engine.cameras import Camera
from tofuse.engine.compute import job_pool, run_all, run_chunks
from tofuse.engine.frames import RangeFrame
from tofuse.engine.fusion.atlas import MARGIN, Atlas, chart_atlas, unwrap
from tofuse.engine.fusion.atlas_kernels import (
    NO_TRIANGLE,
    Canvas,
    Pictures,
    SeenBy,
    draw_triangles,
    finish,
    paint_triangles,
    weigh_points,
)
from tofuse.engine.fusion.cloud import NO_COLOR, grey_of, has_color
from tofuse.engine.fusion.color_alignment import Shown, aligned_poses
from tofuse.engine.fusion.display_surface import TOLERANCE_FRACTION, TOLERANCE_M, reduced, reduction
from tofuse.engine.fusion.drawing import display_colors
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.range_view import albedo
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.views import Projection, projection_of

# Width of the margin in which a view's weight decreases, as a fraction of the image's height; how
# much of it is left at an edge of depth; and pixels next to unknown colour that are not used.
_BORDER, _AT_EDGE, _ERODED = 0.08, 0.03, 2
_COARSE = 96  # pixels of the longer side of the images that are blended widely
_CANDIDATES = 8  # views that paint a triangle
_CHUNKS = 16
_BAND, _REACH = 128, 3  # rows of a texture that are painted at once, and around a triangle
_MAX_SAMPLES = 20_000  # vertices at which exposures are compared
_CHUNK_TEXELS = 1 << 14
# Robust limit of residuals of the log intensity, and iterations.
_ROBUST_LIMIT, _ITERATIONS = 0.15, 4
_MAX_LOG_GAIN = 1.0
# Intensities that are compared: above black, below saturation.
_MIN_INTENSITY, _MAX_INTENSITY = 5.0, 250.0
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
        (V, 3) exposure factor of each view.
    coverage
        Fraction of the area of the surface that views observed; the rest has the colours of the
        vertices.
    detail
        Pixels of the views per vertex of what they observed.
    filled
        Number of the last triangles that fill holes: they look right, but were not measured.
    """

    mesh: Mesh
    atlas: Atlas
    image: UInt8
    gains: Float64
    coverage: float
    detail: float = 0.0
    filled: int = 0

    @property
    def charts(self) -> Mesh:
        """The surface with one vertex per row of the atlas, in the colours of the texture."""
        parts = self.mesh.with_vertices(self.atlas.vertices, self.atlas.faces)
        column, row = np.rint(self.atlas.texels).astype(int).T
        return replace(parts, color=self.image[row, column])


@dataclass(frozen=True, eq=False)
class TextureView:
    """A view prepared for texturing.

    Attributes
    ----------
    z
        (H, W) m, 0 where unknown.
    known
        (H, W) whether the colour of a pixel is known.
    image
        (h, w, 3) uint8 RGB of the same field of view, of any resolution.
    projection
        Projection of points into the image of z.
    """

    z: Float32
    known: Bool
    image: UInt8
    projection: Projection

    @classmethod
    def of(cls, frame: RangeFrame, image: UInt8 | None = None) -> TextureView | None:
        """Take the colour of a frame, by default as it has it, or else its amplitude.

        None if it has neither.
        """
        z = np.nan_to_num(np.asarray(frame.z, np.float32))
        if frame.color_image is not None and frame.color_registered:
            image = frame.color_image if image is None else image
            # Else the colour camera didn't see it.
            red, green, blue = np.moveaxis(frame.color_image, -1, 0)
            known = np.asarray((red | green | blue) > 0, np.bool_)
            return cls._reduced(z, known, np.ascontiguousarray(image), frame.camera)
        light = albedo(frame)
        if light is None:
            return None
        known = np.asarray(light >= 0, np.bool_)
        image = np.zeros((*z.shape, 3), np.uint8)
        image[known] = grey_of(light[known].astype(float))
        return cls._reduced(z, known, image, frame.camera)

    @classmethod
    def _reduced(cls, z: Float32, known: Bool, image: UInt8, camera: Camera) -> TextureView:
        step = reduction(z)
        return cls(reduced(z, step), reduced(known, step), image, projection_of(camera, step))

    @property
    def reach(self) -> Float32:
        """(H, W) weight of each pixel: 0 next to unknown ones, less towards edges."""
        z, border = self.z, max(2.0, _BORDER * len(self.z))
        known = np.pad(self.known, 1).astype(np.uint8)
        inner = cv2.distanceTransform(known, cv2.DIST_L2, 3)[1:-1, 1:-1] - _ERODED
        limit = TOLERANCE_M + TOLERANCE_FRACTION * z
        smooth = np.ones(z.shape, np.uint8)
        smooth[:, 1:] &= np.abs(z[:, 1:] - z[:, :-1]) < limit[:, 1:]
        smooth[1:] &= np.abs(z[1:] - z[:-1]) < limit[1:]
        from_edge = cv2.distanceTransform(smooth, cv2.DIST_L2, 3)
        weight = np.minimum(inner / border, np.maximum(from_edge / border, _AT_EDGE))
        return np.ascontiguousarray(weight.clip(0, 1), np.float32)

    @cached_property
    def small(self) -> UInt8:
        """(H, W, 3) the image at the size of z."""
        if self.image.shape[:2] == self.z.shape:
            return self.image
        size = self.z.shape[::-1]
        return np.asarray(cv2.resize(self.image, size, interpolation=cv2.INTER_AREA), np.uint8)

    @property
    def coarse(self) -> Float32:
        """(h, w, 3) the image, blurred and subsampled; unknown pixels do not darken it."""
        height, width = self.z.shape
        step = max(height, width) / _COARSE
        size = max(2, round(width / step)), max(2, round(height / step))
        known = self.known.astype(np.float32)
        sums = cv2.resize(self.small * known[..., None], size, interpolation=cv2.INTER_AREA)
        share = cv2.resize(known, size, interpolation=cv2.INTER_AREA)[..., None]
        return np.ascontiguousarray(sums / np.maximum(share, 1e-3), np.float32)


def textured(mesh: Mesh, views: Sequence[TextureView], poses: Float64, size: int) -> Textured:
    """Texture a surface with the views.

    Charts are connected triangles that one view shows best, as they appear in it, so that the
    texture has the resolution of the images. A texel has the fine details of the best view, and a
    weighted mean of the coarse colours of all candidates (two bands; Burt and Adelson 1983), with
    equalised exposures, so that no seams are visible.

    Parameters
    ----------
    mesh
        With faces.
    views
        With colour or with amplitude, at least one.
    poses
        (V, 4, 4) T_world_camera.
    size
        Maximum edge of the texture.
    """
    seen = _Seen.of(mesh, views, poses)
    candidates, label = seen.candidates(mesh.faces)
    whole = label >= 0
    pixels = seen.image_pixels(label, mesh.faces)
    observed = max(int((seen.weights > 0).any(0).sum()), 1)
    detail = float(_areas(pixels[whole]).sum()) / observed
    label[~whole], pixels[~whole] = _flattened(mesh, ~whole)
    # The layout needs neither the corrected poses nor the exposures.
    with job_pool(1, "tofuse-atlas") as background:
        laid_out = background.submit(chart_atlas, mesh.faces, label, pixels, size)
        seen = seen.aligned(mesh)
        gains = seen.exposures()
        atlas = laid_out.result()
    image = _painted(mesh, seen, gains, candidates, atlas)
    area = _areas(mesh.vertices[mesh.faces])
    share = float(area[whole].sum() / max(area.sum(), 1e-30))
    return Textured(mesh, atlas, image, gains, share, detail)


def _areas(corners: NDArray[np.generic]) -> Float64:
    """Return the areas (M,) of triangles (M, 3, 2) or (M, 3, 3)."""
    a, b = (corners[:, k].astype(float) - corners[:, 0] for k in (1, 2))
    squared = (a * a).sum(1) * (b * b).sum(1) - (a * b).sum(1) ** 2
    return np.asarray(np.sqrt(np.maximum(squared, 0)) / 2, np.float64)


def _flattened(mesh: Mesh, faces: Bool) -> tuple[Int32, Float32]:
    """Return labels (K,) and texels (K, 3, 2) of triangles without a view.

    Seen along the axis that they face, -1 to -6, one texel per vertex: they have no fine colours.
    """
    corners = mesh.faces[faces]
    normal = mesh.normals[corners].sum(1)
    axis = np.abs(normal).argmax(1)
    positive = np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0
    plane = np.array([[1, 2], [2, 0], [0, 1]])[axis]
    p = mesh.vertices[corners] / max(mesh.spacing, 1e-9)
    texels = np.take_along_axis(p, plane[:, None], 2)
    return (-1 - axis - 3 * positive).astype(np.int32), texels.astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Which views show the vertices of a mesh.

    Attributes
    ----------
    views, poses
        As for `textured`.
    weights
        (V, N) how well each view shows each vertex; 0 where it does not.
    pixels
        (V, N, 2) column and row in the view's image of z.
    """

    views: Sequence[TextureView]
    poses: Float64
    weights: Float32
    pixels: Float32

    @classmethod
    def of(cls, mesh: Mesh, views: Sequence[TextureView], poses: Float64) -> _Seen:
        weights = np.zeros((len(views), len(mesh)), np.float32)
        pixels = np.zeros((len(views), len(mesh), 2), np.float32)
        points, normals = (np.ascontiguousarray(v) for v in (mesh.vertices, mesh.normals))

        def weigh(k: int, T_camera_world: Float64) -> None:
            view = views[k]
            tested = SeenBy(view.z, view.reach, view.projection.lookup, view.projection.frame)
            limits = (TOLERANCE_M, TOLERANCE_FRACTION)
            weigh_points(points, normals, tested, T_camera_world, *limits, weights[k], pixels[k])

        run_all([partial(weigh, k, T) for k, T in enumerate(se3.inverse(poses))])
        return cls(views, poses, weights, pixels)

    def aligned(self, mesh: Mesh) -> _Seen:
        """Correct the poses so that the images agree; what they show of the surface stays."""
        if len(self.views) < 2:
            return self
        shown = [
            Shown(view.image, view.projection, weights > 0, pixels)
            for view, weights, pixels in zip(self.views, self.weights, self.pixels, strict=True)
        ]
        return replace(self, poses=aligned_poses(mesh.vertices, self.poses, shown))

    def exposures(self) -> Float64:
        """Return exposure factors (V, 3) of the channels of the views.

        Robust least squares of the differences between the log intensities of all pairs of views
        of a point (Brown and Lowe 2007, section 6). The mean of the logarithms of the factors
        is 0.
        """
        step = max(1, -(-self.weights.shape[1] // _MAX_SAMPLES))
        weights = (self.weights[:, ::step] > 0).astype(float)
        colors = np.zeros((*weights.shape, 3), np.float32)
        for view, pixels, color in zip(self.views, self.pixels[:, ::step], colors, strict=True):
            u, v = pixels.T[:, None]
            sampled = cv2.remap(view.small.astype(np.float32), u, v, cv2.INTER_LINEAR)
            color[:] = sampled.reshape(-1, 3)
        weights *= ((colors > _MIN_INTENSITY) & (colors < _MAX_INTENSITY)).all(-1)
        logs = np.log(np.maximum(colors, np.float32(_MIN_INTENSITY)))
        return np.stack([_gains(logs[..., c].astype(float), weights) for c in range(3)], -1)

    def candidates(self, faces: Int32) -> tuple[Int32, Int32]:
        """Return the best views (M, K) of each triangle, best first, and the best whole one (M,).

        -1 where there is none: a view may show a triangle in part, but a whole one is needed to lay
        out the triangle as it appears there.
        """
        count = min(_CANDIDATES, len(self.views))
        ranked = np.empty((len(faces), count), np.int32)
        label = np.empty(len(faces), np.int32)

        def rank(a: int, b: int) -> None:
            corners = self.weights[:, faces[a:b]]
            score, whole = corners.sum(-1), (corners > 0).all(-1)
            # Whole ones first, then the others; both by their score.
            key = np.where(whole, -score, 1 / np.maximum(score, np.float32(1e-30)))
            best = np.argsort(key, axis=0, kind="stable")[:count]
            shown = np.take_along_axis(score, best, 0) > 0
            ranked[a:b] = np.where(shown, best, -1).T
            label[a:b] = np.where(np.take_along_axis(whole, best[:1], 0)[0], best[0], -1)

        run_chunks(rank, len(faces), _CHUNKS)
        return ranked, label

    def image_pixels(self, label: Int32, faces: Int32) -> Float32:
        """Return where corners (M, 3, 2) are in the images of the triangles' labels (M,)."""
        out = np.zeros((*faces.shape, 2), np.float32)
        for k, view in enumerate(self.views):
            own = label == k
            out[own] = (self.pixels[k][faces[own]] + 0.5) * _scale(view.image, view.z) - 0.5
        return out


def _scale(image: NDArray[np.generic], z: Float32) -> Float64:
    """Columns and rows (2,) of an image per column and row of a depth image."""
    return np.array([image.shape[1] / z.shape[1], image.shape[0] / z.shape[0]])


def _painted(mesh: Mesh, seen: _Seen, gains: Float64, candidates: Int32, atlas: Atlas) -> UInt8:
    """Return the image (S, S, 3) of a texture.

    It is painted in bands of rows, as a canvas has ten times the size of the image.
    """
    image = np.zeros((atlas.size, atlas.size, 3), np.uint8)
    owned = np.zeros(image.shape[:2], np.bool_)
    all_corners = atlas.texels[atlas.faces]
    top, bottom = all_corners[..., 1].min(1) - _REACH, all_corners[..., 1].max(1) + _REACH
    points, T_camera_world = np.ascontiguousarray(mesh.vertices), se3.inverse(seen.poses)
    unseen = np.asarray(~(seen.weights > 0).any(0), np.bool_)
    base = _base_colors(mesh)

    def pictures(k: int) -> Pictures:
        view = seen.views[k]
        coarse, lens = view.coarse, view.projection
        scales = np.stack([_scale(view.image, view.z), _scale(coarse, view.z)])
        return Pictures(view.image, coarse, scales, gains[k], lens.lookup, lens.frame)

    of_views = run_all([partial(pictures, k) for k in range(len(seen.views))])

    def paint(first: int, last: int) -> None:
        rows = np.flatnonzero((bottom >= first) & (top < last))
        corners, faces = all_corners[rows] - np.array([0, first], np.float32), mesh.faces[rows]
        shape = (last - first, atlas.size)
        owner = np.full(shape, NO_TRIANGLE, np.int32)
        sums = (np.zeros((*shape, *more), np.float32) for more in ((2,), (), (3,), (), (3,)))
        canvas = Canvas(owner, *sums)
        draw_triangles(corners, MARGIN, owner, canvas.barycentric)
        views = candidates[rows]
        order = np.argsort(views, axis=None, kind="stable")
        bounds = np.searchsorted(views.ravel()[order], np.arange(len(of_views) + 1))
        for k, picture in enumerate(of_views):
            triangles = (order[bounds[k] : bounds[k + 1]] // views.shape[1]).astype(np.int32)
            scene = (corners, faces, points, seen.weights[k], picture, T_camera_world[k], canvas)
            paint_triangles(triangles, *scene)
        finish(canvas, faces, unseen, base, image[first:last])
        owned[first:last] = owner != NO_TRIANGLE

    run_chunks(paint, atlas.size, -(-atlas.size // _BAND))
    return _filled(image, owned)


def _base_colors(mesh: Mesh) -> UInt8:
    """Return colours (N, 3) of vertices, for what no view shows."""
    if mesh.color is None:
        return np.full((len(mesh), 3), NO_COLOR, np.uint8)
    return display_colors(mesh.color)


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
    texels = _Texels.of(decimated, unwrap(decimated, size))
    if decimated is mesh:
        colors = texels.at_texels(display_colors(mesh.color))
    else:
        points = texels.at_texels(decimated.vertices)
        nearest, distance2 = KdTree(mesh.vertices).neighbours(points, _NEIGHBOURS)
        normals = texels.at_texels(decimated.normals)
        facing = np.einsum("nki,ni->nk", mesh.normals[nearest], normals) > 0
        facing |= ~facing.any(1, keepdims=True)
        closest = distance2.min(1, keepdims=True)
        weights = np.where((nearest >= 0) & facing, 1 / (distance2 + closest + 1e-12), 0)
        colored_weights = weights * has_color(mesh.color)[nearest]
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
    corners, barycentric
        (K, 3) rows of the vertices of their triangles, and (K, 2) places in these.
    """

    atlas: Atlas
    mask: Bool
    corners: Int32
    barycentric: Float32

    @classmethod
    def of(cls, mesh: Mesh, atlas: Atlas) -> _Texels:
        owner, coordinates = atlas.drawn()
        mask = owner != NO_TRIANGLE
        return cls(atlas, mask, atlas.vertices[atlas.faces[owner[mask]]], coordinates[mask])

    def at_texels(self, values: NDArray[np.generic]) -> Float32:
        """Interpolate values of the vertices (N, C) at the texels (K, C)."""
        return _interpolated(values, self.corners, self.barycentric)

    def filled(self, colors: UInt8) -> UInt8:
        """Return the image (size, size, 3) of the colours (K, 3), without empty texels."""
        image = np.zeros((*self.mask.shape, 3), np.uint8)
        image[self.mask] = colors
        return _filled(image, self.mask)


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


def _filled(image: UInt8, mask: Bool) -> UInt8:
    """Fill empty texels, which are 0, with the colours around them: none bleeds into charts.

    From coarser to finer levels (pull and push; Gortler et al. 1996).
    """
    if mask.all() or not mask.any():
        return image
    weights: list[Float32] = []
    levels: list[NDArray[np.floating]] = []
    sums, weight = _halved(image, mask)
    while True:
        levels.append(sums / np.maximum(weight, 1e-6)[..., None])
        weight = np.minimum(weight * 4, np.float32(1))
        weights.append(weight)
        if max(weight.shape) == 1:
            break
        color = np.asarray(levels[-1] * weight[..., None], np.float32)
        size = _half(weight.shape)
        sums = np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.float32)
        weight = np.asarray(cv2.resize(weight, size, interpolation=cv2.INTER_AREA), np.float32)
    fill = levels.pop()
    for level, weight in zip(levels[::-1], weights[-2::-1], strict=True):
        fill = np.asarray(cv2.resize(fill, weight.shape[::-1]), np.float32).reshape(level.shape)
        fill += weight[..., None] * (level - fill)
    smooth = cv2.resize(np.round(fill.clip(0, 255)).astype(np.uint8), mask.shape[::-1])
    return np.asarray(cv2.copyTo(image, mask.astype(np.uint8), smooth), np.uint8)


def _half(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return width and height of half an image of a shape (H, W)."""
    return max(1, -(-shape[1] // 2)), max(1, -(-shape[0] // 2))


def _halved(image: UInt8, mask: Bool) -> tuple[Float32, Float32]:
    """Return an image and its mask at half the size.

    In bands of rows, so that the image is never in memory as floating-point numbers.
    """
    width, height = _half(mask.shape)
    sums, weight = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)

    def band(a: int, b: int) -> None:
        for full, half in ((image, sums), (mask, weight)):
            rows = full[2 * a : 2 * b].astype(np.float32)
            half[a:b] = cv2.resize(rows, (width, b - a), interpolation=cv2.INTER_AREA)

    # Rows of an odd number are not halved in pairs.
    run_chunks(band, height, _CHUNKS if mask.shape[0] % 2 == 0 else 1)
    return sums, weight
