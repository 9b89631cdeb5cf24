"""Texture atlases: rasterisation of triangles, and blending of the views' colours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Int32
from tofuse.engine.cameras import projection_kernels
from tofuse.engine.compute import kernel

NO_TRIANGLE = -1


class ColoredView(NamedTuple):
    """A view whose colours are blended.

    Attributes
    ----------
    z
        (H, W) z depth of the view, m; 0 where unknown.
    image
        (H, W, C), negative where unknown.
    lookup, lookup_frame
        Projection of the view's camera, see `project_ray`.
    """

    z: Float32
    image: Float32
    lookup: Float32
    lookup_frame: Float64


class Blending(NamedTuple):
    """Selection and weights of the views that colour a point.

    Attributes
    ----------
    tolerance, tolerance_ratio
        Largest difference between a point's z and the depth around its projection: m, and relative
        to z.
    border
        Width in pixels of the image border in which the weight decreases.
    power
        Exponent of the preference for near and perpendicular views.
    """

    tolerance: float
    tolerance_ratio: float
    border: float
    power: float


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
def add_view(
    points: Float32,
    normals: Float32,
    view: ColoredView,
    T_camera_world: Float64,
    blending: Blending,
    sums: Float32,
    weights: Float32,
    start: int,
    end: int,
) -> None:
    """Add a view's colours at the points that are visible in it.

    Parameters
    ----------
    points, normals
        (N, 3) in the world.
    view, T_camera_world, blending
        The view, its (4, 4) pose, and its selection and weight.
    sums, weights
        (N, C) and (N,), added to.
    start, end
        Range of points.
    """
    z, image, lookup, frame = view
    tolerance, tolerance_ratio, border, power = blending
    height, width = z.shape
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    for n in range(start, end):
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2] + t[0]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2] + t[1]
        d = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2] + t[2]
        if d <= 0.01:
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
        visible = True
        for dv in range(-1, 3):
            for du in range(-1, 3):
                depth = z[iv + dv, iu + du]
                if depth > 0 and depth < d - max_dz:
                    visible = False
                interpolated = 0 <= dv <= 1 and 0 <= du <= 1
                if interpolated and (abs(depth - d) > max_dz or image[iv + dv, iu + du, 0] < 0):
                    visible = False
        if not visible:
            continue
        border_weight = min(u, v, width - 1 - u, height - 1 - v) / border
        weight = min(1.0, border_weight) * (cosine / (length * length)) ** power
        au, av = u - iu, v - iv
        for k in range(image.shape[2]):
            above = (1 - au) * image[iv, iu, k] + au * image[iv, iu + 1, k]
            below = (1 - au) * image[iv + 1, iu, k] + au * image[iv + 1, iu + 1, k]
            sums[n, k] += weight * ((1 - av) * above + av * below)
        weights[n] += weight
