"""A scene of boards, and views of it."""

import numpy as np

from ray_casting import rays_at, to_plane
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
    origin, directions = rays_at(T_room_camera, CAMERA)
    lengths = np.linalg.norm(directions, axis=2)
    z = np.full((72, 96), np.inf)
    for normal, d, half in boards:
        n = np.array(normal) / np.linalg.norm(normal)
        t = to_plane(origin, directions, n, d)
        hit = origin + np.where(t < 99, t, 99)[..., None] * directions
        near = np.linalg.norm(hit - d * n, axis=2) < half
        z = np.where(near, np.minimum(t, z), z)
    noisy = z + (offset + rng.normal(0, 0.002, z.shape)) / lengths
    depth = np.where(np.isfinite(z) & (z < 5), noisy, 0).astype(np.float32)
    return RangeFrame(0, 0.0, CAMERA, depth, "z", None)
