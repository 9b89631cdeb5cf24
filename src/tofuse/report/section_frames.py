"""The outcome of each frame, and of each candidate for a loop closure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofuse.report import plots, words
from tofuse.report.section_components import color
from tofuse.report.subject import ROWS, Figure, Subject, Values
from tofuse.results.types import Component, FrameRecord, in_main_model

_STRIP = 600  # cells in the strip of frames


def frames(s: Subject) -> Values:
    """Return the strip of frames, the plots of registration quality and the table of problems."""
    records = s.result.diagnostics.frames
    section: Values = {
        "lanes": list(words.STATUSES),
        "strip": [],
        "health": [],
        "problems": [],
        "problems_more": "",
        "health_legend": [],
    }
    if not records:
        return section | {"strip_label": "", "strip_hint": "", "strip_hint_short": ""}
    components = s.result.components
    if len(components) > 1:
        section["lanes"].append("component")
    # With more frames than cells, a cell shows the worst of several frames.
    cell_frames = -(-len(records) // _STRIP)
    for start in range(0, len(records), cell_frames):
        group = records[start : start + cell_frames]
        worst = max(group, key=lambda r: (1, 2, 3, 0)[words.STATUSES.index(r.status)])
        lane = words.STATUSES.index(worst.status)
        section["strip"].append(
            {
                "status": worst.status,
                "lane": lane,
                "title": frame_text(worst, components),
                "index": worst.index,
                "color": None
                if worst.component is None or len(components) < 2
                else color(worst.component),
            }
        )
    counts = [f"{sum(r.status == name for r in records)} {name}" for name in words.STATUSES]
    section["strip_label"] = "Status of each frame: " + ", ".join(counts)
    first, last = records[0].index, records[-1].index
    section["strip_hint_short"] = (
        f"{words.frame_range(first, last).capitalize()}: status above, accuracy below (dark = "
        "accurate)."
        if any(r.covariance is not None for r in records)
        else f"{words.frame_range(first, last).capitalize()}: status."
    )
    section["strip_hint"] = (
        f"From left to right: {words.frame_range(first, last)}. Point at a frame to see its status."
    )
    index = np.array([r.index for r in records], float)
    bad = index[[r.status in ("lost", "skipped") for r in records]]
    if len(bad):
        section["health_legend"] = [("bad", "x", "lost or skipped")]
    inliers = np.array(
        [np.nan if r.inlier_share is None else r.inlier_share for r in records], float
    )
    rms = np.array([np.nan if r.rms_m is None else r.rms_m for r in records], float)
    for values, scale, ylabel, label in (
        (inliers, 100.0, "inliers, %", "Inliers over frames"),
        (rms, 1000.0, "rms residual, mm", "Rms residual over frames"),
    ):
        if np.isfinite(values).any():
            series = [(values * scale, plots.AFTER, "-")]
            svg = plots.lines(index, series, label=label, ylabel=ylabel, bad=bad, floor=True)
            section["health"].append(Figure(svg))
    runs = words.runs((r.index, r.status, r.reason) for r in records)
    runs = [run for run in runs if run[3] != "tracked"]
    section["problems"] = [
        (words.frame_range(a, b), f"{n:,}", status, reason or "–", [[a, b]])
        for a, b, n, status, reason in runs[:ROWS]
    ]
    if len(runs) > ROWS:
        section["problems_more"] = f"{len(runs) - ROWS:,} more are not shown."
    return section


def frame_text(record: FrameRecord, components: Sequence[Component] = ()) -> str:
    """Return the outcome of a frame as text, with its component if there are several."""
    parts = [f"Frame {record.index}: {record.status}"]
    if record.reason:
        parts[0] += f" – {record.reason}"
    if record.inlier_share is not None:
        parts.append(f"{words.percent(record.inlier_share)} inliers")
    if record.rms_m is not None:
        parts.append(f"rms residual {words.length(record.rms_m)}")
    if len(record.unobservable):
        parts.append(f"{len(record.unobservable)} of 6 directions unobservable")
    if record.component is not None and len(components) > 1:
        note = "" if in_main_model(record, components) else " (not connected to the main one)"
        parts.append(f"component {record.component}{note}")
    return ", ".join(parts)


def loops(s: Subject) -> Values:
    """Return the table of candidates for loop closures."""
    loops = sorted(s.result.diagnostics.loops, key=lambda p: (not p.accepted, p.i, p.j))
    accepted = sum(p.accepted for p in loops)
    rows = [
        (
            f"{p.i} and {p.j}",
            "✓ accepted" if p.accepted else "✗ rejected",
            p.reason or "–",
            words.percent(p.overlap),
            words.length(p.rms_m),
            words.percent(p.free_space_violation),
            words.percent(p.margin),
            [[p.i, p.i], [p.j, p.j]],
        )
        for p in loops
    ]
    more = f"{len(rows) - ROWS:,} more are not shown." if len(rows) > ROWS else ""
    text = f"{words.count(len(loops), 'candidate')}: {accepted:,} accepted, "
    text += f"{len(loops) - accepted:,} rejected."
    return {"loops": rows[:ROWS], "loops_text": text, "loops_more": more}
