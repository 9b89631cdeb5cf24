"""The upright orientation of a model."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.fusion.mesh import Mesh

# Number of sampled vertices, and of candidate planes through them.
_POINTS, _CANDIDATES = 4000, 150
_MAX_TILT, _ANGLE = np.radians(25.0), np.radians(12.0)
# Minimum fraction of the vertices on the floor, and maximum fraction below it.
_MIN_FRACTION, _MAX_BELOW = 0.04, 0.02
# Candidates for up, some 3 degrees apart; normals and cameras that they are scored by.
_DIRECTIONS, _MAX_NORMALS, _MAX_CAMERAS = 4000, 1000, 100
# Standard deviations of the roll of a handheld camera, and of its pitch upwards and downwards: most
# objects are below eye level. Minimum log-likelihood of one camera.
_ROLL, _UP, _DOWN, _OUTLIER = np.radians(15.0), np.radians(40.0), np.radians(60.0), -5.0
_SIMILAR = np.radians(30.0)  # correlation angle between orientations of cameras
# Log priors: one camera in twenty is permanently on its side or upside down.
_LEVEL, _ROLLED = 0.0, np.log(0.05)
# Standard deviation of man-made surfaces from horizontal or vertical, and the weight of their score
# relative to the cameras.
_STRUCTURE_ANGLE, _STRUCTURE_WEIGHT = np.radians(7.0), 4.0
# Angles between up directions and normals that are computed at a time: bounds the memory.
_AT_ONCE = 500_000


def T_up_world(mesh: Mesh | None, poses: Float64, up: Float64 | None = None) -> Float64:
    """Return the rotation of `upright` about the world's origin, as (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = upright(mesh, poses, up)
    return T


def upright(mesh: Mesh | None, poses: Float64, up: Float64 | None = None) -> Float64:
    """Return the rotation (3, 3) from the world into axes x right, y up, z towards the viewer.

    Up is the normal of the floor: the largest plane that faces roughly upwards and has hardly
    anything below it. Without a floor it is measured up, and without that `likely_up`. The first
    camera looks along -z.

    Parameters
    ----------
    mesh
        The surface; None without one.
    poses
        (N, 4, 4) T_world_camera, NaN for frames without a pose.
    up
        (3,) against gravity, in the world, by an accelerometer; None without one.
    """
    known = poses[np.isfinite(poses).all((1, 2))]
    if len(known) == 0:
        known = np.eye(4)[None]
    up = likely_up(mesh, known) if up is None else up / np.linalg.norm(up)
    floor = None if mesh is None else _floor(mesh, up)
    y = up if floor is None else floor
    back = -known[0, :3, 2]
    if np.linalg.norm(np.cross(y, back)) < 0.1:  # it looks straight down or up
        back = known[0, :3, 1]
    x = np.cross(y, back)
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)])


