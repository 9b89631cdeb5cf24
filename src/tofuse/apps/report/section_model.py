"""The model: in 3D with the cameras, from above and from the side, and its size."""

from __future__ import annotations

from typing import Any

import numpy as np

from tofuse.apps.certainty import LengthErrors
from tofuse.apps.report import plots, thumbnails, words
from tofuse.apps.report.fields import accuracy, fields
from tofuse.apps.report.packing import pack
from tofuse.apps.report.scene import CAMERA_COLORS, opening_yaw, packed, render
from tofuse.apps.report.subject import OUTER_ENDS, Subject, Values
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole, RayTable
from tofuse.engine.frames import RangeFrame
from tofuse.engine.fusion import UNKNOWN_M
from tofuse.engine.geometry import se3
from tofuse.engine.normal import OF_95_PERCENT

_SWITCHED = ("after", "before", "reference", "loops")  # parts of the scene


def model(s: Subject) -> Values:
    """Return the data of the 3D view, its switches, and a rendered image of it."""
    scene = s.scene
    if len(scene.points) == 0 and len(scene.after) == 0:
        return {"scene": None}
    displayed = scene.view_rotation(s.R_display_world)
    errors = position_errors(s)
    shown = fields(displayed, errors) if len(scene.points) else []
    rig = s.result.recording.get("rig")
    if rig and len(rig["of_frames"]) != len(s.index):
        rig = None
    names = rig["cameras"] if rig else ()
    colors = [CAMERA_COLORS[k % len(CAMERA_COLORS)] for k in range(len(names))]
    if scene.mesh is not None:
        total = 0 if s.result.mesh is None else len(s.result.mesh.faces)
        thinned = words.thinned(len(scene.mesh.faces), total, "triangles")
    else:
        thinned = words.thinned(len(scene.points), scene.total, "points")
    return {
        "scene": packed(displayed)
        | {
            "fields": {field.name: field.packed() for field in shown},
            "frames": {
                "rig": rig and {"colors": colors, "of": pack(np.array(rig["of_frames"], "u1"))},
                **_packed_cameras(s, errors),
            },
            "lens": None if rig else _lens(s),
            "axes": s.R_display_world.tolist(),
            "lengths": _lengths(s),
        },
        "still": thumbnails.data_uri(render(displayed, yaw=opening_yaw(displayed))),
        "has": {
            "mesh": scene.mesh is not None,
            "normals": scene.mesh is not None or scene.normals is not None,
            **{name: len(getattr(scene, name)) for name in _SWITCHED},
        },
        "colorings": [("", _color_source(s)), *((field.name, field.label) for field in shown)],
        "cameras": list(zip(names, colors, strict=True)),
        "thinned": thinned,
    }


def _color_source(s: Subject) -> str:
    """The source of the model's colours: colour images, amplitude, or heights, shaded."""
    mesh = s.scene.mesh
    color = s.result.cloud.color if mesh is None else mesh.color
    if color is None or not len(color):
        return "Shape"
    grey = bool((np.ptp(color, axis=1) == 0).all())
    return "Amplitude" if grey else "Colour"


def _packed_cameras(s: Subject, errors: Float64) -> dict[str, Any]:
    """Every frame for the viewer: its index, status, error and poses.

    Poses (3, 4) are in the axes of the displayed model, row by row, zeros where there is none;
    errors are bytes on the scale of the accuracy field.
    """
    records = {r.index: r for r in s.result.diagnostics.frames}
    index = s.index.astype(int)
    statuses = [records[k].status if k in records else "tracked" for k in index.tolist()]
    error_bytes = np.round(255 * accuracy(errors).normalized(errors)).astype(np.uint8)

    def displayed(poses: Float64) -> str:
        rows = np.nan_to_num(s.R_display_world @ poses[:, :3]).reshape(len(poses), 12)
        return pack(rows.astype("<f4"))

    return {
        "index": pack(index.astype("<u4")),
        "status": "".join(str(words.STATUSES.index(status)) for status in statuses),
        "errors": pack(error_bytes) if np.isfinite(errors).any() else None,
        "after": displayed(s.result.trajectory),
        "before": displayed(s.sequential),
    }


