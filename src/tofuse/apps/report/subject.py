"""The input of the sections of a report, in the axes in which the model is shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tofuse.apps.report.extras import ReportExtras
from tofuse.apps.report.scene import Scene, finite_poses, make_scene
from tofuse.engine.arrays import Float64
from tofuse.engine.results import Reconstruction

Values = dict[str, Any]

OUTER = 0.25  # percent of the points at each end that the measured size excludes
OUTER_ENDS = (OUTER, 100 - OUTER)
INNER_ENDS = (4 * OUTER, 100 - 4 * OUTER)  # those of the bulk
ROWS = 150  # maximum in a table
_ANGLES = np.arange(-44.5, 45.5, 0.5)[:, None]  # degrees
_MIN_BOX_FILL = 0.9  # minimum fraction of a box in the hull of points that have its shape
_MAX_SAMPLES = 5000  # maximum number of sampled points
_MIN_DOWN = 0.5  # length of the mean of the vertical in the images; less if they look down, or vary


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

    @property
    def image_turn(self) -> int:
        """Degrees clockwise by which images are shown, so that those of most frames are upright.

        A multiple of 90, as phones store images alike however they are held; 0 where it is open.
        """
        posed = finite_poses(self.result.trajectory)
        x, y, _ = (
            (self.R_display_world[1] @ posed[:, :3, :3]).mean(0) if len(posed) else np.zeros(3)
        )
        if np.hypot(x, y) < _MIN_DOWN:
            return 0
        return round(np.degrees(np.arctan2(x, y)) / 90) % 4 * 90

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
        scene = make_scene(result, rows, reference, extras.texture)
        truth = extras.truth_points
        if truth is not None:
            truth = truth[np.isfinite(truth).all(1)]
        truth_points = truth.astype(float) if truth is not None and len(truth) else None
        R_up_world = np.diag([1.0, -1.0, -1.0]) @ result.T_up_world[:3, :3]
        if truth_points is None:
            R = _upright_axes(scene.points @ R_up_world.T, OUTER) @ R_up_world
        else:
            R_up_world = _levelled(truth_points @ R_up_world.T) @ R_up_world
            R = _upright_axes(truth_points @ R_up_world.T, 0.0) @ R_up_world
        return cls(result, extras, index, sequential, reference, scene, truth_points, R)


def _row_indices(result: Reconstruction) -> Float64:
    """Return the frame index of each row of the trajectory."""
    records = result.diagnostics.frames
    rows = len(result.trajectory)
    for candidates in (records, [r for r in records if r.status != "skipped"]):
        if len(candidates) == rows:
            return np.array([r.index for r in candidates], float)
    return np.arange(rows, dtype=float)


def _levelled(points: Float64) -> Float64:
    """Return the rotation (3, 3) that makes the floor of an exact box level, with y vertical."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError:  # coplanar points
        return np.eye(3)
    normals = hull.equations[:, :3]
    floor = normals[normals[:, 1].argmax()]
    R = Rotation.align_vectors([[0.0, 1.0, 0.0]], [floor])[0].as_matrix()
    extents = np.ptp(points @ (_upright_axes(points @ R.T, 0.0) @ R).T, axis=0)
    is_box = hull.volume > _MIN_BOX_FILL * extents.prod()
    return np.asarray(R if is_box else np.eye(3), np.float64)


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
    (3, 3) rotation, by less than 45 degrees; its rows are the model's axes.
    """
    if len(points) < 3:
        return np.eye(3)
    sampled = points[:: -(-len(points) // _MAX_SAMPLES)]
    rotations = Rotation.from_euler("y", _ANGLES, degrees=True).as_matrix()
    coordinates = np.einsum("aki,ni->akn", rotations[:, ::2], sampled)
    extents = np.ptp(np.percentile(coordinates, [outer, 100 - outer], axis=2), axis=0)
    return np.asarray(rotations[int(extents.prod(1).argmin())], np.float64)
