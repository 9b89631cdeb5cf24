"""The trajectory: cameras before and after optimisation, error per axis, and the objective."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.posegraph.calibration_check import proposal
from tofuse.posegraph.refinement import Refinement
from tofuse.report import plots, words
from tofuse.report.subject import Figure, Subject, Values


def cameras(s: Subject) -> Values:
    """Return the drawings of the cameras before and after (figures 5.4, 5.5)."""
    before, after = s.scene.before, s.scene.after
    if len(after) < 2:
        return {"cameras": [], "cameras_legend": [], "moved": ""}
    figures = []
    groups = [before, after] + ([s.scene.reference] if s.reference is not None else [])
    for view, name in (("above", "from above"), ("side", "from the side")):
        flat = [plots.project(g[:, :3, 3], view) for g in groups]
        box = plots.limits(*flat, margin=0.11, min_margin_m=0.01)
        for poses, color, stage in (
            (before, plots.BEFORE, "before"),
            (after, plots.AFTER, "after"),
        ):
            title = f"{stage}, {name}"
            if len(poses):
                drawing = plots.cameras(
                    poses,
                    box,
                    view,
                    color=color,
                    label=f"Cameras {title}",
                    loops=s.scene.loops if stage == "after" else None,
                    reference=s.scene.reference if s.reference is not None else None,
                )
                figures.append(Figure(drawing, title[0].upper() + title[1:]))
    legend = [("before", "", "before optimisation"), ("after", "", "after optimisation")]
    if len(s.scene.loops):
        legend.append(("loop", "", "loop closures"))
    if s.reference is not None:
        legend.append(("reference", "2 3", "reference trajectory"))
    return {"cameras": figures, "cameras_legend": legend, "moved": _moved(s)}


def _moved(s: Subject) -> str:
    sequential = s.result.diagnostics.sequential
    if sequential.shape != s.result.trajectory.shape:
        return ""
    in_both = np.isfinite(sequential[:, 0, 0]) & s.result.has_pose
    if not in_both.any():
        return ""
    displacement = np.linalg.norm(s.result.trajectory[:, :3, 3] - sequential[:, :3, 3], axis=1)
    displacement[~in_both] = 0
    k = int(displacement.argmax())
    if displacement[k] < 1e-6:
        return "Optimisation changed no pose: the trajectory is that of odometry."
    return (
        f"Optimisation moved poses by up to {words.length(float(displacement[k]))}, "
        f"most at frame {int(s.index[k])}."
    )


def error(s: Subject) -> Values:
    """Return the error or displacement per axis over frames (figures 5.2, 5.6)."""
    result, reference = s.result, s.reference
    compared = reference is not None
    title = (
        "Trajectory error against the reference poses"
        if compared
        else "Displacement from the first camera"
    )
    after, before = result.trajectory, result.diagnostics.sequential
    if before.shape != after.shape:
        before = np.full_like(after, np.nan)
    if int(result.has_pose.sum()) < 2:
        return {"error": [], "error_title": title} | dict.fromkeys(
            ("error_text", "error_legend", "error_rows"), ""
        )
    names = (("Before", before, plots.BEFORE, "--"), ("After", after, plots.AFTER, "-"))
    offsets = [_offsets(poses, reference) for _, poses, _, _ in names]
    bad = s.index[~result.has_pose]
    quantity = "error" if compared else "displacement"
    figures = []
    for k, axis in enumerate(("x (right)", "y (down)", "z (forward)", "rotation")):
        scale, unit = (180 / np.pi, "degrees") if k == 3 else (1.0, "m")
        rows = [o[:, k] * scale for o in offsets]
        if k < 3 and max(np.nanmax(np.abs(r)) for r in rows if np.isfinite(r).any()) < 0.1:
            rows, unit = [1000 * r for r in rows], "mm"
        series = [(r, color, style) for r, (_, _, color, style) in zip(rows, names, strict=True)]
        label = f"{quantity.capitalize()} in {axis} over frames, before and after optimisation"
        svg = plots.lines(
            s.index, series, label=label, ylabel=f"{axis}, {unit}", zero=True, bad=bad
        )
        figures.append(Figure(svg))
    text = (
        "Estimated minus reference position along each axis of the first camera, "
        "both starting at the identity, without further alignment."
        if compared
        else "There is no reference for this recording, so this is the displacement relative to "
        "the first camera: where the camera returned to its start, it is the error."
    )
    legend = [("before", "6 3", "before optimisation"), ("after", "", "after optimisation")]
    if len(bad):
        legend.append(("bad", "x", f"{words.count(len(bad), 'frame')} without a pose"))
    return {
        "error": figures,
        "error_title": title,
        "error_text": text,
        "error_legend": legend,
        "error_rows": _error_rows([n for n, *_ in names], offsets, compared),
    }


def _offsets(poses: Float64, reference: Float64 | None) -> Float64:
    """Return (N, 4): position along x, y, z in m and angle in rad, against the reference.

    Without a reference, against the first pose. NaN where there is none.
    """
    offsets = np.full((len(poses), 4), np.nan)
    valid = np.isfinite(poses).all((1, 2))
    if reference is None:
        base = poses[valid][:1]
        if len(base) == 0:
            return offsets
        target = np.broadcast_to(base, poses.shape)
    else:
        valid &= np.isfinite(reference).all((1, 2))
        target = reference
    offsets[valid, :3] = poses[valid, :3, 3] - target[valid, :3, 3]
    relative = np.swapaxes(target[valid, :3, :3], 1, 2) @ poses[valid, :3, :3]
    offsets[valid, 3] = se3.angle(relative)
    return offsets


def _error_rows(names: list[str], offsets: list[Float64], compared: bool) -> list[list[str]]:
    rows = []
    for name, offset in zip(names, offsets, strict=True):
        valid = offset[np.isfinite(offset).all(1)]
        if len(valid) == 0:
            continue
        kinds = [("last frame", np.abs(valid[-1]))]
        if compared:
            kinds.append(("rms", np.sqrt((valid**2).mean(0))))
        kinds.append(("largest", np.abs(valid).max(0)))
        lengths = np.linalg.norm(valid[:, :3], axis=1)
        totals = {"last frame": lengths[-1], "largest": lengths.max()}
        totals["rms"] = np.sqrt((lengths**2).mean())
        for kind, values in kinds:
            cells = [words.length(float(v)) for v in values[:3]]
            angle = f"{np.degrees(values[3]):.2f}°"
            rows.append([f"{name}, {kind}", *cells, words.length(float(totals[kind])), angle])
    return rows


def uncertainty(s: Subject) -> Values:
    """Return plots of the pose uncertainty over frames: one sigma in the worst direction."""
    C = np.full((len(s.index), 6, 6), np.nan)
    for k, record in enumerate(s.result.diagnostics.frames[: len(C)]):
        if record.covariance is not None:
            C[k] = record.covariance
    bounded = np.isfinite(C).all((1, 2))
    if bounded.sum() < 2:
        return {"uncertainty": []}
    figures, largest = [], se3.largest_sigmas(C[bounded])
    for k, quantity, scale, unit, max_sigma in (
        (0, "position", 1000.0, "mm", np.inf),
        (1, "rotation", 180 / np.pi, "degrees", 180.0),
    ):
        sigma = np.full(len(C), np.nan)
        sigma[bounded] = np.minimum(scale * largest[:, k], max_sigma)
        svg = plots.lines(
            s.index,
            [(sigma, plots.AFTER, "-")],
            label=f"Standard deviation of the {quantity} over frames",
            ylabel=f"{quantity}, {unit}",
            floor=True,
        )
        figures.append(Figure(svg))
    return {"uncertainty": figures}


def optimised(s: Subject) -> Values:
    """Return the outcome of the optimiser and of the refinement as text."""
    d = s.result.diagnostics
    sentences = []
    if len(d.parts) > 1:
        sentences.append(f"The pose graph has {len(d.parts)} disconnected parts.")
    if any(p.before > 0 and not p.improved for p in d.parts):
        sentences.append("The optimiser did not improve on the initial poses.")
    refinement = d.refinement
    refined = ""
    if refinement is not None and refinement.views:
        refined = (
            f"Global refinement over {words.count(refinement.views, 'view')} in "
            f"{words.count(refinement.pairs, 'overlapping pair')}. "
        )
        support = (
            f"{words.percent(refinement.support[0])} to {words.percent(refinement.support[1])}"
        )
        if refinement.kept:
            refined += (
                f"Poses moved by up to {words.length(refinement.moved_m)} and "
                f"{np.degrees(refinement.moved_rad):.2f}°, and consistency rose from {support}."
            )
        elif refinement.pairs:
            refined += f"Consistency fell from {support}: it was discarded."
        else:
            refined = "No two views overlap enough for a global refinement."
    sentences += [f"{prior.text[0].upper()}{prior.text[1:]}." for prior in d.priors]
    return {
        "optimised": " ".join(sentences),
        "refined": refined,
        "camera_check": _camera_check(refinement),
    }


def _camera_check(refinement: Refinement | None) -> str:
    """The check of the camera's calibration as text."""
    if refinement is None or not refinement.views:
        return ""
    text = ""
    if refinement.errors:
        errors_text = [
            f"{name} {words.signed_length(value)}"
            if name == "offset"
            else f"{name} {100 * value:+.1f} %".replace("-", "−")
            for name, value in refinement.errors.items()
        ]
        text = f"Calibration errors were estimated jointly: {', '.join(errors_text)}. "
    check = refinement.calibration_check
    if check is None:
        return text.strip()
    if check.errors:
        verdict = "This is not significant"
        if check.alarm:
            verdict = "Check the calibration"
        elif check.unconfirmed:
            verdict = "The stated accuracy includes its effect"
        correction = proposal(check.errors, check.best)
        text += f"Overlapping views would be more consistent with {correction}. {verdict}. "
    elif not refinement.errors:
        text += "No evidence of errors of the intrinsics or of the range. "
    if check.gap is not None:
        gap, (m, rad), (m_after, rad_after) = check.gap, check.gap.before, check.gap.after
        text += (
            f"Odometry drift over loop {gap.i}–{gap.j} is {words.length(m)}, "
            f"{np.degrees(rad):.1f}°; with this correction {words.length(m_after)}, "
            f"{np.degrees(rad_after):.1f}°."
        )
    return text.strip()


def objective(s: Subject) -> Values:
    """Return the plot of the objective over iterations (figure 5.3)."""
    values = np.array(s.result.diagnostics.objective, float)
    if not np.isfinite(values).any():
        return {"objective": None, "objective_text": ""}
    x = np.arange(len(values), dtype=float)
    finite = values[np.isfinite(values)]
    svg = plots.lines(
        x,
        [(values, plots.AFTER, "-")],
        label="Objective over iterations",
        ylabel="objective",
        xlabel="iteration",
        log=True,
        size=(480, 240),
    )
    text = (
        f"From {finite[0]:.4g} to {finite[-1]:.4g} in {words.count(len(values) - 1, 'iteration')}."
    )
    return {"objective": Figure(svg), "objective_text": text}