def _lens(s: Subject) -> dict[str, float] | None:
    """Intrinsics of the images without distortion, in pixels; None if not known."""
    raw = s.extras.filter_steps[0][1] if s.extras.filter_steps else None
    if not isinstance(raw, RangeFrame):
        return None
    camera = raw.camera.fit if isinstance(raw.camera, RayTable) else raw.camera
    assert isinstance(camera, Pinhole)
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def _lengths(s: Subject) -> Values | None:
    frame = s.extras.filter_steps[0][1] if s.extras.filter_steps else None
    errors = LengthErrors.of(s.result, frame if isinstance(frame, RangeFrame) else None)
    return None if errors is None else packed_lengths(errors)


def packed_lengths(errors: LengthErrors) -> Values:
    """Return what the errors of lengths follow from, for `makeLengths` of `measure.js`."""
    return {
        "centre": errors.centre.tolist(),
        "points": pack(errors.points),
        "weights": pack(errors.weights),
        "cameras": pack(errors.cameras),
        "sights": pack(errors.sights),
        "covariance": pack(errors.covariance[np.tril_indices(len(errors.covariance))]),
        "bounds": dict(errors.bounds),
    }


def position_errors(s: Subject) -> Float64:
    """Return (N,) 95 % bounds in m of the camera centres, in the worst direction.

    `UNKNOWN_M` where a pose is not bounded, NaN where there is none or it was not assessed. The
    only camera defines the world: nothing was assessed.
    """
    covariances = {r.index: r.covariance for r in s.result.diagnostics.frames}
    unbounded = set(s.result.diagnostics.accuracy.unbounded)
    errors = np.full(len(s.index), np.nan)
    for row, index in enumerate(s.index.astype(int).tolist()):
        C = covariances.get(index)
        if index in unbounded:
            errors[row] = OF_95_PERCENT * UNKNOWN_M
        elif C is not None and np.isfinite(C).all():
            errors[row] = OF_95_PERCENT * float(se3.largest_sigmas(C)[0])
    errors[~s.result.has_pose] = np.nan
    return errors if np.isfinite(errors).sum() > 1 else np.full_like(errors, np.nan)


def views(s: Subject) -> Values:
    """Return the drawings from above and from the side, and the table of sizes."""
    if len(s.scene.points) == 0:
        return {"figures": []}
    R = s.R_display_world
    truth = None if s.truth is None else s.truth @ R.T

    def drawing(points: Float64, poses: Float64, view: str, name: str) -> Values:
        measured = np.percentile(points, OUTER_ENDS, axis=0)
        path, label = poses[:, :3, 3] @ R.T, f"Model, {name}"
        return plots.model(points, path, truth, view, measured=measured, label=label)

    points = s.scene.points @ R.T
    shown = [
        (points, s.scene.after, "above", "From above"),
        (points, s.scene.after, "side", "From the side"),
    ]
    before = s.result.diagnostics.cloud_before
    if before is not None and len(before):
        earlier = before.points[np.isfinite(before.points).all(1)].astype(float) @ R.T
        name = "From above, before optimisation"
        shown.insert(0, (earlier, s.scene.before, "above", name))
    every = s.result.cloud.points @ R.T.astype(np.float32)
    every = every[np.isfinite(every).all(1)]
    sizes = [
        np.ptp(np.percentile(points, OUTER_ENDS, axis=0), axis=0),
        np.ptp(every, axis=0),
        np.zeros(3) if truth is None else np.ptp(truth, axis=0),
    ]
    return {
        "figures": {drawn[-1]: drawing(*drawn) for drawn in shown},
        "sizes": [
            (name, *map(float, row))
            for name, row in zip(("width", "height", "depth"), np.stack(sizes, 1), strict=True)
        ],
        "exact": truth is not None,
        "path": len(s.scene.after),
        "angle": float(np.degrees(se3.angle(R))),
    }
