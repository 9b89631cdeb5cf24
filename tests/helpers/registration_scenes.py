"""Surfaces to register, as views whose true motion is known."""

from __future__ import annotations

import numpy as np

from pose_errors import pose_error
from ray_casting import rays_at
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.geometry import se3

MIDDLE = np.array([0, 0, 2.0])


def rng(*seed):
    return np.random.default_rng(list(seed) or 0)


def view(points, T=None, index=0, origin=(0, 0, 0), **more):
    """The points as seen from a pose T_target_source."""
    back = se3.inverse(np.eye(4) if T is None else T)
    return CloudFrame(
        index,
        0.0,
        se3.transform(back, points).astype(np.float32),
        origin=se3.transform(back, np.array([origin], float))[0],
        **more,
    )


def turn(axis, degrees, centre=MIDDLE):
    """A rotation about a point."""
    T = np.eye(4)
    axis = np.asarray(axis, float)
    T[:3, :3] = se3.so3_exp(axis / np.linalg.norm(axis) * np.deg2rad(degrees))
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


def error(found, T):
    """Translation, m, at the middle of the scene, and rotation, degrees."""
    at = se3.transform(se3.inverse(T), MIDDLE[None])
    return pose_error(found.T_target_source, T, at)


def directions(n, seed):
    d = rng(seed).normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1)[:, None]


def stone(n, seed, noise=0.0):
    """A smooth, curved body, half a metre in radius, without its back."""
    d = directions(2 * n, seed)
    d = d[d[:, 2] < 0.3][:n]
    radius = 0.5 + 0.12 * np.sin(3 * d[:, 0] + 1) * np.cos(2 * d[:, 1])
    radius += 0.08 * np.sin(5 * d[:, 1] + d[:, 2])
    return d * radius[:, None] + MIDDLE + rng(seed, 1).normal(0, noise, d.shape)


def bumpy_ball(n, seed, noise=0.0):
    """A ball with nine bumps and hollows, all round."""
    d, centres = directions(n, seed), directions(9, 99)
    height = np.tile([0.12, 0.09, -0.07], 3)
    apart = ((d[:, None] - centres) ** 2).sum(2)
    radius = 0.5 + (height * np.exp(-apart / 0.12)).sum(1)
    return d * radius[:, None] + MIDDLE + rng(seed, 1).normal(0, noise, d.shape)


def relief_height(x, y):
    return 0.12 * np.sin(5 * x + 1) * np.cos(6 * y) + 0.08 * np.sin(9 * y + 4 * x)


def relief(n, seed, low=-0.5, high=0.5, noise=0.002, outliers=0):
    """A wavy sheet from x = low to high, and outliers around it."""
    r = rng(seed)
    x, y = r.uniform(low, high, n), r.uniform(-0.4, 0.4, n)
    sheet = np.column_stack([x, y, 2 + relief_height(x, y)]) + r.normal(0, noise, (n, 3))
    return np.vstack([sheet, r.uniform([low, -0.4, 1.7], [high, 0.4, 2.3], (outliers, 3))])


def box_walls(n, seed, noise=0.0, walls="xy", depth=(1.0, 5.0)):
    """Points on the walls x = +-1 and y = +-1 of a corridor along z, or on some of them."""
    r = rng(seed)
    p = r.uniform([-1, -1, depth[0]], [1, 1, depth[1]], (n, 3))
    sides = [(axis, side) for axis, name in enumerate("xy") if name in walls for side in (-1, 1)]
    sides += [(2, depth[1])] if "z" in walls else []
    which = r.integers(0, len(sides), n)
    for k, (axis, at) in enumerate(sides):
        p[which == k, axis] = at
    return p + r.normal(0, noise, p.shape)


CAMERA = Pinhole(width=120, height=90, fx=110, fy=110, cx=59.5, cy=44.5)


def relief_image(T_world_camera, index=0, noise=0.0, seed=0, amplitude=None):
    """A range image of the relief, exact to the noise; amplitude(x, y) of the world, if given."""
    o, d = rays_at(T_world_camera, CAMERA)
    z = np.full(d.shape[:2], 2.0)
    for _ in range(60):
        p = o + z[..., None] * d
        z = z + 0.5 * (2 + relief_height(p[..., 0], p[..., 1]) - p[..., 2]) / d[..., 2]
    p = o + z[..., None] * d
    z = z + rng(seed, index).normal(0, noise, z.shape)
    image = None if amplitude is None else amplitude(p[..., 0], p[..., 1]).astype(np.float32)
    return RangeFrame(index, 0.0, CAMERA, z.astype(np.float32), amplitude_image=image)
