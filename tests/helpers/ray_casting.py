"""Planes and boxes in simulated views: their z along rays of unit z, infinite where they miss.

Origins are (3,) and directions (..., 3); boxes have edges along the axes.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.geometry.rays import homogeneous


def rays_at(T_world_camera, camera):
    """The origin, and the directions (H, W, 3) of the pixels, in the world."""
    return T_world_camera[:3, 3], homogeneous(camera.rays()) @ T_world_camera[:3, :3].T


def to_plane(origin, directions, normal, offset):
    """To the plane normal . p = offset."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (offset - origin @ normal) / (directions @ normal)
    return np.where(z > 0, z, np.inf)


def to_box(origin, directions, low, high):
    """To a box seen from outside, and the axis of the side that is hit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / directions, (high - origin) / directions
    first = np.minimum(a, b)
    near, far = first.max(-1), np.maximum(a, b).min(-1)
    return np.where((near < far) & (near > 0), near, np.inf), first.argmax(-1)


def to_walls(origin, directions, low, high):
    """To a box seen from inside, and the axis of the side that is hit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.maximum((low - origin) / directions, (high - origin) / directions)
    return z.min(-1), z.argmin(-1)


def to_room(origin, directions, walls, boxes):
    """To the nearest of the walls (low, high) and of boxes in front of them, and the axis."""
    z, axis = to_walls(origin, directions, *walls)
    for box in boxes:
        there, side = to_box(origin, directions, *map(np.asarray, box))
        axis = np.where(there < z, side, axis)
        z = np.minimum(z, there)
    return z, axis
