"""Texture atlases: rasterisation of triangles, and blending of the views' colours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, UInt8
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel

NO_TRIANGLE = -1


class SeenBy(NamedTuple):
    """A view that is tested for what it sees.

    Attributes
    ----------
    z
        (H, W) z depth of the view, m; 0 where unknown.
    reach
        (H, W) weight of the colour of each pixel: 0 where it is unknown, less at edges.
    lookup, lookup_frame
        Projection of the view's camera, see `project_ray`.
    """

    z: Float32
    reach: Float32
    lookup: Float32
    lookup_frame: Float64


class Pictures(NamedTuple):
    """The colours of a view, in two bands.

    Attributes
    ----------
    fine
        (H, W, 3) uint8, at its recorded resolution.
    coarse
        (h, w, 3) the same scene blurred, subsampled.
    scales
        (2, 2) columns and rows of either per column and row of the depth image.
    gain
        (3,) exposure factor of each channel.
    lookup, lookup_frame
        Projection of the view's camera into the depth image, see `project_ray`.
    """

    fine: UInt8
    coarse: Float32
    scales: Float64
    gain: Float64
    lookup: Float32
    lookup_frame: Float64


class Canvas(NamedTuple):
    """The texture while it is painted.

    Attributes
    ----------
    triangle, barycentric
        (H, W) and (H, W, 2) from `draw_triangles`.
    total, sums
        (H, W) and (H, W, 3) weights, and weighted coarse colours.
    best, detail
        (H, W) largest weight of a view, and (H, W, 3) the fine band of that view.
    """

    triangle: Int32
    barycentric: Float32
    total: Float32
    sums: Float32
    best: Float32
    detail: Float32


@kernel
def draw_triangles(corners: Float32, margin: float, triangle: Int32, barycentric: Float32) -> None:
    """Rasterise triangles: write the triangle and barycentric coordinates of each texel.

    Parameters
    ----------
    corners
        (M, 3, 2) column and row of the corners; texel centres are at integers.
    margin
        Distance in texels up to which texels outside a triangle belong to it, unless they lie in
        another one.
    triangle
        (H, W) of `NO_TRIANGLE`; the index of each texel's triangle is written.
    barycentric
        (H, W, 2) written: barycentric coordinates of the second and third corner, below 0 or above
        1 outside the triangle.
    """
    height, width = triangle.shape
    for m in range(len(corners)):
        ax, ay = corners[m, 0, 0], corners[m, 0, 1]
        bx, by = corners[m, 1, 0] - ax, corners[m, 1, 1] - ay
        cx, cy = corners[m, 2, 0] - ax, corners[m, 2, 1] - ay
        area = bx * cy - by * cx
        if abs(area) < 1e-9:
            continue
        # Distance of a point from an edge: barycentric coordinate times height of the corner.
        height_b = abs(area) / max(np.sqrt(cx * cx + cy * cy), 1e-9)
        height_c = abs(area) / max(np.sqrt(bx * bx + by * by), 1e-9)
        height_a = abs(area) / max(np.sqrt((bx - cx) ** 2 + (by - cy) ** 2), 1e-9)
        left = max(int(np.floor(ax + min(0.0, bx, cx) - margin)), 0)
        right = min(int(np.ceil(ax + max(0.0, bx, cx) + margin)), width - 1)
        top = max(int(np.floor(ay + min(0.0, by, cy) - margin)), 0)
        bottom = min(int(np.ceil(ay + max(0.0, by, cy) + margin)), height - 1)
        for v in range(top, bottom + 1):
            for u in range(left, right + 1):
                x, y = u - ax, v - ay
                b = (x * cy - y * cx) / area
                c = (y * bx - x * by) / area
                outside = max(-b * height_b, -c * height_c, -(1 - b - c) * height_a)
                if outside > margin or (outside > 1e-6 and triangle[v, u] != NO_TRIANGLE):
                    continue
                triangle[v, u] = m
                barycentric[v, u, 0] = b
                barycentric[v, u, 1] = c


@kernel
def weigh_points(
    points: Float32,
    normals: Float32,
    view: SeenBy,
    T_camera_world: Float64,
    tolerance: float,
    tolerance_ratio: float,
    weights: Float32,
    pixels: Float32,
) -> None:
    """Weigh how well a view shows points: near, perpendicular, and far from edges.

    Parameters
    ----------
    points, normals
        (N, 3) in the world.
    view, T_camera_world
        The view and its (4, 4) pose.
    tolerance, tolerance_ratio
        Largest difference between a point's z and the depth around its projection: m, and relative
        to z.
    weights, pixels
        (N,) and (N, 2) written where the point is visible: its weight, column and row in the depth
        image.
    """
    z, reach, lookup, frame = view
    height, width = z.shape
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    for n in range(len(points)):
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2] + t[0]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2] + t[1]
        d = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2] + t[2]
        if d <= projection_kernels.MIN_DEPTH:
            continue
        u, v, i, _ = projection_kernels.project_ray(x / d, y / d, lookup, frame)
        if i < 0 or not (u >= 1 and v >= 1 and u < width - 2 and v < height - 2):
            continue
        length = np.sqrt(x * x + y * y + d * d)
        cosine = 0.0
        for k in range(3):
            to_camera = -(R[0, k] * x + R[1, k] * y + R[2, k] * d) / length
            cosine += to_camera * normals[n, k]
        if cosine < 0.15:
            continue
        # All pixels around it must show this surface: colours mix at edges, and poses have errors.
        iu, iv = int(u), int(v)
        max_dz = tolerance + tolerance_ratio * d
        known = 1.0
        for dv in range(-1, 3):
            for du in range(-1, 3):
                depth = z[iv + dv, iu + du]
                if depth > 0 and depth < d - max_dz:
                    known = 0.0
                if 0 <= dv <= 1 and 0 <= du <= 1:
                    known = min(known, reach[iv + dv, iu + du])
                    if abs(depth - d) > max_dz:
                        known = 0.0
        if known > 0:
            weights[n] = known * (cosine / (length * length)) ** 2
            pixels[n, 0] = u
            pixels[n, 1] = v


@kernel
def paint_triangles(
    triangles: Int32,
    corners: Float32,
    faces: Int32,
    points: Float32,
    weights: Float32,
    view: Pictures,
    T_camera_world: Float64,
    canvas: Canvas,
) -> None:
    """Paint what one view shows of some triangles.

    Parameters
    ----------
    triangles
        (K,) rows of `faces`.
    corners
        (M, 3, 2) of all triangles, as in `draw_triangles`.
    faces, points, weights
        (M, 3) rows of the vertices (N, 3), and their weights (N,) in this view.
    view, T_camera_world
        The view and its (4, 4) pose.
    canvas
        Added to.
    """
    fine, coarse, scales, gain, lookup, frame = view
    triangle, barycentric, total, sums, best, detail = canvas
    height, width = triangle.shape
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    color = np.empty((2, 3), np.float32)
    for m in triangles:
        a, b, c = faces[m]
        wa, wb, wc = weights[a], weights[b], weights[c]
        left = max(int(corners[m, :, 0].min()) - 2, 0)
        right = min(int(corners[m, :, 0].max()) + 3, width - 1)
        top = max(int(corners[m, :, 1].min()) - 2, 0)
        bottom = min(int(corners[m, :, 1].max()) + 3, height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if triangle[row, column] != m:
                    continue
                s, r = barycentric[row, column, 0], barycentric[row, column, 1]
                q = 1 - s - r
                weight = q * wa + s * wb + r * wc
                if weight <= 0:
                    continue
                px = q * points[a, 0] + s * points[b, 0] + r * points[c, 0]
                py = q * points[a, 1] + s * points[b, 1] + r * points[c, 1]
                pz = q * points[a, 2] + s * points[b, 2] + r * points[c, 2]
                d = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
                if d <= projection_kernels.MIN_DEPTH:
                    continue
                x = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]) / d
                y = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]) / d
                u, v, cell, _ = projection_kernels.project_ray(x, y, lookup, frame)
                if cell < 0:
                    continue
                _sample(
                    fine, (u + 0.5) * scales[0, 0] - 0.5, (v + 0.5) * scales[0, 1] - 0.5, color[0]
                )
                _sample(
                    coarse, (u + 0.5) * scales[1, 0] - 0.5, (v + 0.5) * scales[1, 1] - 0.5, color[1]
                )
                total[row, column] += weight
                leads = weight > best[row, column]
                if leads:
                    best[row, column] = weight
                for channel in range(3):
                    sums[row, column, channel] += weight * gain[channel] * color[1, channel]
                    if leads:
                        detail[row, column, channel] = gain[channel] * (
                            color[0, channel] - color[1, channel]
                        )


@kernel
def finish(canvas: Canvas, faces: Int32, unseen: Bool, base: UInt8, image: UInt8) -> None:
    """Write the colours of the texels: painted ones fade into those of vertices that are unseen.

    Parameters
    ----------
    canvas
        The painted texture (H, W).
    faces, unseen, base
        (M, 3) rows of the vertices (N,), whether no view shows them, and their colours (N, 3).
    image
        (H, W, 3) written where there is a triangle.
    """
    triangle, barycentric, total, sums, _, detail = canvas
    for row in range(triangle.shape[0]):
        for column in range(triangle.shape[1]):
            m = triangle[row, column]
            if m < 0:
                continue
            s = min(max(barycentric[row, column, 0], 0.0), 1.0)
            r = min(max(barycentric[row, column, 1], 0.0), 1.0)
            a, b, c = faces[m]
            q = max(1 - s - r, 0.0)
            fade = min(q * unseen[a] + s * unseen[b] + r * unseen[c], 1.0)
            weight = total[row, column]
            if weight <= 0:
                fade = 1.0
            for k in range(3):
                value = q * base[a, k] + s * base[b, k] + r * base[c, k]
                if fade < 1:
                    light = sums[row, column, k] / weight + detail[row, column, k]
                    value = fade * value + (1 - fade) * light
                image[row, column, k] = min(max(int(value + 0.5), 0), 255)


@kernel
def _sample(image: UInt8 | Float32, u: float, v: float, out: Float32) -> None:
    """Interpolate an image (H, W, 3); beyond its border as at the border."""
    height, width = image.shape[:2]
    u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
    i, j = min(int(u), width - 2), min(int(v), height - 2)
    au, av = u - i, v - j
    for k in range(3):
        above = (1 - au) * image[j, i, k] + au * image[j, i + 1, k]
        below = (1 - au) * image[j + 1, i, k] + au * image[j + 1, i + 1, k]
        out[k] = (1 - av) * above + av * below
