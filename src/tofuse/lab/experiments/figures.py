"""Figures of chapters 4 and 5 as inline SVG in the page's colours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tofuse.apps.report import plots
from tofuse.engine.arrays import Float64
from tofuse.lab.experiments import drawing
from tofuse.lab.experiments.peaks import AXES, PeaksRun, PeaksSweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_POINTS_RGB = (112, 138, 176)
_MARGINS = (50.0, 36.0, 12.0, 26.0)  # left, bottom, right, top, in pixels


def plan_limits(*groups: Float64) -> Float64:
    """(2, 2) low and high corners around most of the points of groups (N, 2)."""
    return plots.limits(*groups, outer=0.5)


def plan(
    points: Float64,
    cameras: Float64,
    box: Float64,
    *,
    title: str,
    label: str,
    true: Sequence[Float64] = (),
    measured: Sequence[Float64] = (),
) -> str:
    """Draw a model from above as density of points (figures 5.4, 5.7, 5.8, 5.10).

    Parameters
    ----------
    points, cameras
        (N, 2) points and camera positions in the plan, m; lost cameras are NaN.
    box
        (2, 2) corners of the picture, for a common scale.
    true, measured
        True and measured closed outlines (K, 2).
    """
    extent = box[1] - box[0]
    width, inner_width = 380, 318.0
    height = float(np.clip(inner_width * extent[1] / extent[0], 120, 1.15 * inner_width))
    figure, axes = drawing.make_figure(width, height + 62, _MARGINS)
    scale = max(extent[0] / inner_width, extent[1] / height)
    centre = box.mean(0)
    x0, x1 = centre[0] - scale * inner_width / 2, centre[0] + scale * inner_width / 2
    y0, y1 = centre[1] - scale * height / 2, centre[1] + scale * height / 2
    columns = int(0.75 * inner_width)
    rows = max(2, int(columns * height / inner_width))
    density, _, _ = np.histogram2d(
        points[:, 1], points[:, 0], bins=(rows, columns), range=((y0, y1), (x0, x1))
    )
    dense = np.percentile(density[density > 0], 99) if (density > 0).any() else 1.0
    image = np.zeros((rows, columns, 4), np.uint8)
    image[..., :3] = _POINTS_RGB
    shade = (np.log1p(density) / np.log1p(dense)).clip(0, 1)
    # Few levels keep the file small.
    image[..., 3] = np.where(density > 0, 60 + 13 * np.round(15 * shade), 0).astype(np.uint8)
    axes.imshow(image, extent=(x0, x1, y0, y1), origin="lower", interpolation="none", aspect="auto")
    outlines = (true, drawing.BAD, "dashed"), (measured, drawing.AFTER, "solid")
    for polygons, color, style in outlines:
        for polygon in polygons:
            closed = np.vstack([polygon, polygon[:1]])
            axes.plot(*closed.T, color=color, linestyle=style, linewidth=1.5)
    axes.plot(*cameras.T, color=drawing.INK, linewidth=1)
    axes.plot(*cameras[0], "o", color=drawing.INK, markersize=4)
    axes.set_xlim(x0, x1)
    axes.set_ylim(y0, y1)
    for axis, size in ((axes.xaxis, inner_width), (axes.yaxis, height)):
        axis.set_major_locator(drawing.locator(size / 45))
    _label(axes, "x, m", f"{title} — y, m")
    return drawing.svg(figure, label)


def _label(axes: Axes, x: str, title: str) -> None:
    axes.set_xlabel(x, color=drawing.MUTED, fontsize=10.5, labelpad=2)
    axes.set_title(title, color=drawing.INK, fontsize=11, loc="left", pad=6, x=-0.1)


def drift(
    before: Float64, after: Float64, axis: str, *, other_method: tuple[Float64, Float64], label: str
) -> str:
    """Plot the error of the position along one axis (figures 5.2, 5.6).

    `other_method` is that of the other method before and after, dotted.
    """
    return drawing.lines(
        [
            (100 * other_method[0], drawing.BEFORE, ":"),
            (100 * other_method[1], drawing.AFTER, ":"),
            (100 * before, drawing.BEFORE, "-"),
            (100 * after, drawing.AFTER, "-"),
        ],
        label=label,
        ylabel=f"error in {axis}, cm",
        size=(330, 200),
    )


def objective(values: Sequence[float], *, label: str) -> str:
    """Plot the optimiser's objective at every step (figure 5.3)."""
    return drawing.lines(
        [(np.array(values), drawing.AFTER, "-")],
        label=label,
        ylabel="objective (eq 2.10)",
        xlabel="step",
        log=True,
        size=(380, 220),
    )


