"""A scene of boards, and views of it."""

import numpy as np

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame

CAMERA = Pinhole(96, 72, 67.5, 67.5, 47.5, 35.5)


# Planes n . x = d of a heap of tilted boards on a floor, nearest hit counts: normal, offset, and
# the half width around the point of the plane that is nearest to the origin.
BOARDS = (
    ((0.0, 0.0, 1.0), 0.0, 9.0),
    ((0.55, 0.05, 0.9), 0.40, 0.45),
    ((-0.4, 0.5, 0.9), 0.32, 0.45),
    ((-0.2, -0.6, 0.9), 0.32, 0.45),
    ((0.5, 0.5, 0.9), 0.2, 0.7),
)


def looked_at(
    T_room_camera: np.ndarray, rng: np.random.Generator, offset: float, boards=BOARDS
) -> RangeFrame:
    rays = np.concatenate([CAMERA.rays().astype(float), np.ones((72, 96, 1))], 2)
    lengths = np.linalg.norm(rays, axis=2)
    directions = rays @ T_room_camera[:3, :3].T
    origin = T_room_camera[:3, 3]
    z = np.full((72, 96), np.inf)
    for normal, d, half in boards:
        n = np.array(normal) / np.linalg.norm(normal)
        facing = directions @ n
        with np.errstate(divide="ignore"):
            t = (d - origin @ n) / facing
        hit = origin + t[..., None] * directions
        near = (t > 0) & (np.abs(facing) > 1e-6)
        near &= np.linalg.norm(hit - d * n, axis=2) < half
        z = np.where(near & (t < z), t, z)
    noisy = z + (offset + rng.normal(0, 0.002, z.shape)) / lengths
    depth = np.where(np.isfinite(z) & (z < 5), noisy, 0).astype(np.float32)
    return RangeFrame(0, 0.0, CAMERA, depth, "z", None)
