"""Line charts as data for the page's script, and plans as parts of an SVG."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tofuse.apps.report import thumbnails
from tofuse.apps.report.subject import Values
from tofuse.engine.arrays import Float64, UInt8

_MODEL_COLOR = (112, 138, 176)  # of the model's points: visible on white and on near-black
_MAX_QUANTILE = 50_000  # maximum number of points of which quantiles are computed
_MAX_MM_EXTENT_M = 0.6  # plans of smaller extent have ticks in mm
_MARGIN, _MIN_MARGIN_M = 0.06, 0.02  # around a plan
_WIDTH = 382  # of a plan, in pixels


def lines(
    x: Float64,
    series: Mapping[str, Float64],
    *,
    label: str,
    ylabel: str,
    xlabel: str = "frame",
    log: bool = False,
    zero: bool = False,
    floor: bool = False,
    bad: Float64 | None = None,
) -> Values:
    """Return the content of a chart of lines over frames or iterations, for `charts.js`.

    Parameters
    ----------
    x
        Increasing; ticks are at whole numbers if all are.
    series
        y by the name of the line, which is a colour of the page; NaN leaves a gap.
    log
        A logarithmic y axis, linear near 0 if a value is 0.
    zero
        Draw the line y = 0.
    floor
        Begin the y axis at 0.
    bad
        x of frames without a value, marked by crosses on the axis.
    """
    values = np.concatenate([*series.values()])
    values = values[np.isfinite(values)]
    if len(values):
        label += f"; {ylabel}: from {values.min():.3g} to {values.max():.3g}"
    scale: Values = {}  # as uPlot's options are: 3 is logarithmic, 4 is arcsinh
    positive = values[values > 0]
    if log and len(positive):
        distr = 3 if len(positive) == len(values) else 4
        scale = {"distr": distr, "asinh": float(positive.min())}
    return {
        "label": label,
        "xlabel": xlabel,
        "ylabel": ylabel,
        "x": [int(value) if value == int(value) else _rounded(value) for value in x.tolist()],
        "series": {name: [_rounded(value) for value in y.tolist()] for name, y in series.items()},
        "scale": scale,
        "zero": zero,
        "floor": floor,
        "bad": [] if bad is None else bad.astype(int).tolist(),
    }


def _rounded(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None


# Views of the world, x right, y down, z forward: each is (horizontal, vertical) as (axis, sign).
VIEWS: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    "above": ((0, 1), (2, 1)),
    "side": ((2, 1), (1, -1)),
}
AXIS_NAMES = ("right", "down", "forward")


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


def model(
    points: Float64,
    cameras: Float64,
    truth: Float64 | None,
    view: str,
    *,
    measured: Float64,
    label: str,
) -> Values:
    """Return the parts of a plan, the model from above or the side as density of points, in pixels.

    Parameters
    ----------
    points, cameras, truth
        (N, 3) of the model, camera centres, and points on the true surfaces, m.
    measured
        (2, 3) low and high corner of the measured extents, drawn as a box.
    """
    import cv2

    flat, path = project(points, view), project(cameras, view)
    true = np.zeros((0, 2)) if truth is None else project(truth, view)
    box = limits(limits(flat, outer=0.25), path, true)
    extent = box[1] - box[0]
    height = int(np.clip(_WIDTH * extent[1] / extent[0], 130, 1.1 * _WIDTH))
    size = np.array([_WIDTH, height])
    # Enlarge the box to the shape of the picture, about its centre.
    scale = max(extent / size)
    low, high = box.mean(0) - scale * size / 2, box.mean(0) + scale * size / 2

    def pixels(flat: Float64) -> Float64:
        return np.round((flat - low) / scale * [1, -1] + [0, height], 1)

    # In metres, the ticks of a camera that hardly moves would need three digits.
    unit, per_m = ("mm", 1000) if max(extent) < _MAX_MM_EXTENT_M else ("m", 1)
    (a, sa), (b, sb) = VIEWS[view]
    x, y = (_ticks(low[k], high[k], size[k]) for k in range(2))
    turns = cv2.approxPolyDP(pixels(path).astype(np.float32), 0.2, False) if len(path) else path
    return {
        "label": label,
        "width": _WIDTH,
        "height": height,
        "x": [(round((v - low[0]) / scale, 1), _number(sa * per_m * v)) for v in x],
        "y": [(round((high[1] - v) / scale, 1), _number(sb * per_m * v)) for v in y],
        "names": [f"{AXIS_NAMES[k]}, {unit}" for k in (a, b)],
        "image": thumbnails.data_uri(_density(flat, low, high, size)),
        "truth": [pixels(ring).ravel().tolist() for ring in _outlines(true)],
        "measured": np.sort(pixels(project(measured, view)), axis=0).ravel().tolist(),
        "path": [round(v, 1) for v in turns.ravel().tolist()],
    }


def _ticks(low: float, high: float, pixels: float) -> Float64:
    """Round numbers between two values, 2 to 6 or so, for an axis of this length."""
    spacing = (high - low) / np.clip(pixels / 50, 2, 6)
    decade = 10.0 ** np.floor(np.log10(spacing))
    step = decade * min(m for m in (1, 2, 5, 10, 20) if m * decade >= spacing)
    return step * np.arange(np.ceil(low / step), high / step)


def _number(value: float) -> str:
    return f"{value + 0.0:.6g}".replace("-", "−")


def _density(flat: Float64, low: Float64, high: Float64, size: NDArray[np.intp]) -> UInt8:
    """The density of points (N, 2) in a box as opacity, (H, W, 4) RGBA."""
    columns, rows = (0.8 * size).astype(int)
    bounds = ((low[1], high[1]), (low[0], high[0]))
    density = np.histogram2d(flat[:, 1], flat[:, 0], bins=(rows, columns), range=bounds)[0][::-1]
    covered = density > 0
    max_density = np.percentile(density[covered], 99) if covered.any() else 1.0
    alpha = (np.log1p(density) / np.log1p(max_density)).clip(0, 1)
    image = np.full((rows, columns, 4), (*_MODEL_COLOR, 0), np.uint8)
    image[..., 3] = np.round(255 * np.where(covered, 0.3 + 0.7 * alpha, 0))
    return image


def _outlines(flat: Float64) -> list[Float64]:
    """The outer outlines, (K, 2) each, of (N, 2) points on surfaces."""
    import cv2

    if not len(flat):
        return []
    low, high = flat.min(0), flat.max(0)
    extent = np.maximum(high - low, 1e-3)
    # Cells wide enough for a few samples in each, so that surfaces have no holes.
    cell = max(extent.max() / 160, 1.5 * np.sqrt(extent[0] * extent[1] / len(flat)))
    edges = [
        a + cell * (np.arange(-4, int(n) + 7) - 0.5)
        for a, n in zip(low, extent / cell, strict=True)
    ]
    counts, _, _ = np.histogram2d(flat[:, 0], flat[:, 1], bins=edges)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    mask = cv2.morphologyEx((counts.T > 0).astype(np.uint8), cv2.MORPH_CLOSE, cross, iterations=3)
    rings, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [low + cell * (ring[:, 0] - 4) for ring in rings]
