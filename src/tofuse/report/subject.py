"""The input of the sections of a report, and the elements that they consist of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.report import display_axes
from tofuse.report.extras import ReportExtras
from tofuse.report.scene import Scene, finite_poses, make_scene
from tofuse.results.types import Reconstruction

Values = dict[str, Any]

OUTER = 0.25  # percent of the points at each end that the measured size excludes
ROWS = 150  # maximum in a table


@dataclass(frozen=True)
class Figure:
    """An inline SVG and its caption."""

    svg: str
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Subject:
    """The result, with data that several sections need.

    Attributes
    ----------
    index
        (N,) frame index of each row of the trajectory.
    rows
        The row of each frame index.
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
    rows: dict[int, int]
    reference: Float64 | None
    scene: Scene
    truth: Float64 | None
    R_display_world: Float64

    @classmethod
    def of(cls, result: Reconstruction, extras: ReportExtras) -> Subject:
        """Prepare a result; a reference without any pose in common is ignored."""
        index = _row_indices(result)
        rows = {int(k): row for row, k in enumerate(index)}
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
        points = (
            scene.points @ R_up_world.T if truth_points is None else truth_points @ R_up_world.T
        )
        R_display_up = (
            display_axes.upright_axes(points, OUTER)
            if truth_points is None
            else display_axes.box_axes(points)
        )
        return cls(
            result, extras, index, rows, reference, scene, truth_points, R_display_up @ R_up_world
        )


def _row_indices(result: Reconstruction) -> Float64:
    """Return the frame index of each row of the trajectory."""
    records = result.diagnostics.frames
    rows = len(result.trajectory)
    for candidates in (records, [r for r in records if r.status != "skipped"]):
        if len(candidates) == rows:
            return np.array([r.index for r in candidates], float)
    return np.arange(rows, dtype=float)
