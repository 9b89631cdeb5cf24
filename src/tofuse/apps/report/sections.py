"""The content of the report: name and values of each section, for its template."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tofuse._version import __version__
from tofuse.apps.report import (
    section_frames,
    section_model,
    section_parts,
    section_trajectory,
    words,
)
from tofuse.apps.report.extras import ReportExtras
from tofuse.apps.report.html import script, write_page
from tofuse.apps.report.subject import INNER_ENDS, OUTER_ENDS, Subject, Values
from tofuse.engine import quantities
from tofuse.engine.compute import job_pool
from tofuse.engine.results import Reconstruction, accuracy_card

Section = Callable[[Subject], Values | None]


def write_report(result: Reconstruction, path: Path, extras: ReportExtras) -> None:
    """Write `report.html` of a result to `path`, atomically; and `share.html` if wanted.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    values = sections(result, extras)
    write_page(path, "report.html.j2", script=script(charts=True), **values)
    if extras.share:
        scene = values["scene"]
        if scene is not None:
            fields = {k: v for k, v in scene["fields"].items() if k == "accuracy"}
            scene = scene | {"fields": fields, "lines": {}, "frames": None}
        values |= {"scene": scene}
        write_page(path.with_name("share.html"), "share.html.j2", script=script(), **values)


def sections(result: Reconstruction, extras: ReportExtras) -> Values:
    """Return all values that the template shows."""
    subject = Subject.of(result, extras)
    # In their order: name, title in the table of contents, and content; None leaves a section out.
    listed: tuple[tuple[str, str, Section], ...] = (
        ("verdict", "Accuracy", _verdict),
        ("sessions", "Sessions", section_parts.sessions),
        ("rig", "Rig", section_parts.rig),
        ("components", "Components", section_parts.components),
        ("frames", "Frames", section_frames.frames),
        ("views", "Dimensions", section_model.views),
        (
            "error",
            "Displacement" if subject.reference is None else "Error",
            section_trajectory.error,
        ),
        ("objective", "Objective", section_trajectory.optimisation),
        ("filters", "Filters", section_frames.filters),
        ("loops", "Loop closures", section_frames.loops),
        ("recording", "Recording", section_frames.recording),
        ("timings", "Time", lambda _: {}),
        ("settings", "Settings", _settings),
    )
    # Simplifying the surface takes as long as the rest, and releases the interpreter lock.
    with job_pool(1, "tofuse-report") as background:
        model = background.submit(section_model.model, subject)
        contents = {name: content(subject) for name, _, content in listed}
        shown = [(name, title) for name, title, _ in listed if contents[name] is not None]
        return {
            "title": extras.title,
            "turn": subject.image_turn,
            "result": result,
            "contents": [("model", "Model"), *shown, ("reading", "How to read this")],
            **model.result(),
            **contents,
        }


def _verdict(s: Subject) -> Values:
    d, a = s.result.diagnostics, s.result.diagnostics.accuracy
    frames = [a.unbounded[0], a.unbounded[-1]] if a.unbounded else []
    if a.worst is not None and not frames:
        frames = [a.worst.frame, a.worst.frame]
    findings = words.findings(d.reasons, len(d.frames))
    # On this page the inspection is out of sight, so its findings stand here.
    faults = " ".join(r.text for r in d.reasons if r.code == "faulty_recording")
    advice, where = accuracy_card.advice(d)
    return {
        "headline": s.extras.headline,
        "bound": accuracy_card.bound(a, s.result.cloud.diagonal_m).removeprefix("accuracy "),
        "weakest": accuracy_card.weakest_frame(a),
        "frames": frames,
        "plain": _plain(s),
        "outcome": _OUTCOMES[d.verdict],
        "advice": advice and (faults or advice),
        "where": where,
        "card_tone": d.verdict if d.accuracy.assessed else "",
        "tone": d.verdict,
        "posed": int(s.result.has_pose.sum()),
        "readable": sum(f.status != "skipped" for f in d.frames),
        "decisive": any(f["level"] == d.verdict for f in findings),
        "findings": findings,
    }


_OUTCOMES = {
    "good": "No problems were found.",
    "degraded": "Use it with care: parts of it may be off.",
    "failed": "Do not rely on it: its shape may be wrong.",
}


def _plain(s: Subject) -> str:
    """Return size and accuracy in one sentence for everybody."""
    if not len(s.scene.points):
        return "There is no model."
    points = s.scene.points @ s.R_display_world.T
    sizes, inner = (
        np.ptp(np.percentile(points, ends, axis=0), axis=0) for ends in (OUTER_ENDS, INNER_ENDS)
    )
    # Where sparse points, such as wrong ones, lie beyond the bulk, the size is not sharp.
    width, height, depth = map(words.rounded_length, sizes.tolist(), (sizes - inner).tolist())
    accuracy = s.result.diagnostics.accuracy
    if accuracy.assessed and np.isfinite(accuracy.position_m):
        known = f"and its parts fit together to about {quantities.length(accuracy.position_m)}"
    elif s.result.has_pose.sum() == 1:
        known = "and was seen by a single image"
    else:
        known = "but how well its parts fit together could not be determined"
    return f"It is about {width} wide, {height} high and {depth} deep, {known}."


def _settings(s: Subject) -> Values:
    recording = {k: v for k, v in s.result.recording.items() if k not in ("warnings", "findings")}
    run = {"seed": s.result.seed, "threads": s.result.threads}
    return {"version": __version__, **recording, **run}
