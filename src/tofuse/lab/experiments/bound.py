"""Lower bounds of the error of unbiased pose estimates from an unknown surface."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.geometry import se3

_DRAWS = 20_000


def joint_covariance(
    points: Float64, normals: Float64, visible: Bool, poses: Float64, sigma: float
) -> Float64:
    """Cramer-Rao bound of poses from the distances of their points from a surface.

    Every point has isotropic noise, of which only the normal component counts, as the position on
    the surface is unknown. So is the height of the surface at the samples, which is eliminated from
    the Fisher information; the first pose is known.

    Parameters
    ----------
    points, normals
        (S, 3) samples of the surface in the frame of the poses, and its unit normals.
    visible
        (S, N) visibility of each sample in each view.
    poses
        (N, 4, 4) true poses, which map a view into the frame of the points.
    sigma
        Standard deviation of each coordinate of a point, m.

    Returns
    -------
    (6 N - 6, 6 N - 6) covariance of the right perturbations of all poses but the first (m, rad).
    """
    samples, views = visible.shape
    J = np.zeros((samples, views, 6))
    H = np.zeros((views, 6, views, 6))
    for k, T in enumerate(poses):
        p = se3.transform(se3.inverse(T), points)
        m = normals @ T[:3, :3]
        J[:, k] = np.hstack([m, np.cross(p, m)]) * visible[:, [k]]
        H[k, :, k] = J[:, k].T @ J[:, k]
    # The height of a sample is estimated from all views that see it.
    J /= np.sqrt(np.maximum(visible.sum(1), 1))[:, None, None]
    rows = J.reshape(samples, -1)
    information = H.reshape(6 * views, 6 * views) - rows.T @ rows
    return np.asarray(sigma**2 * np.linalg.inv(information[6:, 6:]), np.float64)


def pose_covariances(
    points: Float64, normals: Float64, visible: Bool, poses: Float64, sigma: float
) -> Float64:
    """(N, 6, 6) covariances of single poses in `joint_covariance`; 0 for the first."""
    views = len(poses)
    joint = joint_covariance(points, normals, visible, poses, sigma)
    C = np.zeros((views, 6, views, 6))
    C[1:, :, 1:] = joint.reshape(views - 1, 6, views - 1, 6)
    return C[np.arange(views), :, np.arange(views)]


def mean_distances(joint: Float64) -> Float64:
    """(D,) mean position errors of simulated recordings, including the first's 0.

    `joint` is that of `joint_covariance`. Errors of the first view move all the others, so that
    single recordings vary strongly.
    """
    draws = np.random.default_rng([0]).normal(size=(len(joint), _DRAWS))
    errors = (np.linalg.cholesky(joint) @ draws).reshape(-1, 6, _DRAWS)[:, :3]
    return np.asarray(np.linalg.norm(errors, axis=1).sum(0) / (len(errors) + 1), np.float64)


def mean_distance(covariances: Float64) -> float:
    """Mean length of normal vectors with covariances (N, 3, 3), over all of them."""
    values = np.linalg.eigvalsh(covariances)
    draws = np.random.default_rng([0]).normal(size=(_DRAWS, 1, 3))
    return float(np.linalg.norm(draws * np.sqrt(np.maximum(values, 0)), axis=2).mean())
