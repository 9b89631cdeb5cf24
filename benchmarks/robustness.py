"""Failures on real and stressed recordings: lost frames, unmarked wrong poses, wrong joins.

`real`: all real recordings that are sequences, compared with small_gicp's map, KISS-ICP and
Open3D's odometry on the same filtered frames. For each peer the tuning with the best map
consistency on the first frames is used. `stress`: simulated recordings with exact ground truth and
realistic disturbances (`stress.py`). `scoring.py` defines and computes wrong poses, marked poses
and wrong joins. Peers mark nothing and have a single component.

    python benchmarks/robustness.py real [--names kitchen] [--peers]
    python benchmarks/robustness.py stress [--scenes room] [--cases covered] [--seeds 3] [--quick]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import scoring
import sequences
import stress
from peers import Method, kiss, o3d, sgicp
from recorded import RECORDED, Recorded
from scoring import Part, Score, Truth
from tofuse.apps.jobs.run_options import Options, resolve
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import Recording
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.map_agreement import map_consistency

OURS = "tofuse"
TUNING_FRAMES = 40
QUICK_FRAMES = 100


@dataclass(frozen=True)
class Row:
    """Outcome of one method on one recording.

    Attributes
    ----------
    map_rms_m, map_inliers
        Map consistency of the main component; NaN where no two views overlap.
    components
        Number of components; the main one and those joined to it count as one.
    problem
        Reason if there is no result, else empty.
    compared
        Whether there is ground truth or a reference.
    """

    group: str
    name: str
    method: str
    score: Score
    seconds: float
    verdict: str = ""
    components: int = 1
    map_rms_m: float = np.nan
    map_inliers: float = np.nan
    problem: str = ""
    compared: bool = True


# ---- Runs ----------------------------------------------------------------------------------------


def lost(count: int, truth: Truth) -> Score:
    """Score of a run without a result."""
    nothing = Part(np.full((count, 4, 4), np.nan), (None,) * count)
    return scoring.score([nothing], truth)


def ours(
    recording: Recording, threads: int, *, turning: bool = False
) -> tuple[list[Part], str, float, str]:
    """Run the default method; return parts, verdict, seconds, and the problem if any."""
    began = time.perf_counter()
    try:
        config = resolve(Options(out=Path("unused"), object=turning))
        result = reconstruct(recording, config, threads=threads)
    except InputError as error:
        return [], "", time.perf_counter() - began, str(error)
    except Exception as error:
        # Crashes are counted as outcomes.
        return [], "", time.perf_counter() - began, f"crashed: {type(error).__name__}: {error}"
    seconds = time.perf_counter() - began
    parts = scoring.parts_of(result, recording.indices)
    return parts, result.diagnostics.verdict, seconds, ""


def peer_methods() -> dict[str, tuple[str, list[Method]]]:
    """Map each peer's label to the module that it needs and its tunings."""
    maps = [sgicp.Map(v, m) for v, m in ((0.02, 0.05), (0.04, 0.1), (0.08, 0.2))]
    return {
        "small_gicp map": ("small_gicp", list(maps)),
        "KISS-ICP": ("kiss_icp", [kiss.KissIcp(0.05, 0.1), kiss.KissIcp(0.1, 0.5)]),
        "Open3D odometry": ("open3d", [o3d.Odometry()]),
    }


def peer_poses(method: Method, frames: Sequence[RangeFrame], threads: int) -> Float64:
    """Poses (N, 4, 4) of a peer, NaN where lost."""
    session = method.start(frames[0], threads)
    out = np.full((len(frames), 4, 4), np.nan)
    for k, frame in enumerate(frames):
        T = session.push(session.prepare(frame))
        if T is not None:
            out[k] = T
    return out


def as_part(poses: Float64) -> Part:
    """Part with the poses of a method that states no uncertainty."""
    nothing = np.zeros((0, 6))
    records = tuple(
        SimpleNamespace(index=k, status="tracked", covariance=None, unobservable=nothing)
        for k in range(len(poses))
    )
    return Part(poses, records)


def peer(
    label: str, recording: Recording, frames: Sequence[RangeFrame], threads: int
) -> tuple[list[Part], float, str]:
    """Run a peer with its best tuning; return parts, seconds, and the problem if any."""
    module, tunings = peer_methods()[label]
    if find_spec(module) is None:
        return [], 0.0, f"{module} is not installed"
    began = time.perf_counter()
    try:
        best = tunings[0]
        if len(tunings) > 1:
            few = frames[:TUNING_FRAMES]
            part = recording.select(end=len(few))
            best = max(tunings, key=lambda m: agreement(part, peer_poses(m, few, threads))[1])
        began = time.perf_counter()
        poses = peer_poses(best, frames, threads)
    except Exception as error:
        return [], time.perf_counter() - began, f"failed: {type(error).__name__}: {error}"
    return [as_part(poses)], time.perf_counter() - began, ""


