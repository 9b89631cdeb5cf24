"""The upright orientation of a model."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.geometry import se3, sphere_directions

# Number of sampled vertices, and of candidate planes through them.
_MAX_POINTS, _MAX_CANDIDATES = 4000, 150
_MAX_TILT, _MAX_NORMAL_ANGLE = np.radians(25.0), np.radians(12.0)
# Minimum fraction of the vertices on the floor, and maximum fraction below it.
_MIN_FRACTION, _MAX_BELOW = 0.04, 0.02
# Candidates for up, about 3 degrees apart; normals and cameras that they are scored by.
_DIRECTIONS, _MAX_NORMALS, _MAX_CAMERAS = 4000, 1000, 100
# Standard deviations of the roll of a handheld camera, and of its mean pitch upwards and downwards:
# most objects are below eye level. That of the pitch about this mean: people look around more than
# up and down, which is what looking around is for a camera on its side that is taken for level.
# Minimum log-likelihood of one camera.
_ROLL_SIGMA, _PITCH_UP_SIGMA, _PITCH_DOWN_SIGMA = np.radians([15.0, 40.0, 60.0])
_PITCH_VARIATION = np.radians(20.0)
_MIN_LOG_LIKELIHOOD = -5.0
_CORRELATION_ANGLE = np.radians(30.0)  # correlation angle between orientations of cameras
# Log priors: one camera in twenty is permanently on its side or upside down.
_LOG_PRIOR_LEVEL, _LOG_PRIOR_ROLLED = 0.0, np.log(0.05)
# Standard deviation of man-made surfaces from horizontal or vertical, and the weight of their score
# relative to the cameras.
_STRUCTURE_ANGLE, _STRUCTURE_WEIGHT = np.radians(7.0), 4.0
# Number of angles between up directions and normals computed at a time: bounds the memory.
_CHUNK_SIZE = 500_000


def T_up_world(mesh: Mesh | None, poses: Float64, up: Float64 | None = None) -> Float64:
    """Return the rotation of `upright` about the world's origin, as (4, 4)."""
    return se3.pose(upright(mesh, poses, up))


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
    posed = poses[np.isfinite(poses).all((1, 2))]
    if len(posed) == 0:
        posed = np.eye(4)[None]
    up = likely_up(mesh, posed) if up is None else up / np.linalg.norm(up)
    floor = None if mesh is None else _floor_normal(mesh, up)
    y = up if floor is None else floor
    backward = -posed[0, :3, 2]
    if np.linalg.norm(np.cross(y, backward)) < 0.1:  # it looks straight down or up
        backward = posed[0, :3, 1]
    x = np.cross(y, backward)
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)])


