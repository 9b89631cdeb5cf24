"""The model: in 3D, from above and from the side, and its size."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.geometry import se3
from tofuse.report import camera_frusta, plots, thumbnails, words
from tofuse.report.fields import fields
from tofuse.report.scene import Scene, opening_yaw, packed, render
from tofuse.report.subject import OUTER, Figure, Subject, Values


def model(s: Subject) -> Values:
    """Return the data of the 3D view, and a rendered image of it."""
    scene = s.scene
    if len(scene.points) == 0 and len(scene.after) == 0:
        return {
            "scene": None,
            "still": "",
            "toggles": [],
            "colorings": [],
            "rig": [],
            "thinned": "",
        }
    displayed = scene.view_rotation(s.R_display_world)
    fields_by_name = (
        {field.name: field for field in fields(displayed, camera_frusta.position_errors(s))}
        if len(scene.points)
        else {}
    )
    color_source = _color_source(s)
    data = packed(displayed) | {
        "fields": {name: field.packed() for name, field in fields_by_name.items()},
        "frames": camera_frusta.packed(s),
        "lens": camera_frusta.lens(s),
        "axes": s.R_display_world.tolist(),
    }
    return {
        "scene": data,
        "still": thumbnails.data_uri(render(displayed, yaw=opening_yaw(displayed))),
        "toggles": _toggles(scene),
        "rig": _rig(s),
        "colorings": ([("", color_source)] if color_source else [])
        + [(name, field.label) for name, field in fields_by_name.items()],
        "thinned": _thinned(scene),
    }


def _toggles(scene: Scene) -> list[tuple[str, str, str, bool]]:
    """Name, label, colour and initial state of the switches below the view."""
    out = []
    if scene.mesh is not None:
        out.append(("mesh", "Surface", "", True))
    out.append(("points", "Points", "", scene.mesh is None))
    if scene.normals is not None or scene.mesh is not None:
        out.append(("peel", "Hide walls seen from behind", "", True))
    if len(scene.after):
        out.append(("after", "Cameras", "#5ab0f5", True))
    if len(scene.before):
        out.append(("before", "Cameras before optimisation", "#f0a03c", False))
    if len(scene.reference):
        out.append(("reference", "Reference trajectory", "#d8dade", False))
    if len(scene.loops):
        out.append(("loops", "Loop closures", "#5fd08a", True))
    return out


def _rig(s: Subject) -> list[tuple[str, str]]:
    """Name and colour of each camera of a rig."""
    rig = camera_frusta.rig_cameras(s)
    if rig is None:
        return []
    return [
        (name, f"rgb{color}".replace(" ", ""))
        for name, color in zip(rig.names, rig.colors, strict=True)
    ]


def _color_source(s: Subject) -> str:
    """The source of the model's colours: colour images or amplitude; empty without any."""
    mesh = s.scene.mesh
    color = s.result.cloud.color if mesh is None else mesh.color
    if color is None or not len(color):
        return ""
    grey = bool((np.ptp(color, axis=1) == 0).all())
    return "Amplitude" if grey else "Colour"


def _thinned(scene: Scene) -> str:
    if scene.mesh is not None and scene.surface is not None:
        shown, total, unit = len(scene.mesh.faces), len(scene.surface.faces), "triangles"
    else:
        shown, total, unit = len(scene.points), scene.total, "points"
    return "" if shown == total else f"{shown:,} of {total:,} {unit} are shown."


def views(s: Subject) -> Values:
    """Return the drawings from above and from the side, and the table of sizes."""
    if len(s.scene.points) == 0:
        return dict.fromkeys(("views", "sizes", "views_legend", "views_note"), "") | {
            "true_sizes": False
        }
    R = s.R_display_world
    points = s.scene.points @ R.T
    truth = None if s.truth is None else s.truth @ R.T
    path = s.scene.after[:, :3, 3] @ R.T
    measured = np.percentile(points, [OUTER, 100 - OUTER], axis=0)
    figures = [
        Figure(
            plots.model(points, path, truth, view, measured=measured, label=f"Model, {name}"), name
        )
        for view, name in (("above", "From above"), ("side", "From the side"))
    ]
    before = s.result.diagnostics.cloud_before
    if before is not None and len(before):
        points_before = (before.points[np.isfinite(before.points).all(1)] + before.offset) @ R.T
        name = "From above, before optimisation"
        extents = np.percentile(points_before, [OUTER, 100 - OUTER], axis=0)
        path_before = s.scene.before[:, :3, 3] @ R.T
        svg = plots.model(
            points_before, path_before, truth, "above", measured=extents, label=f"Model, {name}"
        )
        figures.insert(0, Figure(svg, name))
    legend = [("after", "", "measured extents")]
    if len(path):
        legend.append(("ink", "", "camera trajectory (dot: start)"))
    if truth is not None:
        legend.insert(0, ("bad", "6 3", "true outline"))
    return {
        "views": figures,
        "sizes": _sizes(s.result.cloud.points @ R.T.astype(np.float32), measured, truth),
        "true_sizes": truth is not None,
        "views_legend": legend,
        "views_note": _axes_note(R),
    }


def _sizes(points: Float32, measured: Float64, truth: Float64 | None) -> list[list[str]]:
    """Extents of the model without outliers, by its corners `measured`, and of all its points."""
    rows = []
    points = points[np.isfinite(points).all(1)]
    for axis, name in enumerate(("width", "height", "depth")):
        extent = float(np.ptp(measured[:, axis]))
        row = [name, words.length(extent), words.length(float(np.ptp(points[:, axis])))]
        if truth is not None:
            true_extent = float(np.ptp(truth[:, axis]))
            row[1:1] = [words.length(true_extent)]
            row[3:3] = [words.signed_length(extent - true_extent)]
        rows.append(row)
    return rows


def _axes_note(R: Float64) -> str:
    angle = float(np.degrees(se3.angle(R)))
    text = "Axes: right, down and forward of the first camera"
    if angle < 0.5:
        return text + "."
    return f"{text}, rotated by {angle:.0f}° so that the model is upright and axis-aligned."