def agreement(recording: Recording, poses: Float64) -> tuple[float, float]:
    """Map consistency: rms in m and inlier ratio; NaN and 0 if no two views overlap."""
    try:
        found = map_consistency(recording, poses)
    except InputError:
        return np.nan, 0.0
    return found.rms_m, float(np.nan_to_num(found.inlier_ratio))


# ---- Real recordings -----------------------------------------------------------------------------


def real(
    one: Recorded, data: Path, threads: int, frames: int | None, *, with_peers: bool
) -> Iterator[Row]:
    """Yield the rows of one recording."""
    recording = one.open(data).select(end=frames)
    n = len(recording)
    whole = np.zeros(n, np.intp)
    known = [poses[:n] for poses in one.references(data, one.open(data))]
    unknown = np.full((n, 4, 4), np.nan)
    truths = [Truth(poses, whole, one.tolerance) for poses in known or [unknown]]

    def row(method: str, parts: list[Part], seconds: float, problem: str, verdict: str) -> Row:
        if not parts:
            return Row("real", one.title, method, lost(n, truths[0]), seconds, problem=problem)
        score = min((scoring.score(parts, truth) for truth in truths), key=lambda s: s.wrong)
        rms, inliers = agreement(recording, parts[0].poses)
        return Row(
            "real",
            one.title,
            method,
            score,
            seconds,
            verdict,
            len(parts),
            rms,
            inliers,
            compared=bool(known),
        )

    parts, verdict, seconds, problem = ours(recording, threads, turning=one.object)
    yield row(OURS, parts, seconds, problem, verdict)
    if not with_peers or one.object:
        return
    _, cleaned, _ = sequences.prepared(recording)
    for label in peer_methods():
        parts, seconds, problem = peer(label, recording, cleaned, threads)
        yield row(label, parts, seconds, problem, "")


# ---- Stress --------------------------------------------------------------------------------------


def stressed(case: stress.Case, threads: int, *, with_peers: bool) -> Iterator[Row]:
    """Yield the rows of one case."""
    n = len(case.recording)
    parts, verdict, seconds, problem = ours(case.recording, threads)
    score = scoring.score(parts, case.truth) if parts else lost(n, case.truth)
    yield Row(case.scene, case.name, OURS, score, seconds, verdict, len(parts), problem=problem)
    if not with_peers:
        return
    _, cleaned, _ = sequences.prepared(case.recording)
    for label in peer_methods():
        parts, seconds, problem = peer(label, case.recording, cleaned, threads)
        score = scoring.score(parts, case.truth) if parts else lost(n, case.truth)
        yield Row(case.scene, case.name, label, score, seconds, problem=problem)


# ---- Output --------------------------------------------------------------------------------------

STRESS_HEAD = (
    f"{'scene':10} {'case':31} {'method':15} frames  main  covered  parts  wrong unmarked strict"
    f" (by reason only)  wrong joins  ATE mm  verdict       s"
)
REAL_HEAD = (
    f"{'recording':35} {'method':15} frames  main  parts  ATE mm  map mm  inliers  wrong"
    f" unmarked  wrong joins  verdict       s"
)


def stress_line(row: Row) -> str:
    """Format a row of the stress benchmark."""
    s = row.score
    fraction = f"{s.covered / s.overlapping:.0%}" if s.overlapping else "-"
    return (
        f"{row.group:10} {row.name:31} {row.method:15} {s.frames:6} {s.main / s.frames:5.0%}"
        f" {fraction:>8} {row.components:6} {s.wrong:6} {s.unmarked:8} {s.unmarked_strict:6}"
        f" {s.by_reason:17} {s.joins:12}  {1000 * s.ate_m:6.0f}  {row.verdict:8} {row.seconds:6.1f}"
        f"  {row.problem}"
    ).rstrip()


def real_line(row: Row) -> str:
    """Format a row of the real benchmark."""
    s = row.score
    counts = (s.wrong, s.unmarked, s.joins) if row.compared else ("-", "-", "-")
    ate = f"{1000 * s.ate_m:.0f}" if row.compared else "-"
    return (
        f"{row.name:35} {row.method:15} {s.frames:6} {s.main / s.frames:5.0%} {row.components:6}"
        f"  {ate:>6}  {1000 * row.map_rms_m:6.1f}  {row.map_inliers:7.1%} {counts[0]:>6}"
        f" {counts[1]:>8} {counts[2]:>12}  {row.verdict:8} {row.seconds:6.1f}  {row.problem}"
    ).rstrip()


