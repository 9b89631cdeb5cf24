"""The cameras of the 3D view: poses, status of the frames, and accuracy."""

from __future__ import annotations

from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.fusion.pose_errors import UNKNOWN_M
from tofuse.geometry import se3
from tofuse.geometry.cameras import Pinhole, RayTable
from tofuse.normal import OF_95_PERCENT
from tofuse.recordings.frames import RangeFrame
from tofuse.report.fields import normalized_accuracy
from tofuse.report.packing import pack
from tofuse.report.scene import RigCameras
from tofuse.report.subject import Subject
from tofuse.report.words import STATUSES
from tofuse.results.types import FrameRecord


def packed(s: Subject) -> dict[str, Any]:
    """Return every frame for the viewer: its index, status, error and poses.

    Poses (3, 4) are in the axes of the displayed model, row by row, zeros where there is none;
    errors are bytes on the scale of the accuracy field.
    """
    index = s.index.astype(int)
    records = {r.index: r for r in s.result.diagnostics.frames}
    frame_records = [records.get(int(k)) for k in index]
    errors = position_errors(s)
    error_bytes = np.round(255 * normalized_accuracy(errors)).astype(np.uint8)
    before = s.result.diagnostics.sequential
    if before.shape != s.result.trajectory.shape:
        before = np.full_like(s.result.trajectory, np.nan)
    rig = rig_cameras(s)
    return {
        "rig": None
        if rig is None
        else {"colors": rig.colors, "of": pack(rig.of_frames.astype("u1"))},
        "index": pack(index.astype("<u4")),
        "status": "".join(str(STATUSES.index(r.status)) if r else "0" for r in frame_records),
        "errors": pack(error_bytes) if np.isfinite(errors).any() else None,
        "after": _poses(s.result.trajectory, s.R_display_world),
        "before": _poses(before, s.R_display_world),
    }


def lens(s: Subject) -> dict[str, float] | None:
    """Return the intrinsics of the images without distortion, in pixels; None if not known."""
    raw = s.extras.filter_steps[0][1] if s.extras.filter_steps else None
    if not isinstance(raw, RangeFrame) or rig_cameras(s) is not None:
        return None
    camera = raw.camera.fit if isinstance(raw.camera, RayTable) else raw.camera
    assert isinstance(camera, Pinhole)
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def rig_cameras(s: Subject) -> RigCameras | None:
    """Return the cameras of a rig; None for a single camera."""
    return RigCameras.of(s.result.recording.get("rig"), len(s.index))


def position_errors(s: Subject) -> Float64:
    """Return (N,) 95 % bounds in m of the camera centres, in the worst direction.

    `UNKNOWN_M` where a pose is not bounded, NaN where there is none or it was not assessed.
    """
    records = {r.index: r for r in s.result.diagnostics.frames}
    errors = np.full(len(s.index), np.nan)
    unbounded = set(s.result.diagnostics.accuracy.unbounded)
    for row, index in enumerate(s.index.astype(int)):
        record = records.get(int(index))
        if index in unbounded:
            errors[row] = OF_95_PERCENT * UNKNOWN_M
        elif record is not None:
            errors[row] = _bound(record)
    errors[~s.result.has_pose] = np.nan
    return errors


def _bound(record: FrameRecord) -> float:
    C = record.covariance
    if C is None or not np.isfinite(C).all():
        return float("nan")
    return OF_95_PERCENT * float(se3.largest_sigmas(C)[0])


def _poses(poses: Float64, axes: Float64) -> str:
    displayed = np.nan_to_num(axes @ poses[:, :3, :]).reshape(len(poses), 12)
    return pack(displayed.astype("<f4"))
