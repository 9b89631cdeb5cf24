"""The input of the sections of a report, in the axes in which the model is shown."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np

from tofuse.apps.report.extras import ReportExtras
from tofuse.apps.report.scene import Scene, finite_poses, make_scene
from tofuse.engine.arrays import Float64
from tofuse.engine.results import Reconstruction

Values = dict[str, Any]

OUTER = 0.25  # percent of the points at each end that the measured size excludes
ROWS = 150  # maximum in a table
_ANGLES = np.radians(np.arange(0, 90, 0.5))
_MIN_BOX_FILL = 0.9  # minimum fraction of a box in the hull of points that have its shape
_MAX_SAMPLES = 5000  # maximum number of sampled points


@dataclass(frozen=True, eq=False)
class Subject:
    """The result, with data that several sections need.

    Attributes
    ----------
    index
        (N,) frame index of each row of the trajectory.
    sequential
        (N, 4, 4) poses before optimisation, NaN where there is none.
    scene
        Content of the 3D view; plans and sizes are of its points, too.
    truth
        (K, 3) finite points of the true surfaces, world frame.
    R_display_world
        (3, 3) axes, as rows, in which the model is shown: x right, y down, z forward, upright by
        `Reconstruction.T_up_world`, and rotated so that the model is aligned with them.
    """

    result: Reconstruction
    extras: ReportExtras
    index: Float64
    sequential: Float64
    reference: Float64 | None
    scene: Scene
    truth: Float64 | None
    R_display_world: Float64

    @classmethod
    def of(cls, result: Reconstruction, extras: ReportExtras) -> Subject:
        """Prepare a result; a reference without any pose in common is ignored."""
        index = _row_indices(result)
        rows = {int(k): row for row, k in enumerate(index)}
        sequential = result.diagnostics.sequential
        if sequential.shape != result.trajectory.shape:
            sequential = np.full_like(result.trajectory, np.nan)
        reference = extras.reference
        if reference is not None and (
            reference.shape != result.trajectory.shape
            or len(finite_poses(reference[result.has_pose])) == 0
        ):
            reference = None
        scene = make_scene(result, rows, reference)
        truth = extras.truth_points
        if truth is not None:
            truth = truth[np.isfinite(truth).all(1)]
        truth_points = truth.astype(float) if truth is not None and len(truth) else None
        R_up_world = np.diag([1.0, -1.0, -1.0]) @ result.T_up_world[:3, :3]
        if truth_points is None:
            R_display_up = _upright_axes(scene.points @ R_up_world.T, OUTER)
        else:
            R_display_up = _box_axes(truth_points @ R_up_world.T)
        R = R_display_up @ R_up_world
        return cls(result, extras, index, sequential, reference, scene, truth_points, R)


def _row_indices(result: Reconstruction) -> Float64:
    """Return the frame index of each row of the trajectory."""
    records = result.diagnostics.frames
    rows = len(result.trajectory)
    for candidates in (records, [r for r in records if r.status != "skipped"]):
        if len(candidates) == rows:
            return np.array([r.index for r in candidates], float)
    return np.arange(rows, dtype=float)


def _upright_axes(points: Float64, outer: float) -> Float64:
    """Find the rotation about the vertical that minimises the bounding rectangle from above.

    Parameters
    ----------
    points
        (N, 3) in m, y vertical.
    outer
        Percent of the points at each end that are ignored.

    Returns
    -------
    (3, 3) rotation; its rows are the model's axes, as close to x, y, z as possible.
    """
    if len(points) < 3:
        return np.eye(3)
    sampled = points[:: -(-len(points) // _MAX_SAMPLES)]
    axes = _rotated_axes(np.array([0.0, 1.0, 0.0]))
    coordinates = np.einsum("aki,ni->akn", axes[:, ::2], sampled)
    extents = np.ptp(np.percentile(coordinates, [outer, 100 - outer], axis=2), axis=0)
    return _nearest_axes(axes[int(extents.prod(1).argmin())])


def _box_axes(points: Float64) -> Float64:
    """Return the axes of the smallest box around exact points, with one side on a hull face.

    Like `_upright_axes`, but any direction may be vertical if the points have the shape of a box;
    otherwise, and for coplanar points, only rotations about y are tried.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return _upright_axes(points, 0.0)
    corners = points[hull.vertices]
    faces = np.unique(np.round(np.abs(hull.equations[:, :3]), 2), axis=0, return_index=True)[1]
    best, min_volume = np.eye(3), np.inf
    for face in faces[:400]:
        axes = _rotated_axes(hull.equations[face, :3])
        volumes = np.ptp(axes @ corners.T, axis=2).prod(1)
        k = int(volumes.argmin())
        # Earlier boxes are preferred to ones that are hardly smaller.
        if volumes[k] < (1 - 1e-6) * min_volume:
            best, min_volume = axes[k], float(volumes[k])
    if hull.volume < _MIN_BOX_FILL * min_volume:
        return _upright_axes(points, 0.0)
    return _nearest_axes(best)


def _rotated_axes(vertical: Float64) -> Float64:
    """Return (A, 3, 3) axes with the second along `vertical`, rotated about it."""
    vertical = vertical / np.linalg.norm(vertical)
    helper = np.eye(3)[int(np.abs(vertical).argmin())]
    first = np.cross(helper, vertical)
    first /= np.linalg.norm(first)
    third = np.cross(first, vertical)
    c, s = np.cos(_ANGLES)[:, None], np.sin(_ANGLES)[:, None]
    a = c * first + s * third
    b = -s * first + c * third
    return np.stack([a, np.broadcast_to(vertical, a.shape), b], axis=1)


def _nearest_axes(axes: Float64) -> Float64:
    """Reorder and flip rows so that they are right-handed and closest to x, y and z."""
    best, max_trace = np.eye(3), -np.inf
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            R = axes[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(R) > 0 and np.trace(R) > max_trace:
                best, max_trace = R, float(np.trace(R))
    return best
