"""What the recording consists of: sessions, components, and the cameras of a rig."""

from __future__ import annotations

import numpy as np

from tofuse.apps.report import words
from tofuse.apps.report.session_words import probability_text
from tofuse.apps.report.subject import ROWS, Subject, Values
from tofuse.apps.report.thumbnails import css
from tofuse.apps.results import CHANGE_COLORS, folders
from tofuse.engine.frames import frame_ranges
from tofuse.engine.geometry import se3
from tofuse.engine.results import Component, SessionChange, SessionPair
from tofuse.formats.rigs import RigCamera

_COLORS = 6  # of components in the style sheet; further ones reuse them
_JOINED = {
    "links": "links between views",
    "motion": "extrapolated motion only",
    "odometry": "recorded odometry only",
}


def sessions(s: Subject) -> Values | None:
    """Return the tables of sessions, of pairs of them and of changes; None for one recording."""
    records, pairs = s.result.sessions, s.result.session_pairs
    if not records:
        return None
    rows = []
    for session in records:
        frames = [f.index for f in s.result.diagnostics.frames if session.has(f.index)]
        first, last = (frames[0], frames[-1]) if frames else (session.first, session.first)
        place = "apart" if session.T_main_session is None else "in this map"
        paths = ", ".join(session.opening["paths"])
        rows.append((session.name, f"{first}–{last}", f"{len(frames):,}", place, paths))
    text = f"{words.count(len(records), 'session')} were merged. "
    if unjoined := sum(session.T_main_session is None for session in records):
        text += (
            f"For {unjoined:,} of them no overlap with the first one could be confirmed: "
            f"{'it is' if unjoined == 1 else 'they are'} not joined."
        )
    else:
        text += "All of them are in this map, in the world frame of the first."
    names = [session.name for session in records]
    return {
        "rows": rows[:ROWS],
        "text": text,
        "pairs": [_pair(pair, names) for pair in pairs[:ROWS]],
        "changes": [_change(change, names) for change in s.result.changes[:ROWS]],
        "met": any(pair.joined and pair.overlap > 0 for pair in pairs),
    }


def _pair(pair: SessionPair, names: list[str]) -> tuple[str, ...]:
    joined = "no"
    if pair.joined:
        joined = "before" if pair.before else "yes"
        joined += "" if pair.links or pair.overlap else ", through others"
    return (
        f"{names[pair.a]}, {names[pair.b]}",
        joined,
        words.percent(pair.overlap if pair.joined else None),
        f"{pair.links:,}" if pair.joined else "–",
        "–" if pair.probability is None else probability_text(pair.probability),
        words.percent(pair.support),
    )


def _change(record: SessionChange, names: list[str]) -> tuple[str, ...]:
    change = record.change
    return (
        css(CHANGE_COLORS[change.kind]),
        change.kind,
        f"{names[record.a]}, then {names[record.b]}",
        words.coordinates(change.centre, 2),
        " × ".join(words.length(float(x)) for x in change.size),
        f"{1e3 * change.volume_m3:.1f} l",
    )


def component_color(component: int) -> int:
    """Return the number of the colour of a component."""
    return component % _COLORS


def components(s: Subject) -> Values | None:
    """Return the table of components; None if there is only one."""
    parts = s.result.components
    if len(parts) < 2:
        return None
    text = f"The recording was tracked in {words.count(len(parts), 'component')}. "
    if disconnected := sum(not c.connected for c in parts):
        text += (
            f"{disconnected:,} of them could not be connected to the main one, so "
            f"{'its' if disconnected == 1 else 'their'} frames are not in this model."
        )
    else:
        text += "All of them are connected and are in this model."
    if len(parts) > ROWS:
        text += f" The first {ROWS} are listed."
    of_frames = [record.component for record in s.result.diagnostics.frames]
    rows = [_component(k, c, of_frames.count(k)) for k, c in enumerate(parts[:ROWS])]
    return {"rows": rows, "text": text}


def _component(number: int, component: Component, count: int) -> Values:
    link, model = "", "none: too few frames"
    if component.connected:
        model = "this one"
    elif component.result is not None:
        model = folders.component_name(number)
        link = f"{model}/report.html"
    return {
        "name": f"{number} (main)" if number == 0 else str(number),
        "color": component_color(number),
        "frames": frame_ranges.numbers(component.frames).replace("-", "–"),
        "count": f"{count:,}",
        "joined": _JOINED.get(component.joined or "", "–" if number == 0 else "not connected"),
        "link": link,
        "model": model,
    }


def rig(s: Subject) -> Values | None:
    """Return the tables of the rig; None for a single camera."""
    calibration = s.extras.rig
    if calibration is None:
        return None
    pairs = sorted(calibration.disagreement, key=lambda d: -d.median_m)
    return {
        "cameras": [_camera(c, k == 0) for k, c in enumerate(calibration.cameras)],
        "pairs": [
            (f"{d.a}, {d.b}", f"{1000 * d.median_m:.1f} mm", f"{d.pixels:,}") for d in pairs[:ROWS]
        ],
        "unplaced": [f"{name}: {reason}" for name, reason in calibration.unplaced.items()],
    }


def _camera(camera: RigCamera, first: bool) -> tuple[str, ...]:
    row = (camera.name, words.coordinates(camera.T_rig_camera[:3, 3], 3))
    if first:
        return (*row, "–", "–", "–", "–")
    sigma_m, sigma_rad = se3.largest_sigmas(camera.covariance).tolist()
    offsets = (camera.time_offset_s, camera.depth_offset_m)
    clock, depth = (f"{1000 * x:+.1f}".replace("-", "−") for x in offsets)
    return (
        *row, words.length(sigma_m), f"{np.degrees(sigma_rad):.2g}°", f"{clock} ms", f"{depth} mm",
    )  # fmt: skip
