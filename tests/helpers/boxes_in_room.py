"""Views inside a rectangular room, with boxes in it, by an ideal camera."""

from __future__ import annotations

import numpy as np

from ray_casting import rays_at, to_room
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame

ROOM = np.array([[-2.5, -1.3, -2.0], [2.5, 1.1, 3.0]])
BOXES = np.array(
    [
        [[-1.2, 0.3, 1.2], [-0.5, 1.1, 1.9]],
        [[0.6, -0.2, 1.6], [1.1, 1.1, 2.3]],
        [[1.5, 0.4, -0.5], [2.3, 1.1, 0.4]],
        [[-2.2, -0.1, -1.0], [-1.7, 1.1, -0.2]],
    ]
)


def views_in_room(camera: Pinhole, poses, noise_m: float, seed: int, boxes=BOXES):
    """Frames of z depth (m) at poses (N, 4, 4) T_world_camera, with Gaussian noise."""
    rng = np.random.default_rng(seed)
    frames = []
    for k, T in enumerate(np.asarray(poses)):
        z, _ = to_room(*rays_at(T, camera), ROOM, boxes)
        z = z + rng.normal(0, noise_m, z.shape)
        frames.append(RangeFrame(k, k / 10, camera, z.astype(np.float32)))
    return frames
