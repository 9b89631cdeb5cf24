"""Textures: which triangle each texel lies in, and what views see there."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64, Int32
from tofuse.kernels.jit import kernel
from tofuse.kernels.projection import landing

NOBODY = -1


@kernel
def draw_triangles(corners: Float32, margin: float, owner: Int32, places: Float32) -> None:
    """Say of each texel whose it is, and where in its triangle.

    Parameters
    ----------
    corners
        (M, 3, 2) column and row of the corners, centres of texels at whole numbers.
    margin
        Texels so far outside of an edge belong to the triangle too, if to no other.
    owner
        (H, W), filled in: the triangle; what was `NOBODY` before.
    places
        (H, W, 2), filled in: the shares of the second and the third corner, below 0 or above 1
        outside of the triangle.
    """
    height, width = owner.shape
    for m in range(len(corners)):
        ax, ay = corners[m, 0, 0], corners[m, 0, 1]
        bx, by = corners[m, 1, 0] - ax, corners[m, 1, 1] - ay
        cx, cy = corners[m, 2, 0] - ax, corners[m, 2, 1] - ay
        area = bx * cy - by * cx
        if abs(area) < 1e-9:
            continue
        # Distance of a point from an edge is its share times the height over that edge.
        over_b = abs(area) / max(np.sqrt(cx * cx + cy * cy), 1e-9)
        over_c = abs(area) / max(np.sqrt(bx * bx + by * by), 1e-9)
        over_a = abs(area) / max(np.sqrt((bx - cx) ** 2 + (by - cy) ** 2), 1e-9)
        left = max(int(np.floor(ax + min(0.0, bx, cx) - margin)), 0)
        right = min(int(np.ceil(ax + max(0.0, bx, cx) + margin)), width - 1)
        top = max(int(np.floor(ay + min(0.0, by, cy) - margin)), 0)
        bottom = min(int(np.ceil(ay + max(0.0, by, cy) + margin)), height - 1)
        for v in range(top, bottom + 1):
            for u in range(left, right + 1):
                x, y = u - ax, v - ay
                b = (x * cy - y * cx) / area
                c = (y * bx - x * by) / area
                out = max(-b * over_b, -c * over_c, -(1 - b - c) * over_a)
                if out > margin or (out > 1e-6 and owner[v, u] != NOBODY):
                    continue
                owner[v, u] = m
                places[v, u, 0] = b
                places[v, u, 1] = c


@kernel
def see(
    points: Float32,
    normals: Float32,
    T_camera_world: Float64,
    z: Float32,
    image: Float32,
    lookup: Float32,
    frame: Float64,
    slack: float,
    slack_share: float,
    border: float,
    power: float,
    sums: Float32,
    weights: Float32,
    start: int,
    end: int,
) -> None:
    """Add what a view sees at points, where it sees them and nothing else is near.

    Parameters
    ----------
    points, normals
        (N, 3) in the world.
    z
        (H, W) z of what the view sees, m; 0 where unknown.
    image
        (H, W, C), negative where unknown.
    lookup, frame
        See `landing`.
    slack, slack_share
        How far a point may be from what is seen there and beside: m, and as a share of its z.
    border
        Pixels from the border of the image on which it counts less.
    power
        How much the nearest and straightest view counts more than others.
    sums, weights
        (N, C) and (N,), added to.
    start, end
        The points to do.
    """
    height, width = z.shape
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    for n in range(start, end):
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2] + t[0]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2] + t[1]
        d = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2] + t[2]
        if d <= 0.01:
            continue
        u, v, i, _ = landing(x / d, y / d, lookup, frame)
        if i < 0 or not (u >= 1 and v >= 1 and u < width - 2 and v < height - 2):
            continue
        length = np.sqrt(x * x + y * y + d * d)
        facing = 0.0
        for k in range(3):
            toward = -(R[0, k] * x + R[1, k] * y + R[2, k] * d) / length
            facing += toward * normals[n, k]
        if facing < 0.15:
            continue
        # What is seen around must be this surface: light mixes at edges, and poses err.
        iu, iv = int(u), int(v)
        allowed = slack + slack_share * d
        clear = True
        for dv in range(-1, 3):
            for du in range(-1, 3):
                seen = z[iv + dv, iu + du]
                if seen > 0 and seen < d - allowed:
                    clear = False
                inner = 0 <= dv <= 1 and 0 <= du <= 1
                if inner and (abs(seen - d) > allowed or image[iv + dv, iu + du, 0] < 0):
                    clear = False
        if not clear:
            continue
        near = min(u, v, width - 1 - u, height - 1 - v) / border
        weight = min(1.0, near) * (facing / (length * length)) ** power
        au, av = u - iu, v - iv
        for k in range(image.shape[2]):
            above = (1 - au) * image[iv, iu, k] + au * image[iv, iu + 1, k]
            below = (1 - au) * image[iv + 1, iu, k] + au * image[iv + 1, iu + 1, k]
            sums[n, k] += weight * ((1 - av) * above + av * below)
        weights[n] += weight
