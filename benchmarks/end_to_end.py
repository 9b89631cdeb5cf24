"""Whole runs from the command line: seconds per stage, ms per frame, and peak memory.

Each run is a separate process, `tofuse run` with its defaults, from the first file read to the
report. An untimed run before it fills the kernel cache and the file cache. If Open3D is installed,
its dense SLAM processes the same frames from the same reader and writes a mesh, without loop
closures or a report. Its time starts at the first frame, not at the start of the process.

    python benchmarks/end_to_end.py [--inputs kitchen room] [--end 1000] [--repeats 3]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

# No large imports here: a child's peak memory includes that of its parent at the fork.
HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "shared" / "data"
INPUTS = ("kitchen", "room")


@dataclass(frozen=True)
class Usage:
    """Resources used by a process: wall and CPU time, peak memory, and seconds per stage."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    frames: int
    stages: dict[str, float]

    @property
    def ms_per_frame(self) -> float:
        """Wall time per frame."""
        return 1e3 * self.wall_s / max(1, self.frames)


def measured(command: Sequence[str], allowed: Sequence[int] = (0,)) -> tuple[float, float, float]:
    """Run a process; return seconds, CPU seconds and peak MB. RuntimeError if it fails."""
    with tempfile.TemporaryFile() as stderr:
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr)
        _, status, used = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in allowed:
            stderr.seek(0)
            raise RuntimeError(stderr.read().decode(errors="replace").strip()[-500:])
    unit = 1 if sys.platform == "darwin" else 1024
    return wall, used.ru_utime + used.ru_stime, used.ru_maxrss * unit / 1e6


def tofuse_run(source: Path, chosen: Sequence[str], threads: int) -> Usage:
    """Run `tofuse run` on a recording."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result"
        command = [sys.executable, "-m", "tofuse", "run", str(source), "--out", str(out), *chosen]
        # Status 3: a result in which frames have no pose.
        wall, cpu, peak = measured([*command, "--threads", str(threads)], (0, 3))
        written = json.loads((out / "run.json").read_text())
    return Usage(wall, cpu, peak, written["input"]["frames"], dict(written["seconds"]))


def peer_run(source: Path, chosen: Sequence[str], threads: int) -> Usage:
    """Run Open3D's dense SLAM on the same frames, in a separate process."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--peer", str(source), "--peer-out", folder, *chosen]
        _, cpu, peak = measured([*command, "--threads", str(threads)])
        written = json.loads((Path(folder) / "peer.json").read_text())
    stages = written["seconds"]
    return Usage(sum(stages.values()), cpu, peak, written["frames"], stages)


def peer(source: str, out: Path, start: int, end: int | None, every: int, threads: int) -> None:
    """Entry point of that process."""
    from peers.o3d import DenseSlam
    from tofuse.engine.frames.frames import RangeFrame
    from tofuse.formats.recordings.open import open_recording

    recording = open_recording(source).select(start, end, every)
    session, frames = None, 0
    seconds = {"reading": 0.0, "tracking and fusing": 0.0, "mesh": 0.0}
    before = time.perf_counter()
    for frame in recording:
        if not isinstance(frame, RangeFrame):
            continue
        if session is None:
            session = DenseSlam().start(frame, threads)
            before = time.perf_counter()
        prepared = session.prepare(frame)
        read = time.perf_counter()
        session.push(prepared)
        done = time.perf_counter()
        seconds["reading"] += read - before
        seconds["tracking and fusing"] += done - read
        before, frames = done, frames + 1
    if session is None:
        raise RuntimeError("no images")
    session.write_mesh(out / "mesh.ply")
    seconds["mesh"] = time.perf_counter() - before
    (out / "peer.json").write_text(json.dumps({"frames": frames, "seconds": seconds}))


def located(name: str, data: Path) -> Path:
    """Return the path of an input; a simulated one is created first, by another process."""
    if name == "kitchen":
        return data / "sevenscenes_kitchen"
    if name not in INPUTS:
        return Path(name)
    path = HERE / "out" / "recordings" / name
    if not path.is_dir():
        code = f"import pathlib, sequences; sequences.KINDS[{name!r}].open(pathlib.Path())"
        subprocess.run([sys.executable, "-c", code], cwd=HERE, check=True)
    return path


def table(rows: Sequence[tuple[str, Sequence[Usage]]]) -> Iterator[str]:
    """Yield the medians over the runs of each method, and the stages of the median run."""
    yield f"{'':<20}{'frames':>8}{'s':>8}{'ms/frame':>12}{'CPU s':>8}{'peak MB':>9}"
    for name, runs in rows:
        wall = statistics.median(run.wall_s for run in runs)
        median_run = min(runs, key=lambda run: abs(run.wall_s - wall))
        yield (
            f"{name:<20}{median_run.frames:>8}{wall:>8.1f}"
            f"{1e3 * wall / max(1, median_run.frames):>12.1f}"
            f"{statistics.median(run.cpu_s for run in runs):>8.1f}"
            f"{max(run.peak_mb for run in runs):>9.0f}"
        )
        rest = median_run.wall_s - sum(median_run.stages.values())
        for part, s in {**median_run.stages, "run.json, exit": max(0.0, rest)}.items():
            if s >= 0.05:
                fraction = s / max(median_run.wall_s, 1e-9)
                each = 1e3 * s / max(1, median_run.frames)
                yield f"  {part:<26}{s:>8.1f}{each:>12.1f}{fraction:>8.0%}"
    if len(rows) > 1:
        ours, theirs = (statistics.median(r.ms_per_frame for r in runs) for _, runs in rows[:2])
        yield f"{rows[1][0]} takes {theirs / ours:.1f} times as long"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that select frames, and how they are processed."""
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recorded sequences")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--end", type=int)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--no-first", action="store_true", help="count the first run as well")


def started(options: argparse.Namespace) -> list[str]:
    """Keep to as many cores as threads, print where, and return the selection for `tofuse run`."""
    if hasattr(os, "sched_setaffinity"):  # peers use all that are available
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, cores[: options.threads])
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        f"{options.threads} threads{load}",
        flush=True,
    )
    chosen = ["--start", str(options.start), "--every", str(options.every)]
    return chosen if options.end is None else [*chosen, "--end", str(options.end)]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--inputs", nargs="+", default=list(INPUTS), help="sequences, or paths of recordings"
    )
    add_options(parser)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--no-peer", action="store_true")
    parser.add_argument("--peer", help=argparse.SUPPRESS)
    parser.add_argument("--peer-out", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.peer:
        peer(
            options.peer,
            options.peer_out,
            options.start,
            options.end,
            options.every,
            options.threads,
        )
        return
    chosen = started(options)
    methods = [("tofuse run", tofuse_run)]
    if not options.no_peer:
        if importlib.util.find_spec("open3d"):
            methods.append(("Open3D dense SLAM", peer_run))
        else:
            print("Open3D is not installed")
    for name in options.inputs:
        source = located(name, options.data)
        print(f"\n{name}", flush=True)
        if not source.exists():
            print("  no data")
            continue
        if not options.no_first:
            tofuse_run(source, chosen, options.threads)
        rows = [
            (label, [method(source, chosen, options.threads) for _ in range(options.repeats)])
            for label, method in methods
        ]
        for line in table(rows):
            print(f"  {line}", flush=True)


if __name__ == "__main__":
    main()
