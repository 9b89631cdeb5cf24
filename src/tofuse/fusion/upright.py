"""Which way up a model is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.fusion.mesh import Mesh

Float64 = NDArray[np.float64]

# Vertices that take part, and of them the planes that are tried.
_POINTS, _TRIED = 4000, 150
_MAX_TILT, _ANGLE = np.radians(50.0), np.radians(12.0)
# A floor holds so much of the vertices, and so much at most lies below it.
_LEAST_SHARE, _MOST_BELOW = 0.04, 0.02


def T_up_world(mesh: Mesh | None, poses: Float64, up: Float64 | None = None) -> Float64:
    """Return the motion (4, 4) of `upright`, which is a rotation about the world's origin."""
    T = np.eye(4)
    T[:3, :3] = upright(mesh, poses, up)
    return T


def upright(mesh: Mesh | None, poses: Float64, up: Float64 | None = None) -> Float64:
    """Return the rotation (3, 3) from the world into axes x right, y up, z towards the viewer.

    Up is the normal of the floor, where there is one: the largest plane that faces about upwards
    and has hardly anything below it. Without one it is what gravity says, and without gravity the
    mean of the cameras' up. The first camera looks along -z.

    Parameters
    ----------
    poses
        (N, 4, 4) T_world_camera, NaN where there is none.
    up
        (3,) against gravity, in the world, as an accelerometer measured it; None without one.
    """
    known = poses[np.isfinite(poses).all((1, 2))]
    if len(known) == 0:
        known = np.eye(4)[None]
    if up is None:
        up = -known[:, :3, 1].mean(0)
        up = up if np.linalg.norm(up) > 0.1 else -known[0, :3, 1]
    up = up / np.linalg.norm(up)
    floor = None if mesh is None else _floor(mesh, up)
    y = up if floor is None else floor
    back = -known[0, :3, 2]
    if np.linalg.norm(np.cross(y, back)) < 0.1:  # it looks straight down, or up
        back = known[0, :3, 1]
    x = np.cross(y, back)
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)])


def _floor(mesh: Mesh, up: Float64) -> Float64 | None:
    """Normal (3,) of the largest plane facing up that has nothing below it, or None."""
    step = max(1, len(mesh) // _POINTS)
    p, n = mesh.vertices[::step].astype(float), mesh.normals[::step].astype(float)
    facing = np.flatnonzero(n @ up > np.cos(_MAX_TILT))
    if len(facing) < max(20, _LEAST_SHARE * len(p)):
        return None
    band = 0.01 * float(np.linalg.norm(np.ptp(np.percentile(p, [2, 98], axis=0), axis=0)))
    tried = facing[:: max(1, len(facing) // _TRIED)]
    normals, heights = n[tried], (p[tried] * n[tried]).sum(1)
    for _ in range(4):
        over = normals @ p.T - heights[:, None]
        on = (np.abs(over) < band) & (normals @ n.T > np.cos(_ANGLE))
        # A table is larger than what is seen of the floor, but there is something below it.
        lowest = (over < -3 * band).mean(1) <= _MOST_BELOW
        best = int(np.argmax(on.sum(1) * lowest))
        mine = on[best]
        if not lowest[best] or mine.sum() < max(20, _LEAST_SHARE * len(p)):
            return None
        # The mean of what lies on it is better than one vertex.
        centre = p[mine].mean(0)
        normal = np.linalg.eigh(np.cov((p[mine] - centre).T))[1][:, 0]
        normal = normal if normal @ up > 0 else -normal
        normals, heights = normal[None], np.array([centre @ normal])
    return normals[0]