def summary(rows: Sequence[Row]) -> Iterator[str]:
    """Yield a summary of all runs for each method."""
    for method in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == method]
        scores = [row.score for row in own]
        overlapping = sum(s.overlapping for s in scores)
        failed = [row for row in own if row.problem]
        posed = sum(s.main for s in scores)
        yield (
            f"{method}: {len(own)} runs, {len(failed)} without a result; "
            f"{sum(s.covered for s in scores) / max(overlapping, 1):.1%} of overlapping "
            f"frames covered "
            f"(in the worst run {min(s.covered / max(s.overlapping, 1) for s in scores):.0%}); "
            f"wrong poses {sum(s.wrong for s in scores)} of {posed} in "
            f"{sum(s.wrong > 0 for s in scores)} runs, unmarked "
            f"{sum(s.unmarked for s in scores)} in {sum(s.unmarked > 0 for s in scores)} runs "
            f"({sum(s.unmarked_strict for s in scores)} in "
            f"{sum(s.unmarked_strict > 0 for s in scores)} by the strict count), "
            f"marked by a reason alone {sum(s.by_reason for s in scores)}; "
            f"wrong joins {sum(s.joins for s in scores)} "
            f"({sum(s.joins_by_motion for s in scores)} with motion) in "
            f"{sum(s.joins > 0 for s in scores)} runs"
        )


def by_case(rows: Sequence[Row]) -> Iterator[str]:
    """Yield a Markdown table of our own runs, a row for each case."""
    yield "| case | runs | covered at least 95 % | wrong poses | unmarked | wrong joins |"
    yield "|---|---|---|---|---|---|"
    own = [row for row in rows if row.method == OURS]
    for name in dict.fromkeys(row.name for row in own):
        scores = [row.score for row in own if row.name == name]
        covered = sum(s.covered >= 0.95 * s.overlapping for s in scores)
        wrong, unmarked, joins = (
            f"{sum(counts)} in {sum(n > 0 for n in counts)} runs" if any(counts) else "0"
            for counts in (
                [s.wrong for s in scores],
                [s.unmarked for s in scores],
                [s.joins for s in scores],
            )
        )
        yield f"| {name} | {len(scores)} | {covered} | {wrong} | {unmarked} | {joins} |"


def keep(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(row) for row in rows], indent=1))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each run, and summaries."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("parts", nargs="*", choices=["real", "stress", []], default=[])
    parser.add_argument(
        "--names", nargs="+", default=[""], help="real recordings whose names contain these"
    )
    parser.add_argument("--scenes", nargs="+", choices=stress.SCENES, default=list(stress.SCENES))
    parser.add_argument("--cases", default="", metavar="SUBSTRING")
    parser.add_argument("--seeds", type=int, default=1, metavar="N")
    parser.add_argument("--quick", action="store_true", help="fewer cases; at most 100 frames")
    parser.add_argument("--peers", action="store_true", help="run the peers as well")
    parser.add_argument("--frames", type=int, help="real recordings: use only the first N")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--data", type=Path, default=sequences.DATA)
    parser.add_argument("--out", type=Path, default=sequences.OUT)
    options = parser.parse_args(arguments)
    wanted = options.parts or ["real", "stress"]
    if "real" in wanted:
        frames = options.frames or (QUICK_FRAMES if options.quick else None)
        rows: list[Row] = []
        print(REAL_HEAD, flush=True)
        for name, one in RECORDED.items():
            if not any(part in name for part in options.names):
                continue
            try:
                for row in real(
                    one, options.data, options.threads, frames, with_peers=options.peers
                ):
                    rows.append(row)
                    print(real_line(row), flush=True)
            except FileNotFoundError as error:
                print(f"{one.title}: skipped, no {error}", flush=True)
        _end(rows, options.out / "robustness_real.json")
    if "stress" in wanted:
        rows = []
        print(STRESS_HEAD, flush=True)
        for seed in range(options.seeds):
            for name in options.scenes:
                made = stress.cases(
                    stress.SCENES[name], seed, quick=options.quick, containing=options.cases
                )
                for case in made:
                    for row in stressed(case, options.threads, with_peers=options.peers):
                        rows.append(row)
                        print(stress_line(row), flush=True)
        _end(rows, options.out / "robustness_stress.json")
        print("\n".join(by_case(rows)))


def _end(rows: Sequence[Row], path: Path) -> None:
    print()
    for line in summary(rows):
        print(line)
    print()
    keep(rows, path)


if __name__ == "__main__":
    main()
