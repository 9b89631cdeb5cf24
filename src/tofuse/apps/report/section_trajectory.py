"""The trajectory: error per axis and uncertainty over frames, and the optimisation."""

from __future__ import annotations

import numpy as np

from tofuse.apps.report import plots
from tofuse.apps.report.subject import Subject, Values
from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.quantities import count
from tofuse.engine.refinement import calibration_check

_AXES = ("x (right)", "y (down)", "z (forward)", "rotation")


def error(s: Subject) -> Values:
    """Return the error or displacement per axis over frames (figures 5.2, 5.6)."""
    compared = s.reference is not None
    quantity = "error" if compared else "displacement"
    if int(s.result.has_pose.sum()) < 2:
        return {"figures": [], "compared": compared}
    before, after = (_offsets(p, s.reference) for p in (s.sequential, s.result.trajectory))
    bad = s.index[~s.result.has_pose]
    figures = []
    for k, axis in enumerate(_AXES):
        scale, unit = (180 / np.pi, "degrees") if k == 3 else (1.0, "m")
        if k < 3 and np.nanmax(np.abs([before[:, k], after[:, k]])) < 0.1:
            scale, unit = 1000.0, "mm"
        series = {"before": scale * before[:, k], "after": scale * after[:, k]}
        label = f"{quantity.capitalize()} in {axis} over frames, before and after optimisation"
        ylabel = f"{axis}, {unit}"
        figures.append(plots.lines(s.index, series, label=label, ylabel=ylabel, zero=True, bad=bad))
    return {
        "compared": compared,
        "moved": _moved(s),
        "figures": figures,
        "missing": len(bad),
        "rows": [*_rows("Before", before, compared), *_rows("After", after, compared)],
        "uncertainty": _uncertainty(s),
    }


def _moved(s: Subject) -> tuple[float, int] | None:
    """The largest displacement by optimisation in m, and its frame; None if not known."""
    displacement = np.linalg.norm(s.result.trajectory[:, :3, 3] - s.sequential[:, :3, 3], axis=1)
    if not np.isfinite(displacement).any():
        return None
    k = int(np.nanargmax(displacement))
    return float(displacement[k]), int(s.index[k])


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


def _rows(name: str, offsets: Float64, compared: bool) -> list[tuple[str, Float64]]:
    """The errors of the last frame, rms and largest: per axis, of the position, of the rotation."""
    valid = np.abs(offsets[np.isfinite(offsets).all(1)])
    if len(valid) == 0:
        return []
    values = np.insert(valid, 3, np.linalg.norm(valid[:, :3], axis=1), axis=1)
    kinds = {
        "last frame": values[-1],
        "rms": np.sqrt((values**2).mean(0)),
        "largest": values.max(0),
    }
    if not compared:
        del kinds["rms"]
    return [(f"{name}, {kind}", row) for kind, row in kinds.items()]


def _uncertainty(s: Subject) -> list[Values]:
    """Plots of the pose uncertainty over frames: one sigma in the worst direction."""
    C = np.full((len(s.index), 6, 6), np.nan)
    for k, record in enumerate(s.result.diagnostics.frames[: len(C)]):
        if record.covariance is not None:
            C[k] = record.covariance
    bounded = np.isfinite(C).all((1, 2))
    if bounded.sum() < 2:
        return []
    sigma = np.full((len(C), 2), np.nan)
    sigma[bounded] = se3.largest_sigmas(C[bounded]) * [1000.0, 180 / np.pi]
    sigma[:, 1] = np.minimum(sigma[:, 1], 180.0)
    return [
        plots.lines(
            s.index,
            {"after": sigma[:, k]},
            label=f"Standard deviation of the {quantity} over frames",
            ylabel=f"{quantity}, {unit}",
            floor=True,
        )
        for k, (quantity, unit) in enumerate((("position", "mm"), ("rotation", "degrees")))
    ]


def optimisation(s: Subject) -> Values:
    """Return the plot of the objective (figure 5.3), and the outcome of the optimiser."""
    d = s.result.diagnostics
    check = d.refinement and d.refinement.calibration_check
    values = np.array(d.objective, float)
    finite = values[np.isfinite(values)]
    figures, text = [], ""
    if len(finite):
        text = f"From {finite[0]:.4g} to {finite[-1]:.4g}"
        text += f" in {count(len(values) - 1, 'iteration')}."
        chart = plots.lines(
            np.arange(len(values), dtype=float),
            {"after": values},
            label="Objective over iterations",
            ylabel="objective",
            xlabel="iteration",
            log=True,
        )
        figures.append(chart)
    return {
        "figures": figures,
        "text": text,
        "not_improved": any(p.before > 0 and not p.improved for p in d.parts),
        "proposal": check and calibration_check.in_words(check.errors),
    }
