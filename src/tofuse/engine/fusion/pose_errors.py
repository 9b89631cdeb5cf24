"""Errors of the surface due to errors of the poses, in addition to the noise of the views."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.frames import RangeFrame
from tofuse.engine.fusion.cloud import Cloud
from tofuse.engine.fusion.model import Model
from tofuse.engine.geometry import KdTree, se3

# They vary slowly over the surface: size of its cells, as a fraction of the model's diagonal.
_CELL_FRACTION = 0.01
# A cell is visible in a view if its depth there differs by less than this fraction plus one cell.
_MAX_DEPTH_DIFFERENCE = 0.05
# Standard deviation in m where a view's pose is not constrained.
UNKNOWN_M = 10.0


def with_pose_errors(
    model: Model, frames: Iterable[RangeFrame], poses: Float64, covariances: Float64
) -> Model:
    """Return the model with errors of the poses in the `sigma` of its points.

    Parameters
    ----------
    model
        The model, with the noise of the views in `sigma`.
    frames
        Images of the model.
    poses, covariances
        (F, 4, 4) T_world_camera of these, and (F, 6, 6) of their right perturbation, NaN if the
        pose is unconstrained.
    """
    cloud, mesh = model.cloud, model.mesh
    if cloud.sigma is None or not len(cloud) or not len(poses):
        return model
    cells = _SurfaceCells.of(cloud)
    pose_sigma = _cell_sigma(cells, frames, poses, covariances)
    if pose_sigma is None:
        return model
    sigma = np.hypot(cloud.sigma, pose_sigma[cells.of_point]).astype(np.float32)
    if mesh is not None and len(mesh):
        mesh_sigma = sigma
        if len(mesh) != len(cloud):  # it has fewer faces
            nearest, _ = KdTree(cells.points).nearest(mesh.vertices.astype(np.float64))
            mesh_sigma = np.hypot(mesh.sigma, pose_sigma[nearest]).astype(np.float32)
        mesh = replace(mesh, sigma=mesh_sigma)
    return Model(replace(cloud, sigma=sigma), mesh)


@dataclass(frozen=True, eq=False)
class _SurfaceCells:
    """Non-empty cubes: their edge, a point of each (M, 3), and the cell of every point (N,)."""

    size: float
    points: Float64
    of_point: Intp

    @classmethod
    def of(cls, cloud: Cloud) -> _SurfaceCells:
        size = max(_CELL_FRACTION * cloud.diagonal_m, 1e-6)
        cell = np.floor((cloud.points - cloud.points.min(0)) / np.float32(size)).astype(np.int64)
        count = cell.max(0) + 1
        key = (cell[:, 0] * count[1] + cell[:, 1]) * count[2] + cell[:, 2]
        _, first, of_point = np.unique(key, return_index=True, return_inverse=True)
        return cls(size, cloud.points[first].astype(np.float64), of_point)


def _cell_sigma(
    cells: _SurfaceCells, frames: Iterable[RangeFrame], poses: Float64, covariances: Float64
) -> Float64 | None:
    """Return sigma (M,) of each cell, the minimum over the views; None if no cell is visible."""
    world = cells.points
    min_variance = np.full(len(world), np.inf)
    for frame, T, C in zip(frames, poses, covariances, strict=True):
        p_camera = se3.transform(se3.inverse(T), world)
        visible = _visible(frame, p_camera, cells.size)
        if np.isfinite(C).all():
            variance = _variance(p_camera[visible], C)
        else:
            variance = np.full(int(visible.sum()), UNKNOWN_M**2)
        min_variance[visible] = np.minimum(min_variance[visible], variance)
    observed = np.isfinite(min_variance)
    if not observed.any():
        return None
    # Cells that are visible in no image take the value of the nearest one.
    nearest, _ = KdTree(world[observed]).nearest(world[~observed])
    min_variance[~observed] = min_variance[observed][nearest]
    return np.asarray(np.sqrt(min_variance), np.float64)


def _visible(frame: RangeFrame, points: Float64, size: float) -> Bool:
    """Return which points (N, 3) in the camera's frame an image measured, (N,)."""
    pixel = np.nan_to_num(np.rint(frame.camera.project(points)), nan=-1.0, posinf=-1, neginf=-1)
    limits = (frame.camera.width, frame.camera.height)
    in_image = ((pixel >= 0) & (pixel < limits)).all(1) & (points[:, 2] > 0)
    column, row = np.where(in_image[:, None], pixel, 0).astype(np.intp).T
    z = frame.z[row, column].astype(np.float64)
    consistent = np.abs(z - points[:, 2]) < _MAX_DEPTH_DIFFERENCE * points[:, 2] + size
    return np.asarray(in_image & (z > 0) & consistent)


def _variance(points: Float64, C: Float64) -> Float64:
    """Return the variance (N,) of points (N, 3) in the camera's frame due to that of its pose, m^2.

    The mean of the three axes, as a perturbation moves a point p by t + r x p; C is (6, 6).
    """
    C_tt, C_rr, C_tr = C[:3, :3], C[3:, 3:], C[:3, 3:]
    squared = (points**2).sum(1)
    # E |r x p|^2, and E t . (r x p) = p . E (t x r).
    by_rotation = squared * np.trace(C_rr) - np.einsum("ni,ij,nj->n", points, C_rr, points)
    skew = np.array([C_tr[1, 2] - C_tr[2, 1], C_tr[2, 0] - C_tr[0, 2], C_tr[0, 1] - C_tr[1, 0]])
    variance = (np.trace(C_tt) + by_rotation + 2 * points @ skew) / 3
    return np.asarray(np.maximum(variance, 0.0), np.float64)
