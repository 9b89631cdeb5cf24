"""Matplotlib's figures as inline SVG that uses the page's colours, so that it follows its theme."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from tofuse.apps.report import plots
from tofuse.engine.arrays import Float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Placeholders that `svg` replaces by the page's variables of the same names.
INK, MUTED, GRID = "#010101", "#020202", "#030303"
BEFORE, AFTER, REFERENCE, BAD = "#040404", "#050505", "#060606", "#080808"
_VARIABLES = {INK: "ink", MUTED: "muted", GRID: "grid"}
_VARIABLES |= {BEFORE: "before", AFTER: "after", REFERENCE: "reference", BAD: "bad"}
_MAX_MM_EXTENT_M = 0.6  # plans of smaller extent have ticks in mm
_LABEL: Any = {"color": MUTED, "fontsize": 10.5, "labelpad": 2}  # style of an axis label
_STYLE: Any = {
    "svg.fonttype": "none",
    "image.composite_image": False,
    "font.size": 11,
    "axes.unicode_minus": True,
    "path.simplify": True,
}


def make_figure(
    width: float, height: float, margins: tuple[float, float, float, float]
) -> tuple[Figure, Axes]:
    """Make a figure with axes.

    Parameters
    ----------
    width, height
        Size in pixels.
    margins
        Left, bottom, right and top, pixels.
    """
    logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)  # about the font cache
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 72, height / 72), dpi=72)
    left, bottom, right, top = margins
    size = (width - left - right, height - bottom - top)
    axes = figure.add_axes((left / width, bottom / height, size[0] / width, size[1] / height))
    axes.patch.set_visible(False)
    figure.patch.set_visible(False)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=10.5, length=3)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    return figure, axes


def svg(figure: Figure, label: str) -> str:
    """Return the figure as an `<svg>` element; `label` is plain text without markup."""
    import matplotlib

    buffer = io.StringIO()
    no_metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
    # The label as salt makes identifiers differ between the plots of a page.
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": label}):
        figure.savefig(buffer, format="svg", metadata=no_metadata)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", text, count=1, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    view = re.search(r'viewBox="[^"]*"', text)
    # HTML implies the namespaces, whose addresses would be in the page.
    opening_tag = (
        f'<svg class="plot" role="img" aria-label="{label}" {view.group() if view else ""}>'
    )
    text = opening_tag + text[text.index(">") + 1 :]
    text = text.replace("xlink:href", "href")
    text = re.sub(r"'?DejaVu Sans'?(, '[^']*'|, [A-Za-z -]+)*", "inherit", text)
    for color, name in _VARIABLES.items():
        text = text.replace(color, f"var(--{name})")
    return text.strip()


def lines(
    series: Sequence[tuple[Float64, str, str]],
    *,
    label: str,
    ylabel: str,
    xlabel: str = "frame",
    log: bool = False,
    size: tuple[int, int],
) -> str:
    """Plot lines over frames or steps: of each its (y, colour, style); NaN leaves a gap.

    The y axis is logarithmic (linear near 0 if a value is 0), or has the line y = 0.
    """
    figure, axes = make_figure(*size, (52, 36, 10, 20))
    values = np.concatenate([y for y, _, _ in series])
    for y, color, style in series:
        marker = "o" if style == "-" and int(np.isfinite(y).sum()) <= 30 else None
        axes.plot(y, color=color, linestyle=style, linewidth=1.6, marker=marker, markersize=3)
    positive = values[values > 0]
    if not log:
        axes.locator_params(axis="y", nbins=5)
        axes.axhline(0, color=MUTED, linewidth=0.8)
    elif len(positive) == np.isfinite(values).sum():
        axes.set_yscale("log")
    elif len(positive):
        axes.set_yscale("symlog", linthresh=float(positive.min()))
    axes.margins(x=0.01)
    axes.set_xlabel(xlabel, **_LABEL)
    axes.set_title(ylabel, color=INK, fontsize=11, loc="left", pad=6, x=-0.1)
    axes.locator_params(axis="x", nbins=6, integer=True)
    return svg(figure, label)


def plan(box: Float64, view: str, width: int) -> Any:
    """Make a figure with axes of equal scales for a (2, 2) box, m."""
    left, bottom, right, top = 46, 36, 12, 8
    extent = box[1] - box[0]
    inner = width - left - right
    height = float(np.clip(inner * extent[1] / extent[0], 130, 1.1 * inner))
    figure, axes = make_figure(width, height + bottom + top, (left, bottom, right, top))
    # Enlarge the box to the shape of the axes, about its centre.
    scale = max(extent[0] / inner, extent[1] / height)
    centre = box.mean(0)
    axes.set_xlim(centre[0] - scale * inner / 2, centre[0] + scale * inner / 2)
    axes.set_ylim(centre[1] - scale * height / 2, centre[1] + scale * height / 2)
    (a, sa), (b, sb) = plots.VIEWS[view]
    # In metres, the ticks of a camera that hardly moves would need three digits.
    unit, per_m = ("mm", 1000) if max(extent) < _MAX_MM_EXTENT_M else ("m", 1)
    for axis, sign, k, ticks in ((axes.xaxis, sa, a, inner / 60), (axes.yaxis, sb, b, height / 40)):
        axis.set_major_locator(locator(ticks))
        axis.set_major_formatter(partial(_tick, by=sign * per_m))
        axis.set_label_text(f"{plots.AXIS_NAMES[k]}, {unit}", color=MUTED, fontsize=10.5)
        axis.labelpad = 2
    return figure, axes


def _tick(value: float, _: int, *, by: float) -> str:
    return f"{by * value + 0.0:.6g}".replace("-", "−")


def locator(max_ticks: float) -> Any:
    """Return a locator of at most about `max_ticks` ticks, 2 to 6, at round numbers."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=int(np.clip(max_ticks, 2, 6)), steps=[1, 2, 5, 10])
