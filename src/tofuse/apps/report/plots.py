"""Plots as inline SVG that uses the page's colours, so that it follows its light or dark theme."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from tofuse.engine.arrays import Float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Placeholders that `svg` replaces by the page's variables of the same names.
INK, MUTED, GRID = "#010101", "#020202", "#030303"
BEFORE, AFTER, REFERENCE, BAD = "#040404", "#050505", "#060606", "#080808"
_VARIABLES = {INK: "ink", MUTED: "muted", GRID: "grid"}
_VARIABLES |= {BEFORE: "before", AFTER: "after", REFERENCE: "reference", BAD: "bad"}
_MODEL_COLOR = (112, 138, 176)  # of the model's points: visible on white and on near-black
_MAX_QUANTILE = 50_000  # maximum number of points of which quantiles are computed
_MAX_MM_EXTENT_M = 0.6  # plans of smaller extent have ticks in mm
_MARGIN, _MIN_MARGIN_M = 0.06, 0.02  # around a plan
_WIDTH = 440  # of a plan, in pixels
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
    x: Float64,
    series: Sequence[tuple[Float64, str, str]],
    *,
    label: str,
    ylabel: str,
    xlabel: str = "frame",
    log: bool = False,
    zero: bool = False,
    floor: bool = False,
    bad: Float64 | None = None,
    size: tuple[int, int] = (400, 210),
) -> str:
    """Plot lines over frames or iterations.

    Parameters
    ----------
    series
        (y, colour, line style); NaN leaves a gap.
    log
        A logarithmic y axis, linear near 0 if a value is 0.
    zero
        Draw the line y = 0.
    floor
        Begin the y axis at 0.
    bad
        x of frames without a value, marked by crosses on the axis.
    """
    figure, axes = make_figure(*size, (52, 36, 10, 20))
    for y, color, style in series:
        sparse = len(x) == 1 or (int(np.isfinite(y).sum()) <= 30 and style == "-")
        marker = "o" if sparse else None
        axes.plot(x, y, color=color, linestyle=style, linewidth=1.6, marker=marker, markersize=3)
    if log:
        values = np.concatenate([y for y, _, _ in series])
        values = values[np.isfinite(values)]
        if (values > 0).all():
            axes.set_yscale("log")
        elif (values > 0).any():
            axes.set_yscale("symlog", linthresh=float(values[values > 0].min()))
    else:
        axes.locator_params(axis="y", nbins=5)
    if zero:
        axes.axhline(0, color=MUTED, linewidth=0.8)
    if floor:
        axes.set_ylim(0, 1.03 * axes.get_ylim()[1])
    if bad is not None and len(bad):
        on_axis = axes.get_xaxis_transform()
        axes.plot(bad, 0 * bad, "x", color=BAD, markersize=5, transform=on_axis, clip_on=False)
    if len(x) > 1:
        padding = 0.01 * (x[-1] - x[0])
        axes.set_xlim(x[0] - padding, x[-1] + padding)
    axes.set_xlabel(xlabel, **_LABEL)
    axes.set_title(ylabel, color=INK, fontsize=11, loc="left", pad=6, x=-0.1)
    axes.locator_params(axis="x", nbins=6, integer=True)
    return svg(figure, label)


# Views of the world, x right, y down, z forward: each is (horizontal, vertical) as (axis, sign).
VIEWS: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    "above": ((0, 1), (2, 1)),
    "side": ((2, 1), (1, -1)),
}
_NAMES = {0: "right", 1: "down", 2: "forward"}


def project(points: Float64, view: str) -> Float64:
    """Return (N, 2) picture coordinates in m, up and right positive, of (N, 3) world points."""
    (a, sa), (b, sb) = VIEWS[view]
    return np.stack([sa * points[:, a], sb * points[:, b]], axis=1)


def limits(*groups: Float64, outer: float = 0.0) -> Float64:
    """Return (2, 2) low and high corners around groups of (N, 2) points.

    `outer` percent of the points are left out at each end. The border is `_MARGIN` of the size,
    and at least `_MIN_MARGIN_M`.
    """
    sampled = [g[:: -(-len(g) // _MAX_QUANTILE)] if outer else g for g in groups if len(g)]
    boxes = [np.percentile(g, [outer, 100 - outer], axis=0) for g in sampled]
    if not boxes:
        return np.array([[-0.5, -0.5], [0.5, 0.5]])
    low = np.min([b[0] for b in boxes], axis=0)
    high = np.max([b[1] for b in boxes], axis=0)
    border = np.maximum(_MARGIN * (high - low).max(), _MIN_MARGIN_M)
    return np.stack([low - border, high + border])


def plan(box: Float64, view: str, width: int = _WIDTH) -> Any:
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
    (a, sa), (b, sb) = VIEWS[view]
    # In metres, the ticks of a camera that hardly moves would need three digits.
    unit, per_m = ("mm", 1000) if max(extent) < _MAX_MM_EXTENT_M else ("m", 1)
    for axis, sign, k, ticks in (
        (axes.xaxis, sa, a, inner / 60),
        (axes.yaxis, sb, b, height / 40),
    ):
        axis.set_major_locator(locator(ticks))
        axis.set_major_formatter(partial(_tick, by=sign * per_m))
        axis.set_label_text(f"{_NAMES[k]}, {unit}", color=MUTED, fontsize=10.5)
        axis.labelpad = 2
    return figure, axes


def _tick(value: float, _: int, *, by: float) -> str:
    return f"{by * value + 0.0:.6g}".replace("-", "−")


def locator(max_ticks: float) -> Any:
    """Return a locator of at most about `max_ticks` ticks, 2 to 6, at round numbers."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=int(np.clip(max_ticks, 2, 6)), steps=[1, 2, 5, 10])


