"""How often the verdict is right: many runs, each judged without the truth and then against it.

A result is right if its absolute trajectory error is below 1 cm and 1 % of the path, and half of
the frames have a pose; for real recordings, what their reference itself is good for is added.
Simulated scenes are run with several seeds and strides, by the default method, by the default
without its refinement, and by the method of the thesis; with and without the camera's factory
correction, and in rooms of a single albedo. Also printed is how honest the covariances of the final
poses are: the share of their errors within the regions that should hold 50, 90 and 95 %.

    python benchmarks/verdict.py --seeds 5 --real
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

import sequences
from tofuse.errors import TofuseError
from tofuse.evaluation.trajectory import evaluate_trajectory
from tofuse.filters.foreground import Foreground
from tofuse.geometry import se3
from tofuse.odometry.keyframes import Keyframes
from tofuse.pipeline.config import Config, from_method
from tofuse.pipeline.reconstruct import reconstruct
from tofuse.posegraph.refinement import NoRefinement
from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording
from tofuse.results.types import Reconstruction
from tofuse.results.verdict import REASONS
from tofuse.simulation.record import simulate

Float64 = NDArray[np.float64]

OUT = Path(__file__).resolve().parent / "out" / "verdict"
GOOD_M, GOOD_SHARE = 0.01, 0.01
LEVELS = (0.5, 0.9, 0.95)
# Stride among the raw frames of each scene, and what is farther is not the object.
EVERY = {"room": 6, "empty-room": 6, "rail": 5, "torso": 6, "box": 10, "corridor": 3}
FARTHEST_M = {"torso": 2.2, "box": 1.8}
# Real recordings: what the reference is good for (m), and which frames are runs of their own.
REAL = {
    "kitchen": (0.04, [slice(k, k + 100, every) for k in range(0, 500, 100) for every in (1, 4)]),
    "kitchen-whole": (0.04, [slice(0, None, 2), slice(0, None, 10)]),
    "iphone": (0.02, [slice(0, None, every) for every in (1, 2, 3)]),
    "kinect": (0.07, [slice(0, None, 1), slice(0, 9, 1), slice(8, None, 1)]),
    "stray": (0.02, [slice(0, None, every) for every in (1, 4, 10)]),
    "record3d": (0.02, [slice(0, None, every) for every in (1, 3)]),
}
KINDS = {"plain": {}, "uncorrected": {"correction": False}, "uniform": {"texture": False}}


@dataclass(frozen=True, eq=False)
class Run:
    """One run and what was wrong with it.

    Attributes
    ----------
    error_m, allowed_m
        Absolute trajectory error, inf if fewer than half of the frames have a pose, and what a
        right result may have.
    normalised
        Squared errors of the final poses in units of their covariances; empty where the method does
        not know them.
    """

    name: str
    verdict: str
    codes: tuple[str, ...]
    error_m: float
    allowed_m: float
    normalised: Float64

    @property
    def right(self) -> bool:
        """Whether the result is."""
        return self.error_m < self.allowed_m


def methods() -> dict[str, Config]:
    """Configurations to be judged."""
    default = from_method("default")
    return {
        "default": default,
        "unrefined": replace(default, refinement=NoRefinement()),
        "thesis": from_method("thesis"),
    }


def recorded(scene: str, seed: int, kind: str) -> Recording:
    """A simulated recording, made once and kept."""
    path = OUT / f"{scene}-{seed}-{kind}"
    if not path.is_dir():
        unfinished = path.with_suffix(".part")
        simulate(scene, unfinished, seed=seed, every=EVERY[scene], **KINDS[kind])
        unfinished.rename(path)
    return open_recording(path)


def judged(
    name: str,
    recording: Recording,
    config: Config,
    farthest_m: float | None,
    reference_m: float = 0.0,
) -> Run:
    """Run a method, and compare its verdict with a reference that is good to `reference_m`."""
    reference = recording.reference
    assert reference is not None
    allowed = (
        reference_m
        + GOOD_M
        + GOOD_SHARE * float(np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1).sum())
    )
    if farthest_m is not None:
        config = replace(config, filters=(Foreground(farthest_m), *config.filters))
    try:
        result = reconstruct(recording, config)
    except TofuseError as error:
        return Run(name, "failed", (type(error).__name__,), np.inf, allowed, np.zeros(0))
    d = result.diagnostics
    posed = result.has_pose
    error = np.inf
    if 2 * posed.sum() >= len(posed) and posed.sum() > 2:
        t = result.timestamps[posed]
        found = evaluate_trajectory(t, result.trajectory[posed], t, reference[posed])
        error = found.ate_rms_m
    codes = tuple(dict.fromkeys(r.code for r in d.reasons))
    knows = isinstance(config.odometry, Keyframes)
    normalised = against_truth(result, reference) if knows else np.zeros(0)
    return Run(name, d.verdict, codes, error, allowed, normalised)


def against_truth(result: Reconstruction, reference: Float64) -> Float64:
    """(P,) squared errors of the final poses relative to the first, over their covariances."""
    rows = np.flatnonzero(result.has_pose)
    first = rows[0]
    out = []
    for k in rows[1:]:
        C = result.diagnostics.frames[k].covariance
        if C is None:
            continue
        true = se3.inverse(reference[first]) @ reference[k]
        e = se3.log(se3.inverse(true) @ result.trajectory[k])
        out.append(float(e @ np.linalg.solve(C, e)))
    return np.array(out)


def cases(seeds: int, scenes: list[str]) -> Iterator[tuple[str, int, str, str, int]]:
    """Scene, seed, kind, method and stride of every run."""
    for seed in range(seeds):
        for scene in scenes:
            for kind in KINDS:
                if kind == "uniform" and scene != "empty-room":
                    continue
                for stride in (1, 2, 4):
                    yield scene, seed, kind, "default", stride
                yield scene, seed, kind, "unrefined", 1
                if kind == "plain":
                    for stride in (1, 2):
                        yield scene, seed, kind, "thesis", stride


def real(name: str, data: Path) -> Recording:
    """A real recording with its reference; FileNotFoundError where it is not there."""
    if name in ("stray", "record3d"):
        path = data / f"iphone_{name}"
        if not path.is_dir():
            raise FileNotFoundError(path)
        return open_recording(path)
    return sequences.KINDS[name.removesuffix("-whole")].open(data)


def table(runs: list[Run]) -> str:
    """The confusion table, and the honesty of the covariances."""
    counts = Counter((run.right, run.verdict) for run in runs)
    lines = [f"{'':8}{'good':>10}{'degraded':>10}{'failed':>10}"]
    for right, name in ((True, "right"), (False, "wrong")):
        cells = "".join(f"{counts[right, v]:10}" for v in ("good", "degraded", "failed"))
        lines.append(f"{name:8}{cells}")
    for right, name in ((True, "right"), (False, "wrong")):
        codes = [run.codes for run in runs if run.right == right and run.verdict == "degraded"]
        forced = Counter(c for each in codes for c in each if REASONS[c][0] == "degraded")
        told = ", ".join(f"{count} {code}" for code, count in forced.most_common())
        lines.append(f"{len(codes)} {name} and degraded, by reason: {told}")
    good = counts[True, "good"] + counts[False, "good"]
    wrong = sum(not run.right for run in runs)
    lines.append(f"of {good} called good {counts[True, 'good'] / max(good, 1):.1%} are right")
    missed = 1 - counts[False, "good"] / max(wrong, 1)
    lines.append(f"of {wrong} that are wrong {missed:.1%} are not called good")
    known = [run.normalised for run in runs if len(run.normalised)]
    if known:
        # Every run counts the same: errors within one are not independent.
        within = [np.mean([(n < limit).mean() for n in known]) for limit in chi2.ppf(LEVELS, 6)]
        wanted = " / ".join(f"{100 * level:.0f}" for level in LEVELS)
        shares = " / ".join(f"{100 * share:.0f}" for share in within)
        lines.append(f"errors of final poses within {wanted} %: {shares} % ({len(known)} runs)")
    return "\n".join(lines)


def main() -> None:
    """Run them, print one line each, and the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=2, help="of the simulation; 0: none")
    parser.add_argument("--scenes", nargs="+", default=list(EVERY), choices=list(EVERY))
    parser.add_argument("--real", action="store_true", help="the real recordings too")
    parser.add_argument("--data", type=Path, default=sequences.DATA, help="real recordings")
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    configs = methods()
    runs = []

    def done(run: Run) -> None:
        runs.append(run)
        mark = "right" if run.right else "wrong"
        size = f"{1e3 * run.error_m:7.1f} of {1e3 * run.allowed_m:5.1f} mm"
        print(f"{run.name:44} {mark} {size}  {run.verdict:9} {' '.join(run.codes)}", flush=True)

    for scene, seed, kind, method, stride in cases(options.seeds, options.scenes):
        recording = recorded(scene, seed, kind).select(every=stride)
        name = f"{scene} {seed} {kind} {method} every {stride}"
        done(judged(name, recording, configs[method], FARTHEST_M.get(scene)))
    if options.real:
        of_real(options.data, configs, done)
    print(table(runs))


def of_real(data: Path, configs: dict[str, Config], done: Callable[[Run], None]) -> None:
    """Run the methods that measure for themselves on every real recording that is there."""
    for name, (reference_m, parts) in REAL.items():
        try:
            recording = real(name, data)
        except FileNotFoundError as missing:
            print(f"{name}: not run, {missing} is not there")
            continue
        for part in parts:
            selected = recording.select(part.start, part.stop, part.step)
            for method in ("default", "unrefined"):
                title = f"{name} {part.start}:{part.stop or ''}:{part.step} {method}"
                done(judged(title, selected, configs[method], None, reference_m))


if __name__ == "__main__":
    main()
