"""The content of all sections of the report, as plain values for the template."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from tofuse._version import __version__
from tofuse.kernels.threads import job_pool
from tofuse.report import (
    section_components,
    section_frames,
    section_model,
    section_rig,
    section_sessions,
    section_trajectory,
    section_views,
    words,
)
from tofuse.report.extras import ReportExtras
from tofuse.report.subject import Subject, Values
from tofuse.results.card import bound, weakest_frame
from tofuse.results.types import Reconstruction


def sections(result: Reconstruction, extras: ReportExtras) -> Values:
    """Return all values that the template shows."""
    subject = Subject.of(result, extras)
    values: Values = {}
    parts: tuple[Callable[[Subject], Values], ...] = (
        _verdict,
        section_sessions.sessions,
        section_rig.rig,
        section_components.components,
        section_model.views,
        section_trajectory.cameras,
        section_trajectory.error,
        section_trajectory.uncertainty,
        section_trajectory.optimised,
        section_trajectory.objective,
        section_views.filters,
        section_frames.frames,
        section_frames.loops,
        section_views.player,
        section_views.clouds,
        _timings,
        _settings,
    )
    # Simplifying the surface takes as long as all plots, and releases the interpreter lock.
    with job_pool(1, "tofuse-report") as background:
        model = background.submit(section_model.model, subject)
        for part in parts:
            values.update(part(subject))
        values.update(model.result())
    has_true_sizes = values["true_sizes"]
    values["dimensions"] = [(row[0], row[2 if has_true_sizes else 1]) for row in values["sizes"]]
    names = {
        "model": "Model",
        "verdict": "Accuracy",
        "sessions": "Sessions",
        "rig": "Rig",
        "components": "Components",
        "frames": "Frames",
        "views": "Dimensions",
        "cameras": "Trajectory",
        "error": "Error" if subject.reference is not None else "Displacement",
        "objective": "Objective",
        "filters": "Filters",
        "loops": "Loop closures",
        "recording": "Recording",
        "timings": "Time",
        "settings": "Settings",
        "reading": "How to read this",
    }
    if not values["clouds"]:
        del names["recording"]
    if not values["sessions"]:
        del names["sessions"]
    if not values["rig_views"]:
        del names["rig"]
    if not values["components"]:
        del names["components"]
    values["contents"] = list(names.items())
    return values


def _verdict(s: Subject) -> Values:
    result = s.result
    findings = words.findings(result.diagnostics.reasons, len(result.diagnostics.frames))
    text = words.verdict_sentence(result, findings)
    head, _, tail = text.partition(":")
    statuses: list[str] = [f.status for f in result.diagnostics.frames]
    facts = [(f"frames {name}", f"{statuses.count(name):,}") for name in words.STATUSES]
    if s.scene.surface is not None:
        facts.append(("surface", words.count(len(s.scene.surface.faces), "triangle")))
    facts.append(("point cloud", words.count(s.scene.total, "point")))
    path = s.scene.after[:, :3, 3]
    if len(path) > 1:
        travelled = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        facts.append(("trajectory length", words.length(travelled)))
    closures = sum(p.accepted for p in result.diagnostics.loops)
    facts.append(("loop closures", f"{closures:,}"))
    return {
        "title": s.extras.title,
        "headline": s.extras.headline,
        "card": _card(result),
        "card_tone": result.diagnostics.verdict if result.diagnostics.accuracy.assessed else "",
        "subtitle": _subtitle(result),
        "verdict": result.diagnostics.verdict,
        "verdict_head": head + ":",
        "verdict_tail": tail,
        "facts": facts,
        "findings": findings,
    }


def _card(result: Reconstruction) -> list[tuple[str, str, str]]:
    """Name, value and frame ranges of each line of the accuracy card."""
    d = result.diagnostics
    readable = sum(f.status != "skipped" for f in d.frames)
    closures = sum(p.accepted for p in d.loops)
    covered = f"{int(result.has_pose.sum()):,} of {words.count(readable, 'frame')}"
    lines = [
        ("Accuracy", bound(d.accuracy, result.cloud.diagonal_m).removeprefix("accuracy "), ""),
        ("Coverage", f"{covered}, {words.count(closures, 'loop closure')}", ""),
    ]
    weakest = weakest_frame(d.accuracy)
    if weakest:
        a = d.accuracy
        frames = [a.unbounded[0], a.unbounded[-1]] if a.unbounded else []
        if a.worst is not None and not frames:
            frames = [a.worst.frame, a.worst.frame]
        lines.append(("Weakest", weakest, json.dumps([frames])))
    return lines


def _subtitle(result: Reconstruction) -> str:
    recording = result.recording
    parts = [words.count(len(result.diagnostics.frames), "frame")]
    if recording.get("format"):
        parts.append(f"format {recording['format']}")
    method = result.config.get("method")
    if method:
        parts.append(f"method {method}")
    return ", ".join([*parts, f"tofuse {__version__}"])


def _timings(s: Subject) -> Values:
    durations = s.result.diagnostics.seconds
    total = sum(durations.values())
    frames = len(s.result.diagnostics.frames)
    rows = [
        (name, words.seconds(value), f"{100 * value / total if total else 0:.1f}")
        for name, value in durations.items()
    ]
    per_frame = f"{words.seconds(total / frames)} per frame" if frames else ""
    return {"timings": rows, "total_time": words.seconds(total), "per_frame": per_frame}


def _settings(s: Subject) -> Values:
    result = s.result
    recording = {k: v for k, v in result.recording.items() if k not in ("warnings", "findings")}
    source = {"version": __version__, **recording, "seed": result.seed, "threads": result.threads}
    return {
        "warnings": [str(w) for w in result.recording.get("warnings", ())],
        "input_text": _pretty(source),
        "config_text": _pretty(result.config),
    }


def _pretty(data: Any) -> str:
    return json.dumps(data, indent=2, ensure_ascii=False, default=str)
