"""Whole runs, as a person starts them: seconds of each stage, ms a frame, and peak memory.

Each run is a process of its own, `tofuse run` with nothing but its defaults, from the first file
read to the report. It is run once before, which compiles what is not compiled yet and leaves the
files in the system's memory, and that is not counted. Where Open3D is installed, its dense SLAM
gets the same frames by the same reader, and ends with a mesh in a file: neither loops nor a report
are in that. Its process counts from the first frame, not from its start.

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

# Nothing large is imported here: a process that is started counts what its parent held.
HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "shared" / "data"
INPUTS = ("kitchen", "room")


@dataclass(frozen=True)
class Spent:
    """What a process took: seconds, of all threads together too, peak memory, and its stages."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    frames: int
    stages: dict[str, float]

    @property
    def ms_a_frame(self) -> float:
        """Of the whole, from start to end."""
        return 1e3 * self.wall_s / max(1, self.frames)


def measured(command: Sequence[str], allowed: Sequence[int] = (0,)) -> tuple[float, float, float]:
    """Run a process to its end: seconds, CPU seconds and peak MB; RuntimeError if it fails."""
    with tempfile.TemporaryFile() as said:
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said)
        _, status, used = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in allowed:
            said.seek(0)
            raise RuntimeError(said.read().decode(errors="replace").strip()[-500:])
    unit = 1 if sys.platform == "darwin" else 1024
    return wall, used.ru_utime + used.ru_stime, used.ru_maxrss * unit / 1e6


def tofuse_run(source: Path, chosen: Sequence[str], threads: int) -> Spent:
    """Run `tofuse run` on a recording."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result"
        command = [sys.executable, "-m", "tofuse", "run", str(source), "--out", str(out), *chosen]
        # Frames without a pose are a result as well.
        wall, cpu, peak = measured([*command, "--threads", str(threads)], (0, 3))
        written = json.loads((out / "run.json").read_text())
    return Spent(wall, cpu, peak, written["input"]["frames"], dict(written["seconds"]))


def peer_run(source: Path, chosen: Sequence[str], threads: int) -> Spent:
    """Run Open3D's dense SLAM on the same frames, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--peer", str(source), "--peer-out", folder, *chosen]
        _, cpu, peak = measured([*command, "--threads", str(threads)])
        written = json.loads((Path(folder) / "peer.json").read_text())
    stages = written["seconds"]
    return Spent(sum(stages.values()), cpu, peak, written["frames"], stages)


def peer(source: str, out: Path, start: int, end: int | None, every: int, threads: int) -> None:
    """Be that process."""
    from peers.o3d import DenseSlam
    from tofuse.recordings.frames import RangeFrame
    from tofuse.recordings.open import open_recording

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
    """Return where an input is; one that is simulated is made first, by another process."""
    if name == "kitchen":
        return data / "sevenscenes_kitchen"
    if name not in INPUTS:
        return Path(name)
    path = HERE / "out" / "recordings" / name
    if not path.is_dir():
        code = f"import pathlib, sequences; sequences.KINDS[{name!r}].open(pathlib.Path())"
        subprocess.run([sys.executable, "-c", code], cwd=HERE, check=True)
    return path


def table(rows: Sequence[tuple[str, Sequence[Spent]]]) -> Iterator[str]:
    """Medians of the runs of each method, and below it the stages of the median run."""
    yield f"{'':<20}{'frames':>8}{'s':>8}{'ms a frame':>12}{'CPU s':>8}{'peak MB':>9}"
    for name, runs in rows:
        wall = statistics.median(run.wall_s for run in runs)
        middle = min(runs, key=lambda run: abs(run.wall_s - wall))
        yield (
            f"{name:<20}{middle.frames:>8}{wall:>8.1f}{1e3 * wall / max(1, middle.frames):>12.1f}"
            f"{statistics.median(run.cpu_s for run in runs):>8.1f}"
            f"{max(run.peak_mb for run in runs):>9.0f}"
        )
        rest = middle.wall_s - sum(middle.stages.values())
        for part, s in {**middle.stages, "start, writing": max(0.0, rest)}.items():
            if s >= 0.05:
                fraction = s / max(middle.wall_s, 1e-9)
                each = 1e3 * s / max(1, middle.frames)
                yield f"  {part:<26}{s:>8.1f}{each:>12.1f}{fraction:>8.0%}"
    if len(rows) > 1:
        ours, theirs = (statistics.median(r.ms_a_frame for r in runs) for _, runs in rows[:2])
        yield f"{rows[1][0]} takes {theirs / ours:.1f} times as long"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", nargs="+", default=list(INPUTS), help="or any recording")
    parser.add_argument("--data", type=Path, default=DATA, help="where recorded sequences are")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--end", type=int)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--no-first", action="store_true", help="count the first run as well")
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
    if hasattr(os, "sched_setaffinity"):  # peers take what they get
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, cores[: options.threads])
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        f"{options.threads} threads{load}"
    )
    chosen = ["--start", str(options.start), "--every", str(options.every)]
    if options.end is not None:
        chosen += ["--end", str(options.end)]
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
            print("  its data is not there")
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
