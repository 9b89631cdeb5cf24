"""Many short recordings as a batch: speed-up of two workers, and cost of killed workers.

The recordings are turns in simulated furnished rooms, each with its own noise. They are run alone
(`tofuse run`, one after the other), then by `tofuse batch` on this machine, on a Dask
`LocalCluster`, and on a Dask scheduler with separate worker processes, with one worker and with
two. At the end workers are killed by SIGKILL at random moments. Each job has one thread. All files
of all results are compared byte by byte with those of the runs alone, except for the times in
`run.json` and `report.html`. Starting a cluster is not timed.

    python benchmarks/batch.py                                  100 recordings, ten kills
    python benchmarks/batch.py --recordings 6 --frames 3        a quick check
    python benchmarks/batch.py --modes LocalCluster             one of the modes

Needs `pip install tofuse[dask]`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import perf_counter, sleep

import numpy as np

from made_once import made_once

OUT = Path(__file__).parent / "out" / "batch"
MODES = ("machine", "LocalCluster", "processes")
# The times in a report.
_TIMES = re.compile(
    r'<tr><td>[\w ]+</td><td class="number">[^<]*</td><td class="bars">.*?</tr>'
    r'|<strong>[^<]*</strong></td><td class="muted">[^<]* per frame'
)
# A cluster as users start it in Python; it exits when its standard input closes.
_LOCAL_CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(
        n_workers=int(sys.argv[1]), threads_per_worker=1, dashboard_address=None
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""
Pids = Callable[[], list[int]]


def tofuse(*args: object) -> list[str]:
    return [sys.executable, "-m", "tofuse", *map(str, args)]


def make_recordings(folder: Path, count: int, frames: int) -> list[Path]:
    """Simulate the recordings that do not exist yet."""
    from tofuse.lab.simulation.record import simulate

    made = folder / f"{frames}-frames"
    return [
        made_once(
            made / f"room-{k:03d}",
            partial(simulate, "room", frames=frames, first=k % 50, seed=k),
        )
        for k in range(count)
    ]


def run_alone(recordings: list[Path], out: Path) -> float:
    """Run each recording in its own process; return the total seconds."""
    start = perf_counter()
    for path in recordings:
        args = ("run", path, "--out", out / path.name, "--threads", 1)
        done = subprocess.run(tofuse(*args), capture_output=True, text=True, check=False)
        if done.returncode not in (0, 3):
            raise SystemExit(f"{path}: {done.stderr}")
    return perf_counter() - start


def start_batch(list_file: Path, out: Path, *args: object) -> subprocess.Popen[str]:
    """Start a batch with one thread per job that SIGINT interrupts.

    A shell makes its background processes ignore SIGINT, which their children inherit; the batch
    must be interruptible even if this benchmark runs in the background.
    """
    command = tofuse("batch", list_file, "--out", out, "--threads", 1, *args)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)


def finish(batch: subprocess.Popen[str]) -> str:
    """Wait for the batch to end; return its standard error."""
    _, stderr = batch.communicate()
    if batch.returncode not in (0, 3):
        raise SystemExit(f"tofuse batch exited with {batch.returncode}: {stderr}")
    return stderr


def contents(result: Path) -> dict[str, bytes]:
    """Contents of the files of a result, without times."""
    found = {}
    for path in sorted(p for p in result.rglob("*") if p.is_file()):
        data = path.read_bytes()
        if path.name == "run.json":
            run = json.loads(data)
            for key in ("seconds", "cpu_seconds", "sha256"):  # digests are of files with times
                del run[key]
            data = json.dumps(run).encode()
        elif path.name == "report.html":
            data = _TIMES.sub("", data.decode()).encode()
        found[str(path.relative_to(result))] = data
    return found


def same_results(recordings: list[Path], alone: Path, out: Path) -> int:
    """Number of results identical to those of the runs alone."""
    names = [path.name for path in recordings]
    return sum(contents(alone / name) == contents(out / name) for name in names)


def children(pid: int) -> list[int]:
    """Running child processes of a process."""
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        return [p.pid for p in psutil.Process(pid).children()]
    return []


def at_work(workers: list[int]) -> list[int]:
    """Workers that are running a job."""
    return [pid for pid in workers if children(pid)]


@contextmanager
def local_cluster(workers: int) -> Iterator[tuple[str, Pids]]:
    """Yield address and busy workers of a `LocalCluster`, which restarts killed workers."""
    process = subprocess.Popen(
        [sys.executable, "-c", _LOCAL_CLUSTER, str(workers)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None

    try:
        yield process.stdout.readline().strip(), lambda: at_work(children(process.pid))
    finally:
        process.communicate("")


@contextmanager
def own_processes(workers: int, folder: Path) -> Iterator[tuple[str, Pids]]:
    """Yield the address of a scheduler and its busy workers: processes, restarted if killed."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    dask = [sys.executable, "-m", "dask"]
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    args = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = subprocess.Popen([*dask, "scheduler", *args], **streams)
    ended = threading.Event()
    running: dict[int, subprocess.Popen[bytes]] = {}

    def keep(number: int) -> None:
        local = ["--local-directory", str(folder / f"worker-{number}")]
        args = ["--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        while not ended.is_set():
            running[number] = subprocess.Popen([*dask, "worker", *args, *local], **streams)
            if ended.is_set():
                running[number].kill()
            running[number].wait()

    keepers = [threading.Thread(target=keep, args=(k,)) for k in range(workers)]
    try:
        while not file.exists():
            if scheduler.poll() is not None:
                raise SystemExit("the scheduler exited")
            sleep(0.1)
        for keeper in keepers:
            keeper.start()
        address = json.loads(file.read_text())["address"]
        wait_for(address, workers)
        yield address, lambda: at_work([p.pid for p in list(running.values())])
    finally:
        ended.set()
        scheduler.terminate()
        scheduler.wait()
        for process in list(running.values()):
            process.kill()  # without its scheduler a worker may never exit by itself
        for keeper in keepers:
            if keeper.ident is not None:
                keeper.join()


def wait_for(address: str, workers: int) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=120)


