"""Two views of a furnished room far apart."""

from __future__ import annotations

import numpy as np

from ray_casting import rays_at, to_box, to_plane
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3

CAMERA = Pinhole(160, 120, 130.0, 130.0, 79.5, 59.5)


# Boxes (centre, half size, turned about y by rad) on a floor 1 m below the origin, y down.
FURNITURE = [
    ((0.0, 0.7, 2.0), (0.35, 0.3, 0.25), 0.3),
    ((0.55, 0.55, 2.7), (0.2, 0.45, 0.2), 0.9),
    ((-0.7, 0.8, 2.6), (0.3, 0.2, 0.3), 1.2),
]


def seen(T_world_camera, boxes=FURNITURE, sigma=0.004, seed=0, walls=True):
    """Depth of boxes, floor and two walls, with noise; a frame."""
    origin, rays = rays_at(T_world_camera, CAMERA)
    best = np.full((120, 160), np.inf)
    planes = [((0, 1, 0), 1.0)]
    planes += [((0.1, 0, 1), 3.8), ((1, 0, -0.2), 1.7)] if walls else []
    for normal, distance in planes:
        best = np.minimum(best, to_plane(origin, rays, normal, distance))
    for centre, half, turn in boxes:
        R, half = se3.so3_exp([0, turn, 0]), np.array(half)
        best = np.minimum(best, to_box((origin - centre) @ R, rays @ R, -half, half)[0])
    depth = best + sigma * np.random.default_rng([7, seed]).standard_normal(best.shape)
    depth[~(best < 8)] = 0
    return RangeFrame(seed, float(seed), CAMERA, depth.astype(np.float32), "z")


def camera(x, z, yaw, pitch=-0.35):
    """A pose at the height of the origin; a negative pitch looks down."""
    return se3.pose(se3.so3_exp([0, yaw, 0]) @ se3.so3_exp([pitch, 0, 0]), [x, 0.0, z])


# Moved sideways, and rotated by 30 degrees about the scene.
A, B = camera(-0.2, 0.0, 0.0), camera(0.55, 0.2, -0.5)


TRUE = se3.inverse(A) @ B


def clouds():
    """Points of the room from these two places, source and target."""
    return seen(B, seed=1).points.astype(float), seen(A, seed=2).points.astype(float)
