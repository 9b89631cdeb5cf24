"""The contact sheet: some frames of a recording in one picture, with the findings."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.inspection.finding import Finding
from tofuse.apps.inspection.values import flying_pixels
from tofuse.engine.arrays import UInt8
from tofuse.engine.errors import OutputError
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame

_COLUMNS = 5
# Kinds of pixels in the mask, and their colours.
_MASK = (
    ("valid", (225, 228, 232)),
    ("no measurement", (60, 64, 70)),
    ("saturated", (214, 69, 65)),
    ("flying", (226, 40, 160)),
    ("lowest confidence", (240, 190, 70)),
)
_LINE_WIDTH = 125


def write_sheet(
    path: Path, frames: Sequence[Frame], facts: Mapping[str, str], findings: Sequence[Finding]
) -> Path:
    """Write some of the frames, the facts and the findings of an inspection as a PNG.

    Raises
    ------
    OutputError
        If it can't be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    frames = [f for f in frames if len(f)]
    frames = [frames[int(k)] for k in np.linspace(0, len(frames) - 1, min(_COLUMNS, len(frames)))]
    lines = _lines(facts, findings)
    columns = max(len(frames), 2)
    text_height = 0.135 * len(lines) + 0.45
    height = 3 * 1.75 + text_height
    figure = Figure(figsize=(2.35 * columns, height), facecolor="white")
    FigureCanvasAgg(figure)
    place = {"left": 0.01, "right": 0.9, "bottom": text_height / height, "top": 1 - 0.3 / height}
    grid = figure.add_gridspec(3, columns, **place, wspace=0.04, hspace=0.16)
    limits = _limits(frames)
    for column, frame in enumerate(frames):
        axes = [figure.add_subplot(grid[row, column]) for row in range(3)]
        drawn = _draw(axes, frame, limits)
        axes[0].set_title(f"frame {frame.index}", fontsize=8)
        if column == len(frames) - 1 and drawn is not None:
            box = axes[0].get_position()
            bar = figure.add_axes((0.915, box.y0, 0.012, box.height))
            figure.colorbar(drawn, cax=bar)
            bar.tick_params(labelsize=7)
            bar.set_title("m", fontsize=8)
    for row, (name, colour) in enumerate(_MASK):
        y, darker = (text_height + 0.25 * row) / height, np.array(colour) / 255 * 0.75
        figure.text(0.912, y, f"■ {name}", fontsize=6, color=darker)
    top = (text_height - 0.2) / height
    figure.text(0.012, top, "\n".join(lines), fontsize=7.5, va="top", family="monospace")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, metadata={"Software": None})
    except OSError as error:
        raise OutputError(
            f"can't be written ({error.strerror or error})",
            where=path,
            remedy="choose another name",
        ) from error
    return path


def _lines(facts: Mapping[str, str], findings: Sequence[Finding]) -> list[str]:
    out = [f"{name:<16} {fact}"[:_LINE_WIDTH] for name, fact in facts.items()]
    out.append("")
    for finding in findings:
        text = f"{finding.severity}: {finding.code}: {finding.text}"
        out += textwrap.wrap(text, _LINE_WIDTH, subsequent_indent="    ")
    if not findings:
        out.append("all checks passed")
    return [line.replace("$", r"\$") for line in out]


def _limits(frames: list[Frame]) -> tuple[float, float]:
    depths = [f.radial_range[f.valid] for f in frames if isinstance(f, RangeFrame)]
    if not depths:
        return 0.0, 1.0
    low, high = np.percentile(np.concatenate(depths), [1, 99])
    return float(low), float(max(high, low + 1e-3))


def _draw(axes: list[Any], frame: Frame, limits: tuple[float, float]) -> Any:
    """Draw range, amplitude or colour, and mask of a frame; or projections of a cloud."""
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    if not isinstance(frame, RangeFrame):
        points = frame.points[:: max(1, len(frame) // 20000)]
        for axis, (a, b) in zip(axes, ((0, 1), (0, 2), (2, 1)), strict=True):
            axis.scatter(points[:, a], points[:, b], s=0.2, c="#27496d", linewidths=0)
            axis.set_aspect("equal")
        return None
    z = np.where(frame.valid, frame.radial_range, np.nan)
    shown = axes[0].imshow(z, vmin=limits[0], vmax=limits[1], cmap="viridis")
    axes[0].set_facecolor("#3c4046")
    axes[1].imshow(_appearance(frame))
    axes[2].imshow(_mask(frame))
    return shown


def _appearance(frame: RangeFrame) -> UInt8:
    """Colour, or the logarithm of the amplitude, as (H, W, 3)."""
    if frame.color_image is not None:
        return frame.color_image
    amplitude = frame.amplitude_image
    if amplitude is None:
        return np.full((*frame.depth.shape, 3), 128, np.uint8)
    grey = np.log1p(np.minimum(amplitude, SATURATED_AMPLITUDE))
    usable = grey[(amplitude > 0) & (amplitude < SATURATED_AMPLITUDE)]
    low, high = np.percentile(usable, [1, 99]) if len(usable) else (0.0, 1.0)
    value = np.clip((grey - low) / max(high - low, 1e-6), 0, 1) * 255
    return np.repeat(value.astype(np.uint8)[..., None], 3, -1)


def _mask(frame: RangeFrame) -> UInt8:
    kind = np.where(frame.valid, 0, 1)
    if frame.confidence_image is not None:
        kind[frame.valid & (frame.confidence_image == 0)] = 4
    kind[flying_pixels(frame)] = 3
    if frame.amplitude_image is not None:
        kind[frame.amplitude_image >= SATURATED_AMPLITUDE] = 2
    return np.array([colour for _, colour in _MASK], np.uint8)[kind]