def likely_up(mesh: Mesh | None, poses: Float64) -> Float64:
    """Return the unit vector (3,) in the world that is most probably up.

    Handheld cameras have a level horizon (by which panoramas are straightened: Brown and Lowe 2007,
    section 5), any pitch, and turn more than they nod; some are permanently on their side or upside
    down. Man-made surfaces are horizontal or vertical, and horizontal ones are mostly seen from
    above, as floors and tables.

    Parameters
    ----------
    mesh
        The surface; None without one.
    poses
        (N, 4, 4) T_world_camera, at least one.
    """
    R_world_camera = poses[:: -(-len(poses) // _MAX_CAMERAS), :3, :3]
    mean_up = -R_world_camera[:, :, 1].mean(0)
    if mesh is None or len(mesh) == 0:
        normals = np.zeros((0, 3))
    else:
        normals = mesh.normals[:: -(-len(mesh) // _MAX_NORMALS)].astype(float)
        normals = normals[np.isfinite(normals).all(1)]
    candidates = sphere_directions(_DIRECTIONS)
    if np.linalg.norm(mean_up) > 0.1:  # the mean of the cameras is a candidate, too
        candidates = np.concatenate([[mean_up / np.linalg.norm(mean_up)], candidates])
    score = _camera_score(R_world_camera, candidates) + _STRUCTURE_WEIGHT * _structure_score(
        normals, candidates
    )
    return _refined(normals, candidates[int(score.argmax())])


def _camera_score(R_world_camera: Float64, ups: Float64) -> Float64:
    """Return the log-likelihood (N,) of up directions (N, 3), by cameras (K, 3, 3)."""
    # Similar orientations are correlated: the effective number of independent cameras.
    cos = 0.5 * (np.einsum("aij,bij->ab", R_world_camera, R_world_camera) - 1)
    angles = np.arccos(cos.clip(-1, 1))
    effective_cameras = 1 / np.exp(-0.5 * (angles / _CORRELATION_ANGLE) ** 2).mean()
    right, down, forward = (ups @ R_world_camera[:, :, k].T for k in range(3))
    scores = []
    for sideways, upwards, prior in (
        (right, -down, _LOG_PRIOR_LEVEL),
        (down, right, _LOG_PRIOR_ROLLED),
        (down, -right, _LOG_PRIOR_ROLLED),
        (right, down, _LOG_PRIOR_ROLLED),
    ):
        roll = np.arcsin(sideways.clip(-1, 1))
        pitch_down = np.arctan2(-forward, upwards)
        mean = pitch_down.mean(1, keepdims=True)
        log_likelihood = -0.5 * (
            (roll / _ROLL_SIGMA) ** 2
            + (mean / np.where(mean < 0, _PITCH_UP_SIGMA, _PITCH_DOWN_SIGMA)) ** 2
            + ((pitch_down - mean) / _PITCH_VARIATION) ** 2
        )
        scores.append(
            effective_cameras * np.maximum(log_likelihood, _MIN_LOG_LIKELIHOOD).mean(1) + prior
        )
    score: Float64 = np.max(scores, axis=0)
    return score


def _structure_score(normals: Float64, ups: Float64) -> Float64:
    """Return the fraction (N,) of normals (K, 3) that are horizontal or up, minus those down.

    `ups` (N, 3) are up directions; 1 if all surfaces are vertical or face up, -1 if all face down.
    """
    if not len(normals):
        return np.zeros(len(ups))
    scores = []
    for chunk in np.array_split(ups, -(-ups.shape[0] * len(normals) // _CHUNK_SIZE)):
        cosine = chunk @ normals.T
        sine2 = np.minimum(cosine**2, 1 - cosine**2)  # of the angle from vertical or horizontal
        fits = np.exp(-0.5 * sine2 / np.sin(_STRUCTURE_ANGLE) ** 2)
        scores.append(np.where(cosine < -np.sqrt(0.5), -fits, fits).mean(1))
    return np.concatenate(scores)


def _refined(normals: Float64, up: Float64) -> Float64:
    """Refine up (3,) by least squares, so that surfaces are horizontal or vertical."""
    for _ in range(4):
        cosine = normals @ up
        vertical = normals[np.abs(cosine) < np.sin(_MAX_NORMAL_ANGLE)]
        horizontal = normals[np.abs(cosine) > np.cos(_MAX_NORMAL_ANGLE)]
        if len(horizontal) < _MIN_FRACTION * len(normals) or not len(horizontal):
            return up
        _, vectors = np.linalg.eigh(vertical.T @ vertical - horizontal.T @ horizontal)
        refined = vectors[:, 0]
        up = refined if refined @ up > 0 else -refined
    return up


def _floor_normal(mesh: Mesh, up: Float64) -> Float64 | None:
    """Return the normal (3,) of the largest plane facing up with nothing below it, or None."""
    step = max(1, len(mesh) // _MAX_POINTS)
    p, n = mesh.vertices[::step].astype(float), mesh.normals[::step].astype(float)
    facing_up = np.flatnonzero(n @ up > np.cos(_MAX_TILT))
    if len(facing_up) < max(20, _MIN_FRACTION * len(p)):
        return None
    band = 0.01 * float(np.linalg.norm(np.ptp(np.percentile(p, [2, 98], axis=0), axis=0)))
    candidates = facing_up[:: max(1, len(facing_up) // _MAX_CANDIDATES)]
    normals, heights = n[candidates], (p[candidates] * n[candidates]).sum(1)
    for _ in range(4):
        distances = normals @ p.T - heights[:, None]
        inliers = (np.abs(distances) < band) & (normals @ n.T > np.cos(_MAX_NORMAL_ANGLE))
        # A table may be larger than the visible floor, but there is something below it.
        is_lowest = (distances < -3 * band).mean(1) <= _MAX_BELOW
        best = int(np.argmax(inliers.sum(1) * is_lowest))
        on_floor = inliers[best]
        if not is_lowest[best] or on_floor.sum() < max(20, _MIN_FRACTION * len(p)):
            return None
        # The plane through all its vertices is more accurate than that of a single one.
        centre = p[on_floor].mean(0)
        normal = np.linalg.eigh(np.cov((p[on_floor] - centre).T))[1][:, 0]
        normal = normal if normal @ up > 0 else -normal
        normals, heights = normal[None], np.array([centre @ normal])
    return normals[0]
