"""The synthetic case of the thesis (4.1.6): MATLAB's `peaks`, viewed by 20 cameras on a circle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.frames import CloudFrame
from tofuse.engine.geometry import se3, unit_vectors

CAMERAS = 20
RADIUS_M = 10.0
GRID = 71
POINTS = 5000
POINTS_PER_VIEW = 2500


def peaks(x: ArrayLike, y: ArrayLike) -> Float64:
    """MATLAB's `peaks` function: a sum of three scaled and shifted Gaussians."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    return (
        3 * (1 - x) ** 2 * np.exp(-(x**2) - (y + 1) ** 2)
        - 10 * (x / 5 - x**3 - y**5) * np.exp(-(x**2) - y**2)
        - np.exp(-((x + 1) ** 2) - y**2) / 3
    )


def peaks_points() -> Float64:
    """(5000, 3) noise-free points in m, as (x, height, y).

    The first 5000 points, in row-major order (x fastest), of a 71 x 71 grid on [-3, 3]^2.
    """
    side = np.linspace(-3, 3, GRID)
    x, y = np.meshgrid(side, side)
    return np.stack([x, peaks(x, y), y], -1).reshape(-1, 3)[:POINTS]


def peaks_normals() -> Float64:
    """(5000, 3) unit normals of the surface at `peaks_points`, pointing up."""
    points = peaks_points()
    x, y = points[:, 0], points[:, 2]
    step = 1e-5
    slope_x = (peaks(x + step, y) - peaks(x - step, y)) / (2 * step)
    slope_y = (peaks(x, y + step) - peaks(x, y - step)) / (2 * step)
    return unit_vectors(np.stack([-slope_x, np.ones_like(x), -slope_y], -1))


def peaks_cameras() -> Float64:
    """(20, 4, 4) T_object_camera of the cameras, 18 degrees apart, 10 m from the origin.

    Camera k stands at (10 sin a, 0, -10 cos a), a = 18 k degrees, and looks at the origin;
    the object's second axis (height) is up, so camera axes are x right, y down, z forward.
    """
    a = 2 * np.pi * np.arange(CAMERAS) / CAMERAS
    position = RADIUS_M * np.stack([np.sin(a), np.zeros(CAMERAS), -np.cos(a)], -1)
    down, forward = np.broadcast_to([0.0, -1, 0], position.shape), -position / RADIUS_M
    return se3.pose(np.stack([np.cross(down, forward), down, forward], -1), position)


def peaks_visible() -> list[Intp]:
    """Ascending rows of `peaks_points` visible to each camera: the 2500 nearest to it."""
    points = peaks_points()
    distances = [np.linalg.norm(points - T[:3, 3], axis=1) for T in peaks_cameras()]
    return [np.sort(np.argsort(d, kind="stable")[:POINTS_PER_VIEW]) for d in distances]


def peaks_views(sigma: float, seed: int) -> tuple[list[CloudFrame], Float64]:
    """Return the 20 noisy views and the true poses.

    Each view contains the 2500 points nearest to its camera, as a substitute for occlusion, with
    independent Gaussian noise on every coordinate.

    Parameters
    ----------
    sigma
        Standard deviation of the noise in m.
    seed
        Of the noise; two sigmas with the same seed get the same noise, scaled.

    Returns
    -------
    views, T_world_camera
        The views in their cameras' frames, and (20, 4, 4) poses; the first is the identity.
    """
    points = peaks_points()
    T_object_camera = peaks_cameras()
    views = []
    for k, (T, rows) in enumerate(zip(T_object_camera, peaks_visible(), strict=True)):
        points_camera = se3.transform(se3.inverse(T), points[rows])
        noise = np.random.default_rng([seed, k]).normal(size=points_camera.shape)
        views.append(CloudFrame(k, float(k), (points_camera + sigma * noise).astype(np.float32)))
    return views, se3.inverse(T_object_camera[0]) @ T_object_camera
