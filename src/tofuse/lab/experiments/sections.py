"""Tables and figures of each case for the page's template."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.apps.report import thumbnails
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.lab.experiments import figures
from tofuse.lab.experiments.cases import GUESSES, METHODS, CaseResult, Estimate, Model, Run
from tofuse.lab.experiments.peaks import PeaksSweep
from tofuse.lab.scenes import box, room
from tofuse.lab.simulation import peaks


@dataclass(frozen=True)
class Figure:
    """A drawing and its caption."""

    svg: str
    caption: str = ""


def case_section(result: CaseResult) -> dict[str, Any]:
    """Return the template's values for one case of the simulator."""
    case = result.case
    previous_runs = {m: result.select(m)[0] for m in METHODS}
    identity_runs = {m: result.select(m, "identity")[0] for m in METHODS}
    first, other = (previous_runs[m] for m in METHODS)
    drifts = [
        Figure(
            figures.drift(
                first.before.score.drift[:, k],
                first.after.score.drift[:, k],
                axis,
                other_method=(other.before.score.drift[:, k], other.after.score.drift[:, k]),
                label=f"Error of the position in {axis}, {case.title}",
            )
        )
        for k, axis in enumerate("xyz")
    ]
    before, after = figures.cameras(first.before.poses, first.after.poses, first.truth)
    return {
        "name": case.scene,
        "title": case.title,
        "section": case.section,
        "text": case.text,
        "stride": case.stride,
        "frames": result.facts["frames"][case.stride],
        "pictures": [_picture(frame) for frame in result.samples],
        "rows": _rows(result),
        "sizes": _sizes(result),
        "plans": _plans(result, identity_runs, previous_runs),
        "drifts": drifts,
        "cameras": [
            Figure(before, "thesis, before optimisation"),
            Figure(after, "thesis, after optimisation"),
        ],
        "objective": Figure(
            figures.objective(first.objective, label=f"Objective, {case.title}"),
            "The objective at every step of the optimiser (figure 5.3), method thesis.",
        )
        if first.objective
        else None,
    }


def _picture(frame: Any) -> str:
    if frame.amplitude_image is None:
        image = thumbnails.depth_image(frame)
    else:
        image = thumbnails.grey(frame.amplitude_image)
    return thumbnails.data_uri(image, jpeg=True)


def _rows(result: CaseResult) -> list[dict[str, Any]]:
    """One row of the table for each method, stride and guess: medians over the draws."""
    rows = []
    for method in METHODS:
        for stride in result.case.strides:
            for guess in GUESSES:
                runs = result.select(method, guess, stride)
                rows.append(
                    {
                        "method": method,
                        "stride": stride,
                        "thesis": stride == result.case.stride,
                        "guess": guess,
                        "draws": len(runs),
                        "posed": f"{_median(r.posed for r in runs):.0f} of {len(runs[0].truth)}",
                        "ate": _pair(runs, lambda e: 100 * e.score.ate_m),
                        "rotation": _pair(runs, lambda e: e.score.rotation_deg),
                        "end": _pair(runs, lambda e: 100 * e.score.end_m),
                        "model": _pair(runs, lambda e: 100 * e.model.sizes["surface_error_m"]),
                        "loop": _count_true([r.loop[0] for r in runs]),
                        "verdict": _by_frequency([r.verdict for r in runs]),
                    }
                )
    return rows


def _median(values: Any) -> float:
    return float(np.median(list(values)))


def _pair(runs: Sequence[Run], value: Callable[[Estimate], float]) -> str:
    before, after = _median(value(r.before) for r in runs), _median(value(r.after) for r in runs)
    return f"{before:.1f} → {after:.1f}"


def _count_true(flags: Sequence[bool]) -> str:
    if len(set(flags)) == 1:
        return "yes" if flags[0] else "no"
    return f"{sum(flags)} of {len(flags)}"


def _by_frequency(values: Sequence[str]) -> str:
    return ", ".join(sorted(set(values), key=lambda v: (-values.count(v), v)))


_SIZES = {
    "length_m": ("Length of the room, m", 1.0, "{:.2f}"),
    "width_m": ("Width of the room, m", 1.0, "{:.2f}"),
    "girth_m": ("Girth of the chest, cm", 100.0, "{:.1f}"),
    "width_a_m": ("First width of the box, mm", 1000.0, "{:.0f}"),
    "width_b_m": ("Second width of the box, mm", 1000.0, "{:.0f}"),
    "height_m": ("Height of the box, mm", 1000.0, "{:.0f}"),
    "worst_angle_deg": ("Worst of the four angles, off 90° by", 1.0, "{:.1f}°"),
    "surface_error_m": ("Distance from the true surface (median), cm", 100.0, "{:.1f}"),
}