def likely_up(mesh: Mesh | None, poses: Float64) -> Float64:
    """Return the unit vector (3,) in the world that is most probably up.

    Handheld cameras have a level horizon (by which panoramas are straightened: Brown and Lowe 2007,
    section 5) and varying pitch; some are permanently on their side or upside down. Man-made
    surfaces are horizontal or vertical, and horizontal ones are mostly seen from above, as floors
    and tables.

    Parameters
    ----------
    mesh
        The surface; None without one.
    poses
        (N, 4, 4) T_world_camera, at least one.
    """
    some = poses[:: -(-len(poses) // _MAX_CAMERAS), :3, :3]
    own = -some[:, :, 1].mean(0)
    if mesh is None or len(mesh) == 0:
        normals = np.zeros((0, 3))
    else:
        normals = mesh.normals[:: -(-len(mesh) // _MAX_NORMALS)].astype(float)
        normals = normals[np.isfinite(normals).all(1)]
    if np.linalg.norm(own) > 0.1:  # the mean of the cameras is a candidate, too
        tried = np.concatenate([[own / np.linalg.norm(own)], _directions()])
    else:
        tried = _directions()
    score = _camera_score(some, tried) + _STRUCTURE_WEIGHT * _structure_score(normals, tried)
    best = tried[int(score.argmax())]
    return _refined(normals, best)


def _directions() -> Float64:
    """Return unit vectors (N, 3), evenly over the sphere."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)


def _camera_score(R_world_camera: Float64, ups: Float64) -> Float64:
    """Return the log-likelihood (N,) of up directions (N, 3), by cameras (K, 3, 3)."""
    # Similar orientations are correlated: the effective number of independent cameras.
    cos = 0.5 * (np.einsum("aij,bij->ab", R_world_camera, R_world_camera) - 1)
    apart = np.arccos(cos.clip(-1, 1))
    independent = 1 / np.exp(-0.5 * (apart / _SIMILAR) ** 2).mean()
    right, below, ahead = (ups @ R_world_camera[:, :, k].T for k in range(3))
    scores = []
    for aside, above, prior in (
        (right, -below, _LEVEL),
        (below, right, _ROLLED),
        (below, -right, _ROLLED),
        (right, below, _ROLLED),
    ):
        roll = np.arcsin(aside.clip(-1, 1))
        down = np.arctan2(-ahead, above)
        each = -0.5 * ((roll / _ROLL) ** 2 + (down / np.where(down < 0, _UP, _DOWN)) ** 2)
        scores.append(independent * np.maximum(each, _OUTLIER).mean(1) + prior)
    score: Float64 = np.max(scores, axis=0)
    return score


def _structure_score(normals: Float64, ups: Float64) -> Float64:
    """Return the fraction (N,) of normals (K, 3) that are horizontal or up, minus those down.

    `ups` (N, 3) are up directions; 1 if all surfaces are vertical or face up, -1 if all face down.
    """
    if not len(normals):
        return np.zeros(len(ups))
    scores = []
    for some in np.array_split(ups, -(-ups.shape[0] * len(normals) // _AT_ONCE)):
        along = some @ normals.T
        sine2 = np.minimum(along**2, 1 - along**2)  # of the angle from vertical or horizontal
        fits = np.exp(-0.5 * sine2 / np.sin(_STRUCTURE_ANGLE) ** 2)
        scores.append(np.where(along < -np.sqrt(0.5), -fits, fits).mean(1))
    return np.concatenate(scores)


def _refined(normals: Float64, up: Float64) -> Float64:
    """Refine up (3,) by least squares, so that surfaces are horizontal or vertical."""
    for _ in range(4):
        along = normals @ up
        vertical, horizontal = (
            normals[np.abs(along) < np.sin(_ANGLE)],
            normals[np.abs(along) > np.cos(_ANGLE)],
        )
        if len(horizontal) < _MIN_FRACTION * len(normals) or not len(horizontal):
            return up
        _, vectors = np.linalg.eigh(vertical.T @ vertical - horizontal.T @ horizontal)
        found = vectors[:, 0]
        up = found if found @ up > 0 else -found
    return up


def _floor(mesh: Mesh, up: Float64) -> Float64 | None:
    """Return the normal (3,) of the largest plane facing up with nothing below it, or None."""
    step = max(1, len(mesh) // _POINTS)
    p, n = mesh.vertices[::step].astype(float), mesh.normals[::step].astype(float)
    facing = np.flatnonzero(n @ up > np.cos(_MAX_TILT))
    if len(facing) < max(20, _MIN_FRACTION * len(p)):
        return None
    band = 0.01 * float(np.linalg.norm(np.ptp(np.percentile(p, [2, 98], axis=0), axis=0)))
    tried = facing[:: max(1, len(facing) // _CANDIDATES)]
    normals, heights = n[tried], (p[tried] * n[tried]).sum(1)
    for _ in range(4):
        over = normals @ p.T - heights[:, None]
        on = (np.abs(over) < band) & (normals @ n.T > np.cos(_ANGLE))
        # A table may be larger than the visible floor, but there is something below it.
        lowest = (over < -3 * band).mean(1) <= _MAX_BELOW
        best = int(np.argmax(on.sum(1) * lowest))
        mine = on[best]
        if not lowest[best] or mine.sum() < max(20, _MIN_FRACTION * len(p)):
            return None
        # The plane through all its vertices is more accurate than that of one.
        centre = p[mine].mean(0)
        normal = np.linalg.eigh(np.cov((p[mine] - centre).T))[1][:, 0]
        normal = normal if normal @ up > 0 else -normal
        normals, heights = normal[None], np.array([centre @ normal])
    return normals[0]
