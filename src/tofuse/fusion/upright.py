"""Which way up a model is."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.fusion.mesh import Mesh

# Vertices that take part, and of them the planes that are tried.
_POINTS, _TRIED = 4000, 150
_MAX_TILT, _ANGLE = np.radians(25.0), np.radians(12.0)
# A floor holds so much of the vertices, and so much at most lies below it.
_LEAST_SHARE, _MOST_BELOW = 0.04, 0.02
# Directions that are tried for up, some 3 degrees apart; normals and cameras that judge them.
_DIRECTIONS, _JUDGING, _CAMERAS = 4000, 1000, 100
# How far those who hold a camera roll it, look up and look down, one sigma: what they look at is
# mostly below their eyes. What one camera says against a direction at most.
_ROLL, _UP, _DOWN, _OUTLIER = np.radians(15.0), np.radians(40.0), np.radians(60.0), -5.0
_ALIKE = np.radians(30.0)  # apart, cameras are hardly held alike, one sigma
# One camera in twenty lies on its side or hangs upside down, all of the time.
_LEVEL, _TURNED = 0.0, np.log(0.05)
# How near to level or plumb surfaces are that people made, one sigma, and how much it counts if
# all are, against what the cameras say.
_PLUMB, _STRUCTURE = np.radians(7.0), 4.0


def T_up_world(mesh: Mesh | None, poses: Float64, up: Float64 | None = None) -> Float64:
    """Return the motion (4, 4) of `upright`, which is a rotation about the world's origin."""
    T = np.eye(4)
    T[:3, :3] = upright(mesh, poses, up)
    return T


def upright(mesh: Mesh | None, poses: Float64, up: Float64 | None = None) -> Float64:
    """Return the rotation (3, 3) from the world into axes x right, y up, z towards the viewer.

    Up is the normal of the floor, where there is one: the largest plane that faces about upwards
    and has hardly anything below it. Without one it is what gravity says, and without gravity what
    `likely_up` says. The first camera looks along -z.

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
    up = likely_up(mesh, known) if up is None else up / np.linalg.norm(up)
    floor = None if mesh is None else _floor(mesh, up)
    y = up if floor is None else floor
    back = -known[0, :3, 2]
    if np.linalg.norm(np.cross(y, back)) < 0.1:  # it looks straight down, or up
        back = known[0, :3, 1]
    x = np.cross(y, back)
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)])


def likely_up(mesh: Mesh | None, poses: Float64) -> Float64:
    """Return the unit vector (3,) that is most probably up, of all directions in the world.

    Who holds a camera keeps its horizon level, and looks down or up (the first is how panoramas are
    straightened: Brown and Lowe 2007, section 5); a camera may also lie on its side or hang upside
    down all of the time. What people made is level or plumb, and what is level is mostly seen from
    above: things lie on floors and tables.

    Parameters
    ----------
    poses
        (N, 4, 4) T_world_camera, one at least.
    """
    some = poses[:: -(-len(poses) // _CAMERAS), :3, :3]
    own = -some[:, :, 1].mean(0)
    if mesh is None or len(mesh) == 0:
        normals = np.zeros((0, 3))
    else:
        normals = mesh.normals[:: -(-len(mesh) // _JUDGING)].astype(float)
        normals = normals[np.isfinite(normals).all(1)]
    if np.linalg.norm(own) > 0.1:  # between the others it may be best, too
        tried = np.concatenate([[own / np.linalg.norm(own)], _directions()])
    else:
        tried = _directions()
    score = _camera_score(some, tried) + _STRUCTURE * _built(normals, tried)
    best = tried[int(score.argmax())]
    return _refined(normals, best)


def _directions() -> Float64:
    """Unit vectors (N, 3), evenly over the sphere."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)


def _camera_score(R_world_camera: Float64, ups: Float64) -> Float64:
    """Logarithm (N,) of how probable directions (N, 3) are, by how cameras (K, 3, 3) are held."""
    # Cameras that are held alike are one piece of evidence: this counts the pieces.
    cos = 0.5 * (np.einsum("aij,bij->ab", R_world_camera, R_world_camera) - 1)
    apart = np.arccos(cos.clip(-1, 1))
    independent = 1 / np.exp(-0.5 * (apart / _ALIKE) ** 2).mean()
    right, below, ahead = (ups @ R_world_camera[:, :, k].T for k in range(3))
    held = []
    for aside, above, prior in (
        (right, -below, _LEVEL),
        (below, right, _TURNED),
        (below, -right, _TURNED),
        (right, below, _TURNED),
    ):
        roll = np.arcsin(aside.clip(-1, 1))
        down = np.arctan2(-ahead, above)
        each = -0.5 * ((roll / _ROLL) ** 2 + (down / np.where(down < 0, _UP, _DOWN)) ** 2)
        held.append(independent * np.maximum(each, _OUTLIER).mean(1) + prior)
    score: Float64 = np.max(held, axis=0)
    return score


def _built(normals: Float64, ups: Float64) -> Float64:
    """Share (N,) of surfaces (K, 3) that are plumb or face up, less those that face down.

    Between 1, all is as (N, 3) directions ask for, and -1.
    """
    if not len(normals):
        return np.zeros(len(ups))
    along = ups @ normals.T
    away2 = np.minimum(along**2, 1 - along**2)  # sine squared of the angle from plumb or level
    fits = np.exp(-0.5 * away2 / np.sin(_PLUMB) ** 2)
    share: Float64 = np.where(along < -np.sqrt(0.5), -fits, fits).mean(1)
    return share


def _refined(normals: Float64, up: Float64) -> Float64:
    """The direction (3,) near `up` to which surfaces are level or plumb, by least squares."""
    for _ in range(4):
        along = normals @ up
        plumb, level = (
            normals[np.abs(along) < np.sin(_ANGLE)],
            normals[np.abs(along) > np.cos(_ANGLE)],
        )
        if len(level) < _LEAST_SHARE * len(normals) or not len(level):
            return up
        _, vectors = np.linalg.eigh(plumb.T @ plumb - level.T @ level)
        found = vectors[:, 0]
        up = found if found @ up > 0 else -found
    return up


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
