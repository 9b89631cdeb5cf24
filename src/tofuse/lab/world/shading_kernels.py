"""Procedural albedo, evaluated at points on surfaces: continuous, and determined by the seed.

The noise is value noise on a lattice (Perlin 1985, with values instead of gradients), band-limited
by its finest octave, so that a camera's pixels can resolve it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Float32, Float64, Int32
from tofuse.engine.compute import kernel

PLAIN, NOISE, WOOD, TILES, PRINT, SPECKLE = 0, 1, 2, 3, 4, 5

# Columns of a row of texture parameters.
ALBEDO, CONTRAST, SCALE, KIND, GLOSS, OFFSET, COLUMNS = 0, 1, 2, 5, 6, 7, 10
LATTICE = 256


class Triangles(NamedTuple):
    """Triangles of a body, in the order of the leaves.

    Attributes
    ----------
    corner_normals, face_normals
        (F, 9) and (F, 3).
    surface
        (F,) of each triangle.
    """

    corner_normals: Float64
    face_normals: Float64
    surface: Int32


class Textures(NamedTuple):
    """Texture parameters (S, COLUMNS) of all surfaces; `order` and `values` as in `value_noise`."""

    rows: Float64
    order: Int32
    values: Float64


class Rays(NamedTuple):
    """Rays in a body's frame, and their hits.

    Attributes
    ----------
    origins, directions
        (1 or N, 3) and (N, 3).
    distance, face, weights
        (N,), (N,) and (N, 2) from `cast_rays`.
    """

    origins: Float64
    directions: Float64
    distance: Float64
    face: Int32
    weights: Float64


class Shading(NamedTuple):
    """Surface properties where N rays hit.

    Attributes
    ----------
    normal
        (N, 3) in the room's frame, facing the origin of the ray.
    albedo, gloss, surface
        (N,) each.
    """

    normal: Float32
    albedo: Float32
    gloss: Float32
    surface: Int32


@kernel
def value_noise(order: Int32, values: Float64, x: float, y: float, z: float) -> float:
    """Smooth noise with unit variance at the lattice points, cells of size 1, period 256 cells.

    `order` (256,) is a permutation of 0 to 255, `values` (256,) the noise on the lattice.
    """
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    ux, uy, uz = x - fx, y - fy, z - fz
    wx = ux * ux * (3.0 - 2.0 * ux)
    wy = uy * uy * (3.0 - 2.0 * uy)
    wz = uz * uz * (3.0 - 2.0 * uz)
    x0, y0, z0 = int(fx), int(fy), int(fz)
    a0, a1 = order[x0 & 255], order[(x0 + 1) & 255]
    b00, b01 = order[(a0 + y0) & 255] + z0, order[(a0 + y0 + 1) & 255] + z0
    b10, b11 = order[(a1 + y0) & 255] + z0, order[(a1 + y0 + 1) & 255] + z0
    c00 = values[order[b00 & 255]] * (1.0 - wz) + values[order[(b00 + 1) & 255]] * wz
    c01 = values[order[b01 & 255]] * (1.0 - wz) + values[order[(b01 + 1) & 255]] * wz
    c10 = values[order[b10 & 255]] * (1.0 - wz) + values[order[(b10 + 1) & 255]] * wz
    c11 = values[order[b11 & 255]] * (1.0 - wz) + values[order[(b11 + 1) & 255]] * wz
    return (c00 * (1.0 - wy) + c01 * wy) * (1.0 - wx) + (c10 * (1.0 - wy) + c11 * wy) * wx


@kernel
def fractal_noise(order: Int32, values: Float64, x: float, y: float, z: float) -> float:
    """Three octaves of `value_noise`, with nearly unit variance averaged over a surface.

    Each octave is rotated differently: surfaces along the axes would show the lattice.
    """
    a = (2.0 * x + 2.0 * y - z) / 3.0
    b = (2.0 * z - x + 2.0 * y) / 3.0
    c = (2.0 * x - y + 2.0 * z) / 3.0
    total = value_noise(order, values, a, b, c)
    a, b, c = 0.6 * a - 0.8 * b, 0.8 * a + 0.6 * b, c
    total += 0.7 * value_noise(order, values, 2.13 * a + 31.7, 2.13 * b + 11.3, 2.13 * c + 47.1)
    b, c = 0.6 * b - 0.8 * c, 0.8 * b + 0.6 * c
    total += 0.5 * value_noise(order, values, 4.31 * a + 7.9, 4.31 * b + 53.9, 4.31 * c + 19.3)
    return 1.3 * total


@kernel
def pattern_at(order: Int32, values: Float64, row: Float64, x: float, y: float, z: float) -> float:
    """Pattern of a surface at a point of its body: mean near 0, standard deviation near 1."""
    kind = int(row[KIND])
    if kind == PLAIN:
        return 0.0
    u = (x + row[OFFSET]) / row[SCALE]
    v = (y + row[OFFSET + 1]) / row[SCALE + 1]
    w = (z + row[OFFSET + 2]) / row[SCALE + 2]
    if kind == WOOD:
        warp = value_noise(order, values, 0.4 * u, 0.4 * v, 0.4 * w)
        rings = np.sin(6.2831853 * 0.35 * (u + v + w) + 4.0 * warp)
        return 0.9 * rings + 0.7 * value_noise(order, values, u, v, w)
    if kind == TILES:
        # Joints between square tiles, with soft edges; each tile has its own tone.
        joint = 0.0
        for k in range(3):
            q = u if k == 0 else (v if k == 1 else w)
            offset = abs(q - np.floor(q) - 0.5)
            s = min(max((offset - 0.44) / 0.04, 0.0), 1.0)
            joint = max(joint, s * s * (3.0 - 2.0 * s))
        tone = values[(int(np.floor(u)) * 7 + int(np.floor(v)) * 57 + int(np.floor(w))) & 255]
        return (0.6 * tone + 0.3) * (1.0 - joint) - 2.0 * joint
    if kind == PRINT:
        return 1.1 * np.tanh(2.2 * fractal_noise(order, values, u, v, w))
    if kind == SPECKLE:
        fine = value_noise(order, values, u, v, w)
        return 1.6 * fine + 0.8 * value_noise(order, values, 0.23 * u, 0.23 * v, 0.23 * w)
    return fractal_noise(order, values, u, v, w)


@kernel
def shade_hits(
    triangles: Triangles, textures: Textures, rays: Rays, rotation: Float64, out: Shading
) -> None:
    """Fill in the surface properties of each hit: where the ray's face is not negative.

    `rotation` (3, 3) is R_room_body.
    """
    corner_normals, face_normals, face_surface = triangles
    rows, order, values = textures
    origins, directions, distance, face, weights = rays
    normal, albedo, gloss, surface = out
    shared = origins.shape[0] == 1
    n = np.empty(3)
    for i in range(directions.shape[0]):
        f = face[i]
        if f < 0:
            continue
        j = 0 if shared else i
        v, w = weights[i, 0], weights[i, 1]
        u = 1.0 - v - w
        face_cosine = 0.0
        smooth_cosine = 0.0
        norm = 0.0
        for k in range(3):
            n[k] = (
                u * corner_normals[f, k]
                + v * corner_normals[f, 3 + k]
                + w * corner_normals[f, 6 + k]
            )
            norm += n[k] * n[k]
            face_cosine += face_normals[f, k] * directions[i, k]
            smooth_cosine += n[k] * directions[i, k]
        norm = np.sqrt(norm)
        sign = -1.0 if face_cosine > 0.0 else 1.0
        # At a silhouette, a normal interpolated between corners may face away from the ray.
        if norm < 1e-6 or sign * smooth_cosine >= 0.0:
            norm = 1.0
            for k in range(3):
                n[k] = face_normals[f, k]
        for k in range(3):
            total = rotation[k, 0] * n[0] + rotation[k, 1] * n[1] + rotation[k, 2] * n[2]
            normal[i, k] = sign * total / norm
        s = face_surface[f]
        surface[i] = s
        gloss[i] = rows[s, GLOSS]
        value = rows[s, ALBEDO]
        if rows[s, CONTRAST] > 0.0:
            x = origins[j, 0] + distance[i] * directions[i, 0]
            y = origins[j, 1] + distance[i] * directions[i, 1]
            z = origins[j, 2] + distance[i] * directions[i, 2]
            p = min(max(pattern_at(order, values, rows[s], x, y, z), -2.5), 2.5)
            value = min(max(value * (1.0 + rows[s, CONTRAST] * p), 0.02), 0.98)
        albedo[i] = value
