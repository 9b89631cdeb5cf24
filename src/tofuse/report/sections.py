"""What goes into each section of the report, as plain values for the template."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse._version import __version__
from tofuse.geometry import se3
from tofuse.recordings.frames import RangeFrame
from tofuse.report import images, plots, straight, words
from tofuse.report.extras import ReportExtras
from tofuse.report.scene import Scene, finite, make_scene, packed, still
from tofuse.results.types import FrameRecord, Reconstruction

Float64 = NDArray[np.float64]
Values = dict[str, Any]

_OUTER = 0.25  # percent of the points at each end that do not count for the measured size
_STRIP = 600  # cells in the strip of frames
_ROWS = 150  # in a table
_THUMBNAIL, _FILTER = 220, 320  # px


@dataclass(frozen=True)
class Figure:
    """An inline SVG and what is said below it."""

    svg: str
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Subject:
    """The result with what several sections need of it.

    Attributes
    ----------
    index
        (N,) frame index of each row of the trajectory.
    rows
        The row of each frame index.
    points, truth
        (N, 3) and (K, 3) finite points of the model and of the true surfaces, world frame.
    straight
        (3, 3) axes, as rows, in which the model lies straight.
    """

    result: Reconstruction
    extras: ReportExtras
    index: Float64
    rows: dict[int, int]
    reference: Float64 | None
    scene: Scene
    points: Float64
    truth: Float64 | None
    straight: Float64


def sections(result: Reconstruction, extras: ReportExtras) -> Values:
    """Return all values that the template shows."""
    index = _row_indices(result)
    rows = {int(k): row for row, k in enumerate(index)}
    reference = extras.reference
    if reference is not None and (
        reference.shape != result.trajectory.shape or len(finite(reference[result.has_pose])) == 0
    ):
        reference = None
    scene = make_scene(result, rows, reference)
    cloud, truth = result.cloud, extras.truth_points
    points = cloud.points[np.isfinite(cloud.points).all(1)].astype(float) + cloud.offset
    if truth is not None:
        truth = truth[np.isfinite(truth).all(1)]
    true = truth.astype(float) if truth is not None and len(truth) else None
    axes = straight.upright(points, _OUTER) if true is None else straight.boxed(true)
    subject = Subject(result, extras, index, rows, reference, scene, points, true, axes)
    out: Values = {}
    parts: tuple[Callable[[Subject], Values], ...] = (
        _verdict,
        _model,
        _views,
        _cameras,
        _error,
        _objective,
        _filters,
        _frames,
        _loops,
        _thumbnails,
        _timings,
        _settings,
    )
    for part in parts:
        out.update(part(subject))
    if out["sizes"]:
        size = " × ".join(row[2 if out["true_sizes"] else 1] for row in out["sizes"])
        out["facts"].insert(5, ("width × height × depth", size))
    names = {
        "verdict": "Verdict",
        "model": "3D model",
        "views": "Sizes",
        "cameras": "Cameras",
        "error": "Error" if reference is not None else "Displacement",
        "objective": "Objective",
        "filters": "Filters",
        "frames": "Frames",
        "loops": "Loops",
        "recording": "Recording",
        "timings": "Time",
        "settings": "Settings",
        "reading": "How to read this",
    }
    if not out["thumbnails"]:
        del names["recording"]
    out["contents"] = list(names.items())
    return out


def _row_indices(result: Reconstruction) -> Float64:
    """Return the frame index of each row of the trajectory."""
    records = result.diagnostics.frames
    number = len(result.trajectory)
    for chosen in (records, [r for r in records if r.status != "skipped"]):
        if len(chosen) == number:
            return np.array([r.index for r in chosen], float)
    return np.arange(number, dtype=float)


def _verdict(s: Subject) -> Values:
    result = s.result
    found = words.findings(result.diagnostics.reasons, len(result.diagnostics.frames))
    text = words.verdict_sentence(result, found)
    head, _, tail = text.partition(":")
    statuses: list[str] = [f.status for f in result.diagnostics.frames]
    facts = [(f"frames {name}", f"{statuses.count(name):,}") for name in words.STATUSES]
    facts.append(("model", words.count(s.scene.total, "point")))
    path = s.scene.after[:, :3, 3]
    if len(path) > 1:
        travelled = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        facts.append(("camera travelled", words.length(travelled)))
    closed = sum(p.accepted for p in result.diagnostics.loops)
    facts.append(("loops closed", f"{closed:,}"))
    return {
        "title": s.extras.title,
        "subtitle": _subtitle(result),
        "verdict": result.diagnostics.verdict,
        "verdict_head": head + ":",
        "verdict_tail": tail,
        "facts": facts,
        "findings": found,
    }


def _subtitle(result: Reconstruction) -> str:
    recording = result.recording
    parts = [words.count(len(result.diagnostics.frames), "frame")]
    if recording.get("format"):
        parts.append(f"format {recording['format']}")
    method = result.config.get("method")
    if method:
        parts.append(f"method {method}")
    return ", ".join([*parts, f"tofuse {__version__}"])


def _model(s: Subject) -> Values:
    scene = s.scene
    if len(scene.points) == 0 and len(scene.after) == 0:
        return {"scene": None, "still": "", "toggles": [], "thinned": ""}
    toggles = [("points", "Points", "", True)]
    if scene.normals is not None:
        toggles.append(("peel", "Hide walls seen from behind", "", True))
    if len(scene.points):
        toggles.append(("height", "Colour by height", "", s.result.cloud.color is None))
    if len(scene.before):
        toggles.append(("before", "Cameras before", "#f0a03c", False))
    if len(scene.after):
        toggles.append(("after", "Cameras after", "#5ab0f5", True))
    if len(scene.reference):
        toggles.append(("reference", "Reference path", "#8a8f98", False))
    if len(scene.loops):
        toggles.append(("loops", "Loops", "#5fd08a", True))
    laid = scene.turned(s.straight)
    shown = len(scene.points)
    thinned = "" if shown == scene.total else f"{shown:,} of {scene.total:,} points are shown."
    return {
        "scene": packed(laid),
        "still": images.data_uri(still(laid)),
        "toggles": toggles,
        "thinned": thinned,
    }


def _views(s: Subject) -> Values:
    if len(s.points) == 0:
        return dict.fromkeys(("views", "sizes", "views_legend", "views_note"), "") | {
            "true_sizes": False
        }
    R = s.straight
    points = s.points @ R.T
    true = None if s.truth is None else s.truth @ R.T
    path = s.scene.after[:, :3, 3] @ R.T
    measured = np.percentile(points, [_OUTER, 100 - _OUTER], axis=0)
    figures = [
        Figure(
            plots.model(points, path, true, view, measured=measured, label=f"Model, {name}"), name
        )
        for view, name in (("above", "From above"), ("side", "From the side"))
    ]
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


def _cameras(s: Subject) -> Values:
    before, after = s.scene.before, s.scene.after
    if len(after) < 2:
        return {"cameras": [], "cameras_legend": [], "moved": ""}
    figures = []
    groups = [before, after] + ([s.scene.reference] if s.reference is not None else [])
    for view, name in (("above", "from above"), ("side", "from the side")):
        flat = [plots.project(g[:, :3, 3], view) for g in groups]
        box = plots.limits(*flat, room=0.11, least=0.01)
        for poses, color, when in ((before, plots.BEFORE, "before"), (after, plots.AFTER, "after")):
            title = f"{when}, {name}"
            if len(poses):
                drawing = plots.cameras(
                    poses,
                    box,
                    view,
                    color=color,
                    label=f"Cameras {title}",
                    loops=s.scene.loops if when == "after" else None,
                    reference=s.scene.reference if s.reference is not None else None,
                )
                figures.append(Figure(drawing, title[0].upper() + title[1:]))
    legend = [("before", "", "cameras before"), ("after", "", "cameras after")]
    if len(s.scene.loops):
        legend.append(("loop", "", "loops closed"))
    if s.reference is not None:
        legend.append(("reference", "2 3", "reference path"))
    return {"cameras": figures, "cameras_legend": legend, "moved": _moved(s)}


def _moved(s: Subject) -> str:
    sequential = s.result.diagnostics.sequential
    if sequential.shape != s.result.trajectory.shape:
        return ""
    both = np.isfinite(sequential[:, 0, 0]) & s.result.has_pose
    if not both.any():
        return ""
    shift = np.linalg.norm(s.result.trajectory[:, :3, 3] - sequential[:, :3, 3], axis=1)
    shift[~both] = 0
    k = int(shift.argmax())
    if shift[k] < 1e-6:
        return "Optimisation moved no camera: the path is that of frame-by-frame registration."
    return (
        f"Optimisation moved the cameras by up to {words.length(float(shift[k]))}, "
        f"most at frame {int(s.index[k])}."
    )


def _error(s: Subject) -> Values:
    result, reference = s.result, s.reference
    compared = reference is not None
    title = "Cumulative error" if compared else "Displacement from the first camera"
    after, before = result.trajectory, result.diagnostics.sequential
    if before.shape != after.shape:
        before = np.full_like(after, np.nan)
    if int(result.has_pose.sum()) < 2:
        return {"error": [], "error_title": title} | dict.fromkeys(
            ("error_text", "error_legend", "error_rows"), ""
        )
    names = (("Before", before, plots.BEFORE, "--"), ("After", after, plots.AFTER, "-"))
    offsets = [_offsets(poses, reference) for _, poses, _, _ in names]
    bad = s.index[~result.has_pose]
    what = "error" if compared else "displacement"
    figures = []
    for k, axis in enumerate(("x (right)", "y (down)", "z (forward)", "rotation")):
        scale, unit = (180 / np.pi, "degrees") if k == 3 else (1.0, "m")
        rows = [o[:, k] * scale for o in offsets]
        if k < 3 and max(np.nanmax(np.abs(r)) for r in rows if np.isfinite(r).any()) < 0.1:
            rows, unit = [1000 * r for r in rows], "mm"
        series = [(r, color, style) for r, (_, _, color, style) in zip(rows, names, strict=True)]
        label = f"{what.capitalize()} in {axis} over frames, before and after optimisation"
        drawn = plots.lines(
            s.index, series, label=label, ylabel=f"{axis}, {unit}", zero=True, bad=bad
        )
        figures.append(Figure(drawn))
    text = (
        "Estimated minus reference position along each axis of the first camera, "
        "both starting at the identity, without further alignment."
        if compared
        else "There is no reference for this recording, so this is the displacement relative to "
        "the first camera: where the camera truly came back, what is left is error."
    )
    legend = [("before", "6 3", "before optimisation"), ("after", "", "after optimisation")]
    if len(bad):
        legend.append(("bad", "x", f"{words.count(len(bad), 'frame')} without a pose"))
    return {
        "error": figures,
        "error_title": title,
        "error_text": text,
        "error_legend": legend,
        "error_rows": _error_rows([n for n, *_ in names], offsets, compared),
    }


def _offsets(poses: Float64, reference: Float64 | None) -> Float64:
    """Return (N, 4): position along x, y, z in m and angle in rad, against the reference.

    Without a reference, against the first pose. NaN where there is none.
    """
    out = np.full((len(poses), 4), np.nan)
    there = np.isfinite(poses).all((1, 2))
    if reference is None:
        base = poses[there][:1]
        if len(base) == 0:
            return out
        against = np.broadcast_to(base, poses.shape)
    else:
        there &= np.isfinite(reference).all((1, 2))
        against = reference
    out[there, :3] = poses[there, :3, 3] - against[there, :3, 3]
    relative = np.swapaxes(against[there, :3, :3], 1, 2) @ poses[there, :3, :3]
    out[there, 3] = se3.angle(relative)
    return out


def _error_rows(names: list[str], offsets: list[Float64], compared: bool) -> list[list[str]]:
    rows = []
    for name, o in zip(names, offsets, strict=True):
        seen = o[np.isfinite(o).all(1)]
        if len(seen) == 0:
            continue
        kinds = [("last frame", np.abs(seen[-1]))]
        if compared:
            kinds.append(("rms", np.sqrt((seen**2).mean(0))))
        kinds.append(("largest", np.abs(seen).max(0)))
        lengths = np.linalg.norm(seen[:, :3], axis=1)
        totals = {"last frame": lengths[-1], "largest": lengths.max()}
        totals["rms"] = np.sqrt((lengths**2).mean())
        for kind, values in kinds:
            cells = [words.length(float(v)) for v in values[:3]]
            angle = f"{np.degrees(values[3]):.2f}°"
            rows.append([f"{name}, {kind}", *cells, words.length(float(totals[kind])), angle])
    return rows


def _objective(s: Subject) -> Values:
    values = np.array(s.result.diagnostics.objective, float)
    if not np.isfinite(values).any():
        return {"objective": None, "objective_text": ""}
    x = np.arange(len(values), dtype=float)
    seen = values[np.isfinite(values)]
    drawn = plots.lines(
        x,
        [(values, plots.AFTER, "-")],
        label="Objective over iterations",
        ylabel="objective",
        xlabel="iteration",
        log=True,
        size=(480, 240),
    )
    text = f"From {seen[0]:.4g} to {seen[-1]:.4g} in {words.count(len(values) - 1, 'iteration')}."
    return {"objective": Figure(drawn), "objective_text": text}


def _filters(s: Subject) -> Values:
    removed, steps = s.result.diagnostics.removed, s.extras.filter_steps
    here: dict[str, tuple[int, int]] = {}  # points removed and seen; a name may come twice
    shown = []
    if steps:
        raw = steps[0][1]
        limits = images.depth_limits(raw)
        framing = images.Framing.around(raw.points.astype(float), (_FILTER, 240))
        last = raw
        for k, (name, frame) in enumerate(steps):
            if k:
                gone = len(last) - len(frame)
                part = words.share(gone / len(last) if len(last) else None)
                text = f"removed {part} ({gone:,} points), {len(frame):,} are left"
                before = here.get(name, (0, 0))
                here[name] = (before[0] + gone, before[1] + len(last))
            else:
                text = words.count(len(frame), "point")
            pictures = []
            if isinstance(frame, RangeFrame):
                lost = None
                if k and isinstance(last, RangeFrame):
                    lost = last.valid & ~frame.valid
                depth = images.depth_image(frame, limits, lost)
                pictures.append(images.data_uri(images.shrink(depth, _FILTER)))
            pictures.append(images.data_uri(images.cloud_image(frame, limits, framing)))
            shown.append({"name": name, "text": text, "images": pictures})
            last = frame
    note = ""
    if steps:
        low, high = images.depth_limits(steps[0][1])
        note = (
            f"Frame {steps[0][1].index} after each filter in turn; colours from dark (near, "
            f"{words.length(low)}) to bright (far, {words.length(high)})."
        )
        if isinstance(steps[0][1], RangeFrame):
            note += (
                " In the images grey has no measurement and pink was removed by this filter; "
                "below, the points seen from above and to the side."
            )
    names = [*removed, *(n for n in here if n not in removed)]
    rows = []
    for name in names:
        gone, seen = here.get(name, (0, 0))
        part = words.share(gone / seen) if seen else "–"
        rows.append((name, words.share(removed.get(name)), part))
    return {"filter_rows": rows, "filter_steps": shown, "filter_note": note}


def _frames(s: Subject) -> Values:
    records = s.result.diagnostics.frames
    out: Values = {
        "lanes": list(words.STATUSES),
        "strip": [],
        "health": [],
        "problems": [],
        "problems_more": "",
        "health_legend": [],
    }
    if not records:
        return out | {"strip_label": "", "strip_hint": ""}
    # With more frames than cells, a cell stands for several and shows the worst of them.
    size = -(-len(records) // _STRIP)
    for start in range(0, len(records), size):
        group = records[start : start + size]
        worst = max(group, key=lambda r: (1, 2, 3, 0)[words.STATUSES.index(r.status)])
        lane = words.STATUSES.index(worst.status)
        out["strip"].append({"status": worst.status, "lane": lane, "title": _told(worst)})
    counts = [f"{sum(r.status == name for r in records)} {name}" for name in words.STATUSES]
    out["strip_label"] = "Status of each frame: " + ", ".join(counts)
    first, last = records[0].index, records[-1].index
    out["strip_hint"] = (
        f"From left to right {words.frame_range(first, last)}. Point at a frame to see what "
        "became of it."
    )
    index = np.array([r.index for r in records], float)
    bad = index[[r.status in ("lost", "skipped") for r in records]]
    if len(bad):
        out["health_legend"] = [("bad", "x", "lost or skipped")]
    share = np.array([np.nan if r.inlier_share is None else r.inlier_share for r in records], float)
    rms = np.array([np.nan if r.rms_m is None else r.rms_m for r in records], float)
    for values, scale, ylabel, label in (
        (share, 100.0, "points with a correspondence, %", "Share of correspondences over frames"),
        (rms, 1000.0, "rms distance of correspondences, mm", "Rms distance over frames"),
    ):
        if np.isfinite(values).any():
            series = [(values * scale, plots.AFTER, "-")]
            drawn = plots.lines(index, series, label=label, ylabel=ylabel, bad=bad, floor=True)
            out["health"].append(Figure(drawn))
    runs = words.runs((r.index, r.status, r.reason) for r in records)
    runs = [run for run in runs if run[3] != "tracked"]
    out["problems"] = [
        (words.frame_range(a, b), f"{n:,}", status, why or "–")
        for a, b, n, status, why in runs[:_ROWS]
    ]
    if len(runs) > _ROWS:
        out["problems_more"] = f"{len(runs) - _ROWS:,} more are not shown."
    return out


def _told(record: FrameRecord) -> str:
    parts = [f"Frame {record.index}: {record.status}"]
    if record.reason:
        parts[0] += f" – {record.reason}"
    if record.inlier_share is not None:
        parts.append(f"{words.share(record.inlier_share)} correspondences")
    if record.rms_m is not None:
        parts.append(f"rms {words.length(record.rms_m)}")
    if len(record.unobservable):
        parts.append(f"{len(record.unobservable)} of 6 directions not held by the data")
    return ", ".join(parts)


def _loops(s: Subject) -> Values:
    loops = sorted(s.result.diagnostics.loops, key=lambda p: (not p.accepted, p.i, p.j))
    accepted = sum(p.accepted for p in loops)
    rows = [
        (
            f"{p.i} and {p.j}",
            "✓ accepted" if p.accepted else "✗ rejected",
            p.reason or "–",
            words.share(p.overlap),
            words.length(p.rms_m),
            words.share(p.free_space_violation),
        )
        for p in loops
    ]
    more = f"{len(rows) - _ROWS:,} more are not shown." if len(rows) > _ROWS else ""
    text = f"{words.count(len(loops), 'candidate')}: {accepted:,} accepted, "
    text += f"{len(loops) - accepted:,} rejected."
    return {"loops": rows[:_ROWS], "loops_text": text, "loops_more": more}


def _thumbnails(s: Subject) -> Values:
    frames = s.extras.thumbnails
    every = [images.depth_limits(f) for f in frames if len(f)]
    limits = (0.0, 1.0)
    if every:
        limits = (min(low for low, _ in every), max(high for _, high in every))
    out = []
    kinds: list[str] = []
    for frame in frames:
        pictures = []
        if isinstance(frame, RangeFrame):
            depth = images.shrink(images.depth_image(frame, limits, None), _THUMBNAIL)
            pictures.append(("range", images.data_uri(depth, jpeg=True)))
            grey = images.amplitude_image(frame)
            if grey is not None:
                small = images.shrink(grey, _THUMBNAIL)
                pictures.append(("amplitude", images.data_uri(small, jpeg=True)))
            if frame.color_image is not None:
                small = images.shrink(frame.color_image, _THUMBNAIL)
                pictures.append(("colour", images.data_uri(small, jpeg=True)))
        else:
            framing = images.Framing.around(frame.points.astype(float), (_THUMBNAIL, 165))
            drawn = images.cloud_image(frame, limits, framing)
            pictures.append(("points from above and to the side", images.data_uri(drawn)))
        kinds.extend(kind for kind, _ in pictures if kind not in kinds)
        out.append({"index": frame.index, "images": pictures})
    note = f"Sample frames before filtering: {', '.join(kinds)}."
    if every:
        note += (
            f" Depth from dark ({words.length(limits[0])}) to bright ({words.length(limits[1])})."
        )
    return {"thumbnails": out, "thumbnails_note": note}


def _timings(s: Subject) -> Values:
    taken = s.result.diagnostics.seconds
    total = sum(taken.values())
    frames = len(s.result.diagnostics.frames)
    rows = [
        (name, words.seconds(value), f"{100 * value / total if total else 0:.1f}")
        for name, value in taken.items()
    ]
    each = f"{words.seconds(total / frames)} a frame" if frames else ""
    return {"timings": rows, "total_time": words.seconds(total), "per_frame": each}


def _settings(s: Subject) -> Values:
    result = s.result
    recording = {k: v for k, v in result.recording.items() if k != "warnings"}
    source = {"version": __version__, **recording, "seed": result.seed, "threads": result.threads}
    return {
        "warnings": [str(w) for w in result.recording.get("warnings", ())],
        "input_text": _pretty(source),
        "config_text": _pretty(result.config),
    }


def _pretty(data: Any) -> str:
    return json.dumps(data, indent=2, ensure_ascii=False, default=str)