def cameras(before: Float64, after: Float64, truth: Float64) -> tuple[str, str]:
    """Draw the cameras before and after at the same scale (figure 5.5); poses (N, 4, 4)."""
    has_pose = np.isfinite(before[:, 0, 0])
    before, after = before[has_pose], after[has_pose]
    projected = [plots.project(p[:, :3, 3], "above") for p in (before, after, truth)]
    box = plots.limits(*projected)
    return (
        _cameras(before, box, truth, drawing.BEFORE, "before"),
        _cameras(after, box, truth, drawing.AFTER, "after"),
    )


def _cameras(poses: Float64, box: Float64, truth: Float64, color: str, name: str) -> str:
    """Draw camera positions and viewing directions (n, 4, 4), and the true trajectory, in a box."""
    figure, axes = drawing.plan(box, "above", 380)
    size = 0.05 * float((box[1] - box[0]).max())
    path, centers = (plots.project(p[:, :3, 3], "above") for p in (truth, poses))
    axes.plot(*path.T, color=drawing.REFERENCE, linewidth=1.4, linestyle=(0, (1, 1.2)))
    axes.plot(*centers.T, color=color, linewidth=1)
    shape = size * np.array([[-0.5, 0, 1], [0, 0, 0], [0.5, 0, 1], [-0.5, 0, 1]])
    for k in range(0, len(poses), -(-len(poses) // 72)):
        scale, linewidth = (1.7, 1.8) if k == 0 else (1.0, 0.9)
        world = poses[k, :3, :3] @ (scale * shape.T) + poses[k, :3, 3:]
        axes.plot(*plots.project(world.T, "above").T, color=color, linewidth=linewidth)
    axes.plot(*centers[0], "o", color=color, markersize=4)
    return drawing.svg(figure, f"Cameras {name} optimisation, from above")


def sweep(result: PeaksSweep) -> list[str]:
    """Draw figure 5.12: mean error and standard deviation of each parameter over the noise."""
    pictures = []
    for k, name in enumerate(AXES):
        figure, axes = drawing.make_figure(330, 220, _MARGINS)
        unit, factor = ("m", 1.0) if k < 3 else ("°", 180 / np.pi)
        for which, color in ((0, drawing.BEFORE), (1, drawing.AFTER)):
            mean = factor * result.axes[:, which, k]
            deviation = factor * result.axes_std[:, which, k]
            low, high = np.maximum(mean - deviation, 0), mean + deviation
            axes.fill_between(result.sigmas, low, high, color=color, alpha=0.18, linewidth=0)
            axes.plot(result.sigmas, mean, color=color, linewidth=1.6, marker="o", markersize=3)
        axes.set_ylim(bottom=0)
        axes.locator_params(axis="y", nbins=5)
        axes.locator_params(axis="x", nbins=6)
        _label(axes, "sigma, m", f"mean error in {name}, {unit}")
        pictures.append(drawing.svg(figure, f"Mean error in {name} over the noise"))
    return pictures


def example(run: PeaksRun, clouds: Sequence[Float64]) -> tuple[str, str]:
    """Draw figure 5.11 from above: the chain, and true, chained and optimised cameras.

    `clouds` are the (N, 3) points of the views in their cameras' frames, m.
    """
    style: Any = {"markersize": 4, "linewidth": 1}
    pictures = []
    estimates = (run.poses_sequential, run.poses_optimised)
    projected = [plots.project(p[:, :3, 3], "above") for p in (*estimates, run.truth)]
    box = plots.limits(*projected)
    for k, (poses, name) in enumerate(zip(estimates, ("before", "after"), strict=True)):
        points = np.concatenate(
            [c @ T[:3, :3].T + T[:3, 3] for c, T in zip(clouds, poses, strict=True)]
        )
        figure, axes = drawing.make_figure(400, 400 * 0.95, _MARGINS)
        sample = points[:: max(1, len(points) // 3000)]
        dots: Any = {"markersize": 1.2, "alpha": 0.5, "rasterized": True}
        axes.plot(*sample[:, [0, 2]].T, ".", color=drawing.MUTED, **dots)
        if k == 1:
            for true, estimate in zip(projected[2], projected[1], strict=True):
                axes.plot(*np.stack([true, estimate], 1), color=drawing.GRID, linewidth=1)
            axes.plot(*projected[2].T, "s", color=drawing.REFERENCE, markersize=4)
            axes.plot(*projected[1].T, "o-", color=drawing.AFTER, **style)
        axes.plot(*projected[0].T, "o-", color=drawing.BEFORE, **style)
        axes.set_xlim(*box[:, 0])
        axes.set_ylim(*box[:, 1])
        axes.set_aspect("equal", "box")
        _label(axes, "x, m", f"{name} optimisation — z, m")
        pictures.append(drawing.svg(figure, f"The synthetic case {name} optimisation, from above"))
    return pictures[0], pictures[1]
