"""tofuse's tracker compared with its peers on the same frames: speed, accuracy, map consistency.

Every method gets the same frames, decoded, corrected and filtered beforehand. Only the tracking of
a frame is timed, not its conversion to the method's data type. Each row is measured after a warm-up
pass over the first frames, and without the first frame. Peers run the first frames with each of
their tunings, with and without the filters that tofuse uses for its model, and continue with the
combination that has the lowest ATE; tofuse has one tuning for all sequences. Rows of one run are
comparable with each other, not with those of another machine. Peers come with `pip install
tofuse[bench]`; missing ones are reported.

    python benchmarks/tracking.py [--sequences kitchen room] [--methods tofuse KISS] [--frames 50]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import peers
import sequences
from tofuse.engine.arrays import Float64
from tofuse.engine.compute.thread_pool import threads as using_threads
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.methods import default
from tofuse.engine.quality.map_agreement import map_consistency
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.engine.tracking.keyframes import Keyframes
from tofuse.formats.files.atomic import write_text

WARM_UP = 5
CONSISTENCY_FRAMES = 60


@dataclass(frozen=True)
class Tofuse:
    """The default tracker."""

    label: str = "tofuse"
    photometric: bool = True

    @property
    def tuning(self) -> str:
        return "defaults" if self.photometric else "defaults, without the photometric term"

    def resolution(self, frame: RangeFrame) -> str:
        columns = frame.camera.width
        while columns > keyframes().views.columns:
            columns //= 2
        return f"{columns} columns of {peers.grid(frame)}"

    def start(self, frame: RangeFrame, threads: int) -> TofuseSession:
        return TofuseSession(self.photometric)


def keyframes() -> Keyframes:
    """Return the tracker of the default method."""
    odometry = default("range").odometry
    assert isinstance(odometry, Keyframes)
    return odometry


class TofuseSession:
    def __init__(self, photometric: bool) -> None:
        options = keyframes()
        views = replace(options.views, photometric=photometric)
        self._tracker = replace(options, views=views).start(0)
        self.statuses: list[str] = []
        self.unconstrained: list[int] = []
        self.reasons: list[str] = []
        # Components connected with the first one, and positions of the frames.
        self._T_world_component: dict[int, Float64] = {0: np.eye(4)}
        self._T_world_camera: dict[int, Float64] = {}

    def prepare(self, frame: RangeFrame) -> RangeFrame:
        # A copy, without derived data cached by another method.
        return replace(frame)

    def push(self, prepared: RangeFrame) -> Float64 | None:
        step = self._tracker.push(prepared)
        self.statuses.append(step.status)
        self.reasons.append(step.reason)
        self.unconstrained.append(len(step.registration.unobservable) if step.registration else 0)
        T = step.T_component_camera
        for link in step.links:
            if link.certain and T is not None and link.i in self._T_world_camera:
                T_world = self._T_world_camera[link.i] @ link.T_i_j @ se3.inverse(T)
                self._T_world_component.setdefault(step.component, T_world)
        if T is None or step.component not in self._T_world_component:
            return None
        found: Float64 = self._T_world_component[step.component] @ T
        self._T_world_camera[prepared.index] = found
        return found


@dataclass(frozen=True, eq=False)
class Run:
    """Result of a method on a sequence: poses (N, 4, 4), NaN where lost, and seconds (N,).

    `cpu` is the CPU time of all threads, which hardly depends on other load.
    """

    poses: Float64
    seconds: Float64
    cpu: Float64
    details: dict[str, Any]


def run(method: peers.Method, frames: Items[RangeFrame], threads: int) -> Run:
    """Run a method over frames."""
    session = method.start(frames[0], threads)
    poses = np.full((len(frames), 4, 4), np.nan)
    seconds, cpu = np.empty((2, len(frames)))
    with using_threads(threads):
        for k, frame in enumerate(frames):
            prepared = session.prepare(frame)
            start, cpu_start = time.perf_counter(), time.process_time()
            T = session.push(prepared)
            seconds[k], cpu[k] = time.perf_counter() - start, time.process_time() - cpu_start
            if T is not None:
                poses[k] = T
    details = {}
    if isinstance(session, TofuseSession):
        details = {
            "statuses": session.statuses,
            "unconstrained": session.unconstrained,
            "reasons": session.reasons,
        }
    return Run(poses, seconds, cpu, details)


def best(
    candidates: Items[peers.Method], sequence: sequences.Sequence, threads: int, frames: int
) -> tuple[peers.Method, bool, str]:
    """Choose a peer's tuning and filtering by the lowest ATE on the first frames.

    Returns the method, whether it gets the cleaned frames, and how it was chosen. All tunings run
    on the cleaned frames, then the best of them on the others.
    """
    first = sequence.cleaned[:frames]
    reference = sequence.reference[: len(first)]
    errors = [ate(run(c, first, threads).poses, reference) for c in candidates]
    chosen = candidates[int(np.nanargmin(errors))]
    bare = ate(run(chosen, sequence.frames[:frames], threads).poses, reference)
    cleaned = not bare < min(errors)
    how = f"best of {len(candidates)} on {len(first)} frames, " if len(candidates) > 1 else ""
    return chosen, cleaned, f"{how}{'cleaned' if cleaned else 'filtered as for tofuse'}"


def ate(poses: Float64, reference: Float64) -> float:
    times = np.arange(len(poses), dtype=float)
    if np.isfinite(poses).all((1, 2)).sum() < 2:
        return np.inf
    return evaluate_trajectory(times, poses, times, reference).ate_rms_m


def row(
    method: peers.Method, chosen_how: str, sequence: sequences.Sequence, result: Run, threads: int
) -> dict[str, Any]:
    """Return all metrics of one method on one sequence: m, degrees, ms."""
    ms = 1e3 * result.seconds[1:]
    return {
        "method": method.label,
        "resolution": method.resolution(sequence.frames[0]),
        "tuning": f"{method.tuning}{'; ' if chosen_how else ''}{chosen_how}",
        "threads": threads,
        "ms_median": float(np.median(ms)) if len(ms) else None,
        "ms_p95": float(np.percentile(ms, 95)) if len(ms) else None,
        "cpu_ms_median": float(np.median(1e3 * result.cpu[1:])) if len(ms) else None,
        **accuracy(sequence, result.poses),
        **result.details,
    }


def accuracy(sequence: sequences.Sequence, poses: Float64) -> dict[str, Any]:
    """Return errors of the poses against the reference, and map consistency."""
    times = np.arange(len(poses), dtype=float)
    error = evaluate_trajectory(times, poses, times, sequence.reference, times)
    agreement = map_consistency(sequence.checked, poses, CONSISTENCY_FRAMES)
    # Error at the end, aligned at the first frame only: drift over the sequence.
    true = se3.inverse(sequence.reference[0]) @ sequence.reference
    has = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    gaps = se3.inverse(true[has]) @ se3.inverse(poses[has[0]]) @ poses[has]
    metres, degrees = np.linalg.norm(gaps[:, :3, 3], axis=1), np.degrees(se3.angle(gaps))
    per_frame = np.full((len(poses), 2), np.nan)
    per_frame[has] = np.stack([metres, degrees], 1)
    short, long = error.relative
    return {
        "ate_m": error.ate_rms_m,
        "rotation_deg": float(np.degrees(error.rotation_rms_rad)),
        "rpe1_m": short.translation_rms_m,
        "rpe1_deg": float(np.degrees(short.rotation_rms_rad)),
        "rpe30_m": long.translation_rms_m,
        "rpe30_deg": float(np.degrees(long.rotation_rms_rad)),
        "end_m": float(metres[-1]),
        "end_deg": float(degrees[-1]),
        "mean_m": float(metres.mean()),
        "mean_deg": float(degrees.mean()),
        "coverage": error.coverage,
        "map_rms_m": agreement.rms_m,
        "map_inliers": agreement.inlier_ratio,
        "per_frame": per_frame.tolist(),
    }


def compare(
    sequence: sequences.Sequence, wanted: Items[str], threads: int, tuning_frames: int
) -> Iterator[dict[str, Any]]:
    """Run the methods on a sequence, one after the other, and yield their rows."""
    frames = sequence.frames
    ours: list[list[peers.Method]] = [[Tofuse()]]
    if frames[0].amplitude_image is not None:
        ours.append([Tofuse("tofuse, geometry only", photometric=False)])
    for candidates in [*ours, *peers.all_methods(frames[0])]:
        label = candidates[0].label
        if wanted and not any(label.lower().startswith(w.lower()) for w in wanted):
            continue
        try:
            run(candidates[0], frames[:WARM_UP], threads)
            chosen, cleaned, how = candidates[0], False, ""
            if not isinstance(chosen, Tofuse):
                chosen, cleaned, how = best(candidates, sequence, threads, tuning_frames)
            result = run(chosen, sequence.cleaned if cleaned else frames, threads)
        except ImportError as error:
            yield {"method": label, "problem": f"not installed ({error})"}
            continue
        except RuntimeError as error:
            yield {"method": label, "problem": f"failed: {str(error).strip().splitlines()[-1]}"}
            continue
        yield row(chosen, how, sequence, result, threads)
    yield {"method": "reference poses", **accuracy(sequence, sequence.reference)}


_COLUMNS = {
    "method": "method",
    "resolution": "resolution",
    "ms": "ms/frame: median (95 %)",
    "ratio": "of tofuse",
    "cpu": "CPU ms",
    "ate": "ATE m",
    "rotation": "rotation deg",
    "rpe1": "RPE 1: m, deg",
    "rpe30": "RPE 30: m, deg",
    "end": "at the end: m, deg",
    "mean": "mean: m, deg",
    "coverage": "coverage",
    "map": "map mm, inliers",
    "tuning": "tuning",
}


def cells(r: dict[str, Any], ours_ms: float | None) -> list[str]:
    """Return a row of the table."""
    if "problem" in r:
        return [r["method"], r["problem"], *[""] * (len(_COLUMNS) - 2)]
    ms = r.get("ms_median")
    pairs = {
        key: f"{r[f'{key}_m']:.3f}, {r[f'{key}_deg']:.2f}"
        for key in ("rpe1", "rpe30", "end", "mean")
    }
    texts = {
        "method": r["method"],
        "resolution": r.get("resolution", ""),
        "ms": "" if ms is None else f"{ms:.1f} ({r['ms_p95']:.1f})",
        "ratio": f"x {ms / ours_ms:.1f}" if ms is not None and ours_ms else "",
        "cpu": "" if ms is None else f"{r['cpu_ms_median']:.1f}",
        "ate": f"{r['ate_m']:.4f}",
        "rotation": f"{r['rotation_deg']:.2f}",
        **pairs,
        "coverage": f"{r['coverage']:.0%}",
        "map": f"{1e3 * r['map_rms_m']:.1f}, {100 * r['map_inliers']:.1f} %",
        "tuning": r.get("tuning", ""),
    }
    return [texts[key].replace("nan, nan", "-") for key in _COLUMNS]


def table(rows: Items[dict[str, Any]]) -> str:
    """Return rows as a Markdown table with aligned columns."""
    ours = next((r.get("ms_median") for r in rows if r["method"] == "tofuse"), None)
    lines = [list(_COLUMNS.values()), *[cells(r, ours) for r in rows]]
    # The last column is not padded.
    widths = [*[max(len(line[k]) for line in lines) for k in range(len(_COLUMNS) - 1)], 6]
    text = [
        "| " + " | ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) + " |"
        for line in lines
    ]
    text.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(text)


def figure(found: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Plot the time per frame against the ATE, a panel for each sequence."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    columns = min(3, len(found))
    lines = -(-len(found) // columns)
    fig, axes = plt.subplots(lines, columns, figsize=(5 * columns, 4 * lines), squeeze=False)
    for axis in axes.flat[len(found) :]:
        axis.set_axis_off()
    labels = sorted({r["method"] for rows in found.values() for r in rows if "ms_median" in r})
    for axis, (title, rows) in zip(axes.flat, found.items(), strict=False):
        for r in rows:
            if r.get("ms_median") is None:
                continue
            k = labels.index(r["method"])
            marker = "*" if r["method"].startswith("tofuse") else "o^svDPX"[k % 7]
            axis.plot(
                r["ms_median"], r["ate_m"], marker, color=f"C{k % 10}", label=r["method"], ms=9
            )
        axis.set(xscale="log", yscale="log", title=title, xlabel="ms/frame", ylabel="ATE, m")
        axis.title.set_fontsize(8)
        axis.grid(which="both", alpha=0.3)
        axis.legend(fontsize=6)
    fig.tight_layout()
    fig.savefig(path, dpi=110)
    plt.close(fig)


def machine(threads: int) -> str:
    """Describe the machine."""
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return (
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        f"{threads} threads{load}"
    )


def limit_threads(count: int) -> None:
    """Limit every method to a number of threads and, where possible, of cores."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(count)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def main(arguments: Items[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", nargs="+", default=sequences.names(), metavar="NAME")
    parser.add_argument("--methods", nargs="+", default=[], help="prefixes of their names")
    parser.add_argument("--frames", type=int, help="use only the first N")
    parser.add_argument(
        "--tuning-frames", type=int, default=100, help="peers are tuned on the first N"
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--data", type=Path, default=sequences.DATA, help="recorded sequences")
    parser.add_argument("--out", type=Path, default=sequences.OUT)
    parser.add_argument("--fresh", action="store_true", help="simulate again")
    options = parser.parse_args(arguments)
    try:
        chosen = [sequences.check(name) for name in options.sequences]
    except InputError as error:
        parser.error(str(error))
    limit_threads(options.threads)

    about = machine(options.threads)
    print(about, flush=True)
    found: dict[str, list[dict[str, Any]]] = {}
    text = [f"{about}; warm, images decoded and filtered beforehand"]
    for name in chosen:
        try:
            sequence = sequences.load(name, options.data, options.frames, fresh=options.fresh)
        except FileNotFoundError as error:
            print(f"\n{name}: skipped, no {error}", flush=True)
            continue
        print(f"\n{sequence.title}", flush=True)
        rows = []
        for r in compare(sequence, options.methods, options.threads, options.tuning_frames):
            rows.append(r)
            print(f"  {brief(r)}", flush=True)
        found[sequence.title] = rows
        against = "ground truth" if sequence.exact else "inexact reference poses"
        text.append(f"### {sequence.title}\n\nAgainst {against}.\n\n{table(rows)}")
        print(f"\n{text[-1]}", flush=True)
        keep(options.out, about, text, found)
    if found:
        figure(found, options.out / "tracking.png")
        print(f"\nwritten: {options.out / 'tracking'}.md, .json, .png")


def brief(r: dict[str, Any]) -> str:
    """Return a short form of a row, to show progress."""
    if "problem" in r:
        return f"{r['method']}: {r['problem']}"
    speed = f"{r['ms_median']:.1f} ms/frame, " if "ms_median" in r else ""
    return f"{r['method']}: {speed}ATE {r['ate_m']:.4f} m"


def keep(out: Path, about: str, text: Items[str], found: dict[str, Any]) -> None:
    """Write the results so far, so that an interrupted run keeps them."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "tracking.md", "\n\n".join(text) + "\n")
    write_text(out / "tracking.json", json.dumps({"machine": about, "sequences": found}))


if __name__ == "__main__":
    main()
