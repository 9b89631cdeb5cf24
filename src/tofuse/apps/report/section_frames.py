"""The frames: outcome and images of each, loop closures, the effect of the filters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial

import numpy as np

from tofuse.apps.report import plots, thumbnails, words
from tofuse.apps.report.subject import ROWS, Subject, Values
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.compute import run_all, trim_memory
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.quality import frame_samples
from tofuse.engine.results import Component, FrameRecord, in_main_model

_STRIP = 600  # cells in the strip of frames
_THUMBNAIL, _FILTER = (220, 165), (320, 240)  # px
_SEVERITY = {"skipped": 0, "tracked": 1, "predicted": 2, "lost": 3}
# Kinds of images, in the order in which they are shown, and their titles.
_KINDS = {"color": "Colour", "range": "Range", "amplitude": "Amplitude", "fate": "Use of pixels"}

# Colour and label of each use of a pixel.
_FATES = {
    frame_samples.KEPT: ((38, 150, 140), "in the model"),
    frame_samples.TRACKED: ((236, 170, 60), "tracking only"),
    frame_samples.REMOVED: (thumbnails.REMOVED, "removed by a filter"),
    frame_samples.NOTHING: (thumbnails.NO_MEASUREMENT, "no measurement"),
}


def frames(s: Subject) -> Values:
    """Return the strip of frames, the plots of registration quality and the table of problems."""
    records, components = s.result.diagnostics.frames, s.result.components
    statuses: list[str] = [r.status for r in records]
    runs = words.runs((r.index, r.status, r.reason) for r in records)
    runs = [run for run in runs if run[3] != "tracked"]
    counts = [(name, statuses.count(name)) for name in words.STATUSES]
    return {
        "counts": [(f"frames {name}", f"{number:,}") for name, number in counts],
        "triangles": None if s.result.mesh is None else len(s.result.mesh.faces),
        "points": s.scene.total,
        "travelled": path_length(s),
        "lanes": [*words.STATUSES, *(["component"] if len(components) > 1 else [])],
        "strip": _strip(records, components),
        "label": ", ".join(f"{n} {name}" for name, n in counts),
        "found": words.frame_range(records[0].index, records[-1].index) if records else "",
        "bounded": sum(r.covariance is not None for r in records) > 1,
        "figures": _health(records),
        "has_bad": "lost" in statuses or "skipped" in statuses,
        "player": _player(s),
        "problems": runs[:ROWS],
        "more": words.more(len(runs) - ROWS),
        "apart": any(not c.connected for c in components),
    }


def path_length(s: Subject) -> float | None:
    """Return the length of the path in m; None without two poses.

    Steps between sessions, and between the cameras of a rig, are no motion: the lengths of sessions
    add up, and of the cameras of a rig that with the longest path counts.
    """
    rig = s.result.recording.get("rig")
    of_frames = rig["of_frames"] if rig else []
    count = len(s.index)
    camera = np.array(of_frames, int) if len(of_frames) == count else np.zeros(count, int)
    starts = [session.first for session in s.result.sessions[1:]]
    session = np.searchsorted(starts, s.index, side="right")
    lengths = np.zeros((len(starts) + 1, camera.max(initial=0) + 1))
    for row, column in np.ndindex(*lengths.shape):
        own = s.result.has_pose & (session == row) & (camera == column)
        steps = np.diff(s.result.trajectory[own, :3, 3], axis=0)
        lengths[row, column] = np.linalg.norm(steps, axis=1).sum()
    return float(lengths.max(1).sum()) if s.result.has_pose.sum() > 1 else None


def _strip(
    records: Sequence[FrameRecord], components: Sequence[Component]
) -> list[tuple[FrameRecord, str]]:
    """The cells of the strip; with more frames than cells, a cell shows the worst of several."""
    size = max(-(-len(records) // _STRIP), 1)
    cells = (records[start : start + size] for start in range(0, len(records), size))
    worst = [max(cell, key=lambda r: _SEVERITY[r.status]) for cell in cells]
    return [(record, frame_text(record, components)) for record in worst]


def _health(records: Sequence[FrameRecord]) -> list[Values]:
    """The plots of inliers and residuals over frames."""
    index = np.array([r.index for r in records], float)
    bad = index[[r.status in ("lost", "skipped") for r in records]]
    figures = []
    for values, scale, ylabel, label in (
        ([r.inlier_share for r in records], 100.0, "inliers, %", "Inliers over frames"),
        ([r.rms_m for r in records], 1000.0, "rms residual, mm", "Rms residual over frames"),
    ):
        y = scale * np.array(values, float)  # NaN where there is none
        if np.isfinite(y).any():
            figures.append(
                plots.lines(index, {"after": y}, label=label, ylabel=ylabel, bad=bad, floor=True)
            )
    return figures


def frame_text(record: FrameRecord, components: Sequence[Component] = ()) -> str:
    """Return the outcome of a frame as text, with its component if there are several."""
    parts = [f"Frame {record.index}: {record.status}"]
    if record.reason:
        parts[0] += f" – {record.reason}"
    if record.inlier_share is not None:
        parts.append(f"{quantities.percent(record.inlier_share)} inliers")
    if record.rms_m is not None:
        parts.append(f"rms residual {quantities.length(record.rms_m)}")
    if len(record.unobservable):
        parts.append(f"{len(record.unobservable)} of 6 directions unobservable")
    if record.component is not None and len(components) > 1:
        note = "" if in_main_model(record, components) else " (not connected to the main one)"
        parts.append(f"component {record.component}{note}")
    return ", ".join(parts)


def _player(s: Subject) -> Values | None:
    """The images of frames, with the status of each."""
    samples = s.result.diagnostics.samples
    if not samples:
        return None
    low, high = _depth_range(samples)
    fate_colors = np.array([_FATES[fate][0] for fate in sorted(_FATES)], np.uint8)
    images = run_all([partial(_images, p, (low, high), fate_colors) for p in samples])
    trim_memory()
    records = {r.index: r for r in s.result.diagnostics.frames}
    listed = [records.get(p.index) for p in samples]
    kinds = {k: title for k, title in _KINDS.items() if any(k in each for each in images)}
    note = f"Range from dark ({quantities.length(low)}) to bright ({quantities.length(high)})."
    if len(samples) < len(records):
        note = f"{len(samples):,} of {len(records):,} frames have images here. " + note
    return {
        "data": {
            "index": [p.index for p in samples],
            "descriptions": [frame_text(r, s.result.components) if r else "" for r in listed],
            "status": [r.status if r else "" for r in listed],
            "images": {kind: [each.get(kind, "") for each in images] for kind in kinds},
        },
        "kinds": kinds,
        "note": note,
        "fates": [(thumbnails.css(color), text) for color, text in _FATES.values()],
    }


def _depth_range(frames: Sequence[frame_samples.FrameSample]) -> tuple[float, float]:
    """Return the depths in m at the ends of the colour map, the same for all frames."""
    subsampled = [f.depth[::3, ::3] for f in frames]
    values = (
        np.concatenate([d[d > 0] for d in subsampled]) if subsampled else np.zeros(0, np.float16)
    )
    return thumbnails.percentile_range(values, min_width=1e-3)


def _images(
    sample: frame_samples.FrameSample, limits: tuple[float, float], fate_colors: UInt8
) -> dict[str, str]:
    """The images of a frame by kind (`_KINDS`): JPEG, and PNG for the use of pixels."""
    images = {"range": thumbnails.depth_colors(sample.depth, sample.depth > 0, limits)}
    if sample.color is not None:
        images["color"] = sample.color
    if sample.amplitude is not None:
        images["amplitude"] = thumbnails.grey(sample.amplitude)
    uris = {kind: thumbnails.data_uri(image, jpeg=True) for kind, image in images.items()}
    return uris | {"fate": thumbnails.data_uri(fate_colors[sample.fate])}


def loops(s: Subject) -> Values:
    """Return the table of candidates for loop closures."""
    loops = sorted(s.result.diagnostics.loops, key=lambda p: (not p.accepted, p.i, p.j))
    accepted = sum(p.accepted for p in loops)
    return {"rows": loops[:ROWS], "accepted": accepted, "rejected": len(loops) - accepted}


def filters(s: Subject) -> Values:
    """Return one frame after each filter (figure 3.2), and the fractions removed."""
    removed, steps = s.result.diagnostics.removed, s.extras.filter_steps
    gone: Counter[str] = Counter()
    reached: dict[str, int] = {}  # the first time, as a filter may be used twice
    values: Values = {"steps": []}
    if steps:
        raw = previous = steps[0][1]
        limits = thumbnails.depth_limits(raw)
        values |= {"frame": raw.index, "limits": limits, "is_image": isinstance(raw, RangeFrame)}
        view = thumbnails.framing(raw.points.astype(float), _FILTER)
        for k, (name, frame) in enumerate(steps):
            images = _step_images(frame, previous if k else None, limits, view)
            num_removed = len(previous) - len(frame)
            values["steps"].append((name, len(frame), num_removed, images))
            if k:
                reached.setdefault(name, len(previous))
                gone[name] += num_removed
            previous = frame
    # Corrections remove nothing.
    names = [*removed, *(n for n in gone if n not in removed and gone[n])]
    fractions = [gone[n] / reached[n] if reached.get(n) else None for n in names]
    whole = [removed.get(n) for n in names]
    return values | {"rows": list(zip(names, whole, fractions, strict=True))}


def _step_images(
    frame: Frame, previous: Frame | None, limits: tuple[float, float], view: tuple[Float64, float]
) -> list[str]:
    """The depth image of a frame, with the pixels removed since the previous one; its points."""
    images = []
    if isinstance(frame, RangeFrame):
        removed = previous.valid & ~frame.valid if isinstance(previous, RangeFrame) else None
        images.append(thumbnails.depth_image(frame, limits, removed, _FILTER[0]))
    images.append(thumbnails.cloud_image(frame, limits, _FILTER, view))
    return [thumbnails.data_uri(image) for image in images]


def recording(s: Subject) -> Values | None:
    """Return samples of the recording, if its views are clouds."""
    frames = s.extras.clouds
    if not frames:
        return None
    ranges = [thumbnails.depth_limits(f) for f in frames if len(f)]
    lows, highs = zip(*ranges, strict=True) if ranges else ((0.0,), (1.0,))
    limits = min(lows), max(highs)
    images = [thumbnails.cloud_image(frame, limits, _THUMBNAIL) for frame in frames]
    samples = [(f.index, thumbnails.data_uri(i)) for f, i in zip(frames, images, strict=True)]
    return {"samples": samples, "limits": limits if ranges else None}