def model(
    points: Float64,
    cameras: Float64,
    truth: Float64 | None,
    view: str,
    *,
    measured: Float64 | None,
    label: str,
) -> str:
    """Draw the model from above or the side, as density of points.

    Parameters
    ----------
    points, cameras, truth
        (N, 3) of the model, camera centres, and points on the true surfaces, m.
    measured
        (2, 3) low and high corner of the measured extents, drawn as a box.
    """
    flat, path = project(points, view), project(cameras, view)
    true = None if truth is None else project(truth, view)
    box = limits(flat, outer=0.25)
    box = limits(box, path, *([] if true is None else [true]))
    figure, axes = plan(box, view)
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    columns = int(0.8 * (_WIDTH - 58))
    rows = max(2, int(columns * (y1 - y0) / (x1 - x0)))
    bounds = ((y0, y1), (x0, x1))
    density, _, _ = np.histogram2d(flat[:, 1], flat[:, 0], bins=(rows, columns), range=bounds)
    covered = density > 0
    max_density = np.percentile(density[covered], 99) if covered.any() else 1.0
    alpha = (np.log1p(density) / np.log1p(max_density)).clip(0, 1)
    image = np.full((rows, columns, 4), (*_MODEL_COLOR, 0), np.uint8)
    image[..., 3] = np.round(255 * np.where(covered, 0.3 + 0.7 * alpha, 0))
    # Over the grid.
    style: Any = {"origin": "lower", "interpolation": "none", "aspect": "auto", "zorder": 1}
    axes.imshow(image, extent=(x0, x1, y0, y1), **style)
    if true is not None and len(true):
        _outline(axes, true)
    if measured is not None:
        low, high = np.sort(project(measured, view), axis=0)
        corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
        axes.plot(*corners.T, color=AFTER, linewidth=1.2)
    if len(path):
        axes.plot(path[:, 0], path[:, 1], color=INK, linewidth=1)
        axes.plot(path[0, 0], path[0, 1], "o", color=INK, markersize=4)
    return svg(figure, label)


def _outline(axes: Axes, flat: Float64) -> None:
    """Draw the outer outline of (K, 2) points as a dashed line."""
    from scipy import ndimage

    low, high = flat.min(0), flat.max(0)
    extent = np.maximum(high - low, 1e-3)
    # Cells wide enough for a few samples in each, so that surfaces have no holes.
    cell = max(extent.max() / 160, 1.5 * np.sqrt(extent[0] * extent[1] / len(flat)))
    edges = [a + cell * np.arange(-4, int(n) + 6) for a, n in zip(low, extent / cell, strict=True)]
    counts, x, y = np.histogram2d(flat[:, 0], flat[:, 1], bins=edges)
    mask = ndimage.binary_fill_holes(ndimage.binary_closing(counts > 0, iterations=3))
    # Half a cell inside the cells' rim, which is half a cell outside the surface.
    x, y = x[:-1] + cell / 2, y[:-1] + cell / 2
    style: Any = {"colors": BAD, "linewidths": 1.6, "linestyles": "dashed"}
    axes.contour(x, y, mask.T.astype(float), levels=[0.5], **style)
