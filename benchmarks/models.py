"""Accuracy of whole reconstructions: the six simulated cases of the thesis, end to end.

Each case is recorded by a simulated SR4000 with all simulated camera errors and factory correction,
and reconstructed by `default` and by `thesis`. The only hint is that torso and box are rotating
objects (`--object`; for `thesis` the depth of the background from the scene). Printed are the ATE
(after rigid alignment) of the tracker and of the final poses, its ratio to that of `thesis`, the
verdict, and dimensions measured on the models of the objects.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from tofuse.apps.jobs.run_options import Options, resolve
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.engine.results.types import Reconstruction
from tofuse.lab.experiments import measures
from tofuse.lab.experiments.cases import CHEST
from tofuse.lab.experiments.recorded import RecordedScene
from tofuse.lab.scenes import box
from tofuse.lab.simulation.record import plan, simulate_recording

CASES = {
    "rail": ("rail", {}),
    "room": ("room", {}),
    "empty room": ("empty-room", {}),
    "empty room, one albedo": ("empty-room", {"texture": False}),
    "torso": ("torso", {}),
    "box": ("box", {}),
}
OBJECTS = ("torso", "box")


def main() -> None:
    """Run the cases and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seeds", type=int, default=1, help="recordings of each case")
    parser.add_argument("--every", type=int, default=1, help="use every N-th frame only")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--no-thesis", action="store_true", help="only the default method")
    parser.add_argument("--no-correction", action="store_true", help="no factory correction")
    parser.add_argument("--calibrate", nargs="*", default=[], help="offset, scale, focal")
    args = parser.parse_args()
    print(f"simulated SR4000, {args.threads} threads; ATE in mm and degrees, rms")
    print(
        f"{'case':24s}{'seed':>5s}{'posed':>9s}{'tracker':>16s}{'final':>16s}{'thesis':>16s}"
        f"{'ratio':>7s}{'verdict':>10s}{'loops':>7s}{'s':>6s}  model"
    )
    for name in args.cases:
        for seed in range(args.seeds):
            _case(name, seed, args)


def _case(name: str, seed: int, args: argparse.Namespace) -> None:
    scene, options = CASES[name]
    recording = simulate_recording(scene, seed=seed, correction=not args.no_correction, **options)
    recording = recording.select(every=args.every)
    start = time.perf_counter()
    result = reconstruct(recording, _config(scene, "default", args), threads=args.threads)
    seconds = time.perf_counter() - start
    tracker = _errors(result.diagnostics.sequential, recording)
    final = _errors(result.trajectory, recording)
    thesis = (np.nan, np.nan)
    if not args.no_thesis:
        # The simulator's stride is that of the thesis unless `--every` is given.
        other = reconstruct(recording, _config(scene, "thesis", args), threads=args.threads)
        thesis = _errors(other.trajectory, recording)
    accepted = sum(loop.accepted for loop in result.diagnostics.loops)
    posed = f"{result.has_pose.sum()}/{len(result.has_pose)}"
    print(
        f"{name:24s}{seed:5d}{posed:>9s}{_text(tracker):>16s}{_text(final):>16s}{_text(thesis):>16s}"
        f"{thesis[0] / final[0]:7.1f}{result.diagnostics.verdict:>10s}{accepted:7d}{seconds:6.1f}"
        f"  {_model(scene, recording, result)}",
        flush=True,
    )


def _config(scene: str, method: str, args: argparse.Namespace) -> Config:
    turned = scene in OBJECTS
    depth = plan(scene).scene.max_depth_m if turned and method == "thesis" else None
    config = None
    if method == "default" and args.calibrate:
        config = Path(__file__).with_name("out") / "models.toml"
        config.parent.mkdir(exist_ok=True)
        config.write_text(f"[refinement]\ncalibrate = {args.calibrate!r}\n")
    return resolve(
        Options(Path("unused"), method=method, object=turned, max_depth=depth, config=config)
    )


def _errors(poses: Float64, recording: Recording) -> tuple[float, float]:
    truth = recording.reference
    assert truth is not None
    has = np.isfinite(poses[:, 0, 0])
    times = np.arange(len(poses), dtype=float)[has]
    if len(times) < 3:
        return np.nan, np.nan
    score = evaluate_trajectory(times, poses[has], times, truth[has])
    return score.ate_rms_m * 1e3, float(np.degrees(score.rotation_rms_rad))


def _text(errors: tuple[float, float]) -> str:
    return "-" if np.isnan(errors[0]) else f"{errors[0]:.1f} / {errors[1]:.2f}"


def _model(scene: str, recording: Recording, result: Reconstruction) -> str:
    """Dimensions measured on the model, in the upright frame of the scene."""
    if scene not in OBJECTS:
        return ""
    made = plan(scene, every=1)
    recorded = RecordedScene(made, (), made.poses)
    points = se3.transform(recorded.T_truth_world, result.cloud.points)
    if scene == "box":
        fit = measures.fit_box(points, box.BOTTOM, box.HEIGHT, box.WIDTH)
        w, h = fit.widths_m * 1e3, fit.height_m * 1e3
        return f"{w[0]:.1f} x {w[1]:.1f} x {h:.1f} mm, {np.abs(fit.angles_deg - 90).max():.2f} deg"
    girth, true = (measures.girth_m(p, *CHEST) for p in (points, recorded.surface))
    return f"circumference {girth * 1e3:.0f} mm, {100 * (girth / true - 1):+.1f} %"


if __name__ == "__main__":
    main()
