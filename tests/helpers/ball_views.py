"""Views around a ball."""

from __future__ import annotations

import numpy as np

from ray_casting import to_plane
from tofuse.engine.cameras.cameras import BrownConrady
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry.rays import unit_rays

EYE = np.eye(4)


CAMERA = BrownConrady(88, 72, 90.0, 90.0, 43.0, 36.0, -0.2, 0.05)


def look(position, target):
    """Pose (4, 4) of a camera at `position` that looks at `target`, image rows along y."""
    z = np.asarray(target, float) - position
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    T[:3, 3] = position
    return T


def sphere_range(T, centre, radius, camera=CAMERA):
    """(H, W) range of rays to a sphere, infinite where they miss it."""
    d = unit_rays(camera.rays()) @ T[:3, :3].T
    o = T[:3, 3] - centre
    b = d @ o
    under = b * b - (o @ o - radius**2)
    t = -b - np.sqrt(np.maximum(under, 0))
    return np.where((under > 0) & (t > 0), t, np.inf)


def plane_range(T, normal, height, camera=CAMERA):
    """(H, W) range of rays to the plane normal . p = height."""
    return to_plane(T[:3, 3], unit_rays(camera.rays()) @ T[:3, :3].T, normal, height)


def frame_of(ranges, index=0, sigma=0.005, noise=None, camera=CAMERA, **images):
    depth = np.where(np.isfinite(ranges), ranges, 0).astype(np.float32)
    if noise is not None:
        depth = np.where(depth > 0, depth + noise.normal(0, sigma, depth.shape), 0)
    images = {
        "sigma_image": np.full(depth.shape, sigma, np.float32),
        "amplitude_image": (1000 / np.maximum(depth, 0.1) ** 2).astype(np.float32),
    } | images
    return RangeFrame(index, float(index), camera, depth.astype(np.float32), "range", **images)


def around_a_ball(count=14, noise=None):
    """Views (frames, poses) of a ball of radius 0.3 at the origin, from all around."""
    frames, poses = [], []
    for k in range(count):
        # A spiral from pole to pole.
        y = 1 - 2 * (k + 0.5) / count
        a = 2.4 * k
        position = 1.1 * np.array(
            [np.sqrt(1 - y * y) * np.cos(a), y, np.sqrt(1 - y * y) * np.sin(a)]
        )
        T = look(position, np.zeros(3))
        frames.append(frame_of(sphere_range(T, np.zeros(3), 0.3), k, noise=noise))
        poses.append(T)
    return frames, np.array(poses)
