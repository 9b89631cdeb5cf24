"""The model: in 3D, from above and from the side, and its size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.report import images, plots, words
from tofuse.report.fields import fields
from tofuse.report.scene import packed, still
from tofuse.report.subject import OUTER, Figure, Subject, Values

Float64 = NDArray[np.float64]


def model(s: Subject) -> Values:
    """Return the data of the 3D view and its still."""
    scene = s.scene
    if len(scene.points) == 0 and len(scene.after) == 0:
        return {"scene": None, "still": "", "toggles": [], "colorings": [], "thinned": ""}
    toggles = [("points", "Points", "", scene.mesh is None)]
    if scene.mesh is not None:
        toggles.insert(0, ("mesh", "Surface", "", True))
    if scene.normals is not None:
        toggles.append(("peel", "Hide walls seen from behind", "", True))
    if len(scene.before):
        toggles.append(("before", "Cameras before", "#f0a03c", False))
    if len(scene.after):
        toggles.append(("after", "Cameras after", "#5ab0f5", True))
    if len(scene.reference):
        toggles.append(("reference", "Reference path", "#8a8f98", False))
    if len(scene.loops):
        toggles.append(("loops", "Loops", "#5fd08a", True))
    laid = scene.turned(s.straight)
    by = {field.name: field for field in fields(laid)} if len(scene.points) else {}
    own = [("", "Colour")] if s.result.cloud.color is not None else []
    shown = len(scene.points)
    thinned = "" if shown == scene.total else f"{shown:,} of {scene.total:,} points are shown."
    return {
        "scene": packed(laid) | {"fields": {name: field.packed() for name, field in by.items()}},
        "still": images.data_uri(still(laid)),
        "toggles": toggles,
        "colorings": own + [(name, field.label) for name, field in by.items()],
        "thinned": thinned,
    }


def views(s: Subject) -> Values:
    """Return the drawings from above and from the side, and the table of sizes."""
    if len(s.points) == 0:
        return dict.fromkeys(("views", "sizes", "views_legend", "views_note"), "") | {
            "true_sizes": False
        }
    R = s.straight
    points = s.points @ R.T
    true = None if s.truth is None else s.truth @ R.T
    path = s.scene.after[:, :3, 3] @ R.T
    measured = np.percentile(points, [OUTER, 100 - OUTER], axis=0)
    figures = [
        Figure(
            plots.model(points, path, true, view, measured=measured, label=f"Model, {name}"), name
        )
        for view, name in (("above", "From above"), ("side", "From the side"))
    ]
    before = s.result.diagnostics.cloud_before
    if before is not None and len(before):
        earlier = (before.points[np.isfinite(before.points).all(1)] + before.offset) @ R.T
        name = "From above, before optimisation"
        extents = np.percentile(earlier, [OUTER, 100 - OUTER], axis=0)
        start = s.scene.before[:, :3, 3] @ R.T
        drawn = plots.model(earlier, start, true, "above", measured=extents, label=f"Model, {name}")
        figures.insert(0, Figure(drawn, name))
    legend = [("after", "", "measured extents")]
    if len(path):
        legend.append(("ink", "", "path of the camera, a dot where it begins"))
    if true is not None:
        legend.insert(0, ("bad", "6 3", "true outline"))
    return {
        "views": figures,
        "sizes": _sizes(points, measured, true),
        "true_sizes": true is not None,
        "views_legend": legend,
        "views_note": _turn_note(R),
    }


def _sizes(points: Float64, measured: Float64, true: Float64 | None) -> list[list[str]]:
    rows = []
    for axis, name in enumerate(("width", "height", "depth")):
        got = float(np.ptp(measured[:, axis]))
        row = [name, words.length(got), words.length(float(np.ptp(points[:, axis])))]
        if true is not None:
            exact = float(np.ptp(true[:, axis]))
            row[1:1] = [words.length(exact)]
            row[3:3] = [words.signed_length(got - exact)]
        rows.append(row)
    return rows


def _turn_note(R: Float64) -> str:
    angle = float(np.degrees(se3.angle(R)))
    text = "Right, down and forward are those of the first camera"
    if angle < 0.5:
        return text + "."
    return f"{text}, turned by {angle:.0f}° so that the model lies straight."