def kill_often(
    batch: subprocess.Popen[str], pids: Pids, kills: int, pause_s: float, seed: int
) -> int:
    """Repeatedly kill one of the processes while a batch runs; return the number of kills."""
    rng = np.random.default_rng(seed)
    done = 0
    while done < kills and batch.poll() is None:
        sleep(pause_s * rng.uniform(0.5, 1.5))
        found = pids()
        if found and batch.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(rng.choice(found)), signal.SIGKILL)
                done += 1
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--recordings", type=int, default=100)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    out: Path = arguments.out
    recordings = make_recordings(out / "recordings", arguments.recordings, arguments.frames)
    list_file = out / "list.txt"
    list_file.write_text("".join(f"{path}\n" for path in recordings))
    results = out / "results"
    shutil.rmtree(results, ignore_errors=True)
    # Warm-up: compilation and first reads are not timed.
    run_alone(recordings[:1], results / "first")
    print(f"{len(recordings)} recordings of {arguments.frames} frames, one thread a job")
    print("| mode | workers | seconds | speed-up over one worker | identical results |", flush=True)
    print("|---|---|---|---|---|", flush=True)

    def row(how: str, workers: int, seconds: float, one: float | None, same: int) -> None:
        faster = "" if one is None else f"{one / seconds:.2f}"
        cells = (how, workers, f"{seconds:.1f}", faster, f"{same} of {len(recordings)}")
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)

    alone = results / "alone"
    seconds = run_alone(recordings, alone)
    row("`tofuse run`, one after the other", 1, seconds, seconds, len(recordings))

    def timed(how: str, workers: int, one: float | None, *args: object) -> float:
        folder = results / f"{how}-{workers}".replace(" ", "-").replace("`", "")
        start = perf_counter()
        finish(start_batch(list_file, folder, *args))
        seconds = perf_counter() - start
        row(how, workers, seconds, one or seconds, same_results(recordings, alone, folder))
        return seconds

    def killed(how: str, pids_of: Callable[[subprocess.Popen[str]], Pids], *args: object) -> None:
        folder = results / f"{how}-killed".replace(" ", "-").replace("`", "")
        start = perf_counter()
        batch = start_batch(list_file, folder, "--retries", arguments.kills, *args)
        pause = fastest / (arguments.kills + 1)
        kills = kill_often(batch, pids_of(batch), arguments.kills, pause, arguments.seed)
        finish(batch)
        same = same_results(recordings, alone, folder)
        row(f"{how}, {kills} kills", 2, perf_counter() - start, None, same)

    if "machine" in arguments.modes:
        one = timed("this machine", 1, None, "--workers", 1)
        fastest = timed("this machine", 2, one, "--workers", 2)
        killed("this machine", lambda batch: lambda: children(batch.pid), "--workers", 2)
    if "LocalCluster" in arguments.modes:
        with local_cluster(1) as (address, _):
            one = timed("`LocalCluster`", 1, None, "--scheduler", address)
        with local_cluster(2) as (address, pids):
            fastest = timed("`LocalCluster`", 2, one, "--scheduler", address)
            killed("`LocalCluster`", lambda _: pids, "--scheduler", address)
    if "processes" in arguments.modes:
        with own_processes(1, out / "dask") as (address, _):
            one = timed("workers of their own", 1, None, "--scheduler", address)
        with own_processes(2, out / "dask") as (address, pids):
            fastest = timed("workers of their own", 2, one, "--scheduler", address)
            killed("workers of their own", lambda _: pids, "--scheduler", address)


if __name__ == "__main__":
    main()