def _sizes(result: CaseResult) -> list[list[str]]:
    """Rows of the model measurements: true, by the true poses, then each method."""
    true = {
        "length_m": room.LENGTH,
        "width_m": room.WIDTH,
        "girth_m": result.facts.get("girth_m"),
        "width_a_m": box.WIDTH,
        "width_b_m": box.DEPTH,
        "height_m": box.HEIGHT,
        "worst_angle_deg": 0.0,
        "surface_error_m": 0.0,
    }
    rows = []
    for name, (text, factor, form) in _SIZES.items():
        if name not in result.perfect.sizes:
            continue
        cells = [true[name], result.perfect.sizes[name]]
        for method in METHODS:
            runs = result.select(method)
            cells.append(_median(r.before.model.sizes[name] for r in runs))
            cells.append(_median(r.after.model.sizes[name] for r in runs))
        rows.append([text, *(form.format(factor * float(c or 0)) for c in cells)])
    return rows


def _plans(
    result: CaseResult, identity_runs: dict[str, Run], previous_runs: dict[str, Run]
) -> list[dict[str, Any]]:
    """Top views: a row of three for each method, and one by the true poses."""
    T = result.T_truth_world

    def positions(poses: Float64) -> Float64:
        return (T @ poses)[:, :2, 3]

    def top_view(model: Model) -> Float64:
        return model.points[:, :2].astype(float)

    truth = positions(previous_runs[METHODS[0]].truth)
    outlines = _outlines(result)
    groups = [top_view(r.after.model) for r in previous_runs.values()]
    groups += [top_view(r.before.model) for r in previous_runs.values()]
    # Cameras around an object are excluded from the limits, to show the object larger.
    visible = [] if previous_runs[METHODS[0]].case in ("torso", "box") else [truth]
    limits = figures.plan_limits(*groups, top_view(result.perfect), *outlines, *visible)

    def draw(model: Model, cameras: Float64, title: str, method: str) -> Figure:
        label = f"{result.case.title} from above, {method}, {title}"
        measured = [model.box.corners] if model.box and np.isfinite(model.box.corners).all() else []
        picture = figures.plan(
            top_view(model), cameras, limits, title=title, label=label, true=outlines,
            measured=measured,
        )  # fmt: skip
        return Figure(picture)

    rows = []
    for method in METHODS:
        a, b = identity_runs[method], previous_runs[method]
        rows.append(
            {
                "title": f"Method {method}",
                "figures": [
                    draw(a.before.model, positions(a.before.poses), "identity guess", method),
                    draw(b.before.model, positions(b.before.poses), "previous guess", method),
                    draw(b.after.model, positions(b.after.poses), "optimised", method),
                ],
            }
        )
    perfect = draw(result.perfect, truth, "true poses", "true poses")
    rows.append(
        {"title": "What a perfect registration makes of the same frames", "figures": [perfect]}
    )
    return rows


def _outlines(result: CaseResult) -> list[Float64]:
    """True outlines in the plan, where the thesis drew them or they are informative."""
    name = result.case.scene
    if name in ("room", "empty-room"):
        return [_rectangle(room.LENGTH, room.WIDTH)]
    if name == "box":
        return [_rectangle(box.WIDTH, box.DEPTH)]
    if name == "torso":
        return [_hull(result.surface[:, :2])]
    return []


def _rectangle(length: float, width: float) -> Float64:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, width / 2]


def _hull(points: Float64) -> Float64:
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points).vertices]


def peaks_section(sweep: PeaksSweep) -> dict[str, Any]:
    """Return the template's values for the synthetic case."""
    run = sweep.example[0]
    views, _ = peaks.peaks_views(run.sigma, run.seed)
    before, after = figures.example(run, [v.points.astype(float) for v in views])
    rows = []
    for k, s in enumerate(sweep.sigmas):
        angle = np.degrees(sweep.rotation[k])
        rows.append(
            [f"{s:.2f}", *(f"{v:.3f}" for v in sweep.position[k]), *(f"{v:.2f}" for v in angle)]
        )
    return {
        "rows": rows,
        "seeds": len(sweep.runs) // len(sweep.sigmas),
        "example": [Figure(before), Figure(after)],
        "example_sigma": f"{run.sigma:.2f}",
        "sweep": [Figure(s) for s in figures.sweep(sweep)],
        "objective": Figure(
            figures.objective(run.objective, label="Objective, synthetic data"),
            "The objective at every step of the optimiser.",
        ),
        "gap_m": float(np.linalg.norm(se3.inverse(run.truth[-1])[:3, 3])),
    }
