"""The components of the recording, and how they are connected."""

from __future__ import annotations

from tofuse.report import words
from tofuse.report.subject import ROWS, Subject, Values
from tofuse.results.folder import component_name
from tofuse.results.ranges import numbers
from tofuse.results.types import Component

_COLORS = 6  # in the style sheet; further components reuse them

_JOINED = {
    "links": "links between views",
    "motion": "extrapolated motion only",
    "odometry": "recorded odometry only",
}


def color(component: int) -> int:
    """Return the number of the colour of a component."""
    return component % _COLORS


def components(s: Subject) -> Values:
    """Return the table of components; empty if there is only one."""
    parts = s.result.components
    disconnected = sum(not c.connected for c in parts)
    if len(parts) < 2:
        return {"components": [], "components_text": "", "apart": disconnected}
    sizes = [0] * len(parts)
    for record in s.result.diagnostics.frames:
        if record.component is not None:
            sizes[record.component] += 1
    rows = [_row(number, c, sizes[number]) for number, c in enumerate(parts)]
    text = f"The recording was tracked in {words.count(len(parts), 'component')}. "
    if disconnected:
        text += (
            f"{disconnected:,} of them could not be connected to the main one, so "
            f"{'its' if disconnected == 1 else 'their'} frames are not in this model."
        )
    else:
        text += "All of them are connected and are in this model."
    if len(rows) > ROWS:
        text += f" The first {ROWS} are listed."
    return {"components": rows[:ROWS], "components_text": text, "apart": disconnected}


def _row(number: int, component: Component, count: int) -> Values:
    link = model = ""
    if component.connected:
        model = "this one"
    elif component.result is not None:
        model = component_name(number)
        link = f"{model}/report.html"
    else:
        model = "none: too few frames"
    joined = _JOINED.get(component.joined or "", "–" if number == 0 else "not connected")
    return {
        "name": f"{number} (main)" if number == 0 else str(number),
        "color": color(number),
        "frames": numbers(component.frames).replace("-", "–"),
        "count": f"{count:,}",
        "joined": joined,
        "link": link,
        "model": model,
    }
