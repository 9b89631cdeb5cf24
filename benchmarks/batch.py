"""Many short recordings as a batch: how much faster two workers are, and what kills cost.

The recordings are turns in simulated furnished rooms, each with its own noise. They are run alone
(`tofuse run`, one after the other), then by `tofuse batch` on this machine, on a Dask
`LocalCluster`, and by a Dask scheduler with workers in processes of their own, by one worker and by
two. In the end workers are killed by SIGKILL at random moments. Each job has one thread, and of
each way all files of all results are compared with those of the runs alone: to the byte, but for
the times in `run.json` and `report.html`. A cluster is started before the clock is.

    python benchmarks/batch.py                                  100 recordings, ten kills
    python benchmarks/batch.py --recordings 6 --frames 3        a quick look

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
from pathlib import Path
from time import perf_counter, sleep

import numpy as np

OUT = Path(__file__).parent / "out" / "batch"
# What a report says of times.
_TIMES = re.compile(
    r'<tr><td>[\w ]+</td><td class="number">[^<]*</td><td class="bars">.*?</tr>'
    r'|<strong>[^<]*</strong></td><td class="muted">[^<]* per frame'
)
# A cluster as a person starts it in Python; it ends with its standard input.
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


def tofuse(*words: object) -> list[str]:
    return [sys.executable, "-m", "tofuse", *map(str, words)]


def make_recordings(folder: Path, count: int, frames: int) -> list[Path]:
    """Simulate those that are missing."""
    from tofuse.lab.simulation.record import simulate

    paths = [folder / f"{frames}-frames" / f"room-{k:03d}" for k in range(count)]
    for k, path in enumerate(paths):
        if not (path / "camera.json").exists():
            shutil.rmtree(path, ignore_errors=True)
            part = path.with_suffix(".part")
            shutil.rmtree(part, ignore_errors=True)
            simulate("room", part, frames=frames, first=k % 50, seed=k)
            os.replace(part, path)
    return paths


def run_alone(recordings: list[Path], out: Path) -> float:
    """Run each recording by itself, and return the seconds."""
    start = perf_counter()
    for path in recordings:
        words = ("run", path, "--out", out / path.name, "--threads", 1)
        done = subprocess.run(tofuse(*words), capture_output=True, text=True, check=False)
        if done.returncode not in (0, 3):
            raise SystemExit(f"{path}: {done.stderr}")
    return perf_counter() - start


def start_batch(list_file: Path, out: Path, *words: object) -> subprocess.Popen[str]:
    """Begin a batch of one thread a job, which Ctrl-C interrupts.

    A shell lets what it begins in the background ignore Ctrl-C, as would all that begins from
    there: who runs this in the background wants to interrupt the batch all the same.
    """
    command = tofuse("batch", list_file, "--out", out, "--threads", 1, *words)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)


def finish(batch: subprocess.Popen[str]) -> str:
    """Wait for its end, and return what it said on standard error."""
    _, said = batch.communicate()
    if batch.returncode not in (0, 3):
        raise SystemExit(f"tofuse batch ended with {batch.returncode}: {said}")
    return said


def contents(result: Path) -> dict[str, bytes]:
    """What the files of a result hold, but for times."""
    found = {}
    for path in sorted(p for p in result.rglob("*") if p.is_file()):
        data = path.read_bytes()
        if path.name == "run.json":
            data = json.dumps({**json.loads(data), "seconds": None}).encode()
        elif path.name == "report.html":
            data = _TIMES.sub("", data.decode()).encode()
        found[str(path.relative_to(result))] = data
    return found


def same_results(recordings: list[Path], alone: Path, out: Path) -> int:
    """How many results are the same as those of the runs alone."""
    names = [path.name for path in recordings]
    return sum(contents(alone / name) == contents(out / name) for name in names)


def children(pid: int) -> list[int]:
    """Processes that a process has started itself, and that go on."""
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        return [p.pid for p in psutil.Process(pid).children()]
    return []


def at_work(workers: list[int]) -> list[int]:
    """Those that have a job's process."""
    return [pid for pid in workers if children(pid)]


@contextmanager
def local_cluster(workers: int) -> Iterator[tuple[str, Pids]]:
    """Give the address of a `LocalCluster`, which begins killed workers anew, and its workers."""
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
    """Give the address of a scheduler, and its workers: each a process, begun anew if killed."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    dask = [sys.executable, "-m", "dask"]
    told = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    words = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = subprocess.Popen([*dask, "scheduler", *words], **told)
    ended = threading.Event()
    running: dict[int, subprocess.Popen[bytes]] = {}

    def keep(number: int) -> None:
        local = ["--local-directory", str(folder / f"worker-{number}")]
        words = ["--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        while not ended.is_set():
            running[number] = subprocess.Popen([*dask, "worker", *words, *local], **told)
            if ended.is_set():
                running[number].kill()
            running[number].wait()

    keepers = [threading.Thread(target=keep, args=(k,)) for k in range(workers)]
    try:
        while not file.exists():
            if scheduler.poll() is not None:
                raise SystemExit("the scheduler ended")
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
            process.kill()  # without its scheduler a worker may wait for ever to say goodbye
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
    """Kill one of the processes, again and again, while a batch goes on; how often that was."""
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
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    out: Path = arguments.out
    recordings = make_recordings(out / "recordings", arguments.recordings, arguments.frames)
    list_file = out / "list.txt"
    list_file.write_text("".join(f"{path}\n" for path in recordings))
    results = out / "results"
    shutil.rmtree(results, ignore_errors=True)
    # What is compiled and read for the first time counts for nobody.
    run_alone(recordings[:1], results / "first")
    print(f"{len(recordings)} recordings of {arguments.frames} frames, one thread a job")
    print("| how | workers | seconds | one worker over this | results as alone |", flush=True)
    print("|---|---|---|---|---|", flush=True)

    def row(how: str, workers: int, seconds: float, one: float | None, same: int) -> None:
        faster = "" if one is None else f"{one / seconds:.2f}"
        cells = (how, workers, f"{seconds:.1f}", faster, f"{same} of {len(recordings)}")
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)

    alone = results / "alone"
    seconds = run_alone(recordings, alone)
    row("`tofuse run`, one after the other", 1, seconds, seconds, len(recordings))

    def timed(how: str, workers: int, one: float | None, *words: object) -> float:
        folder = results / f"{how}-{workers}".replace(" ", "-").replace("`", "")
        start = perf_counter()
        finish(start_batch(list_file, folder, *words))
        seconds = perf_counter() - start
        row(how, workers, seconds, one or seconds, same_results(recordings, alone, folder))
        return seconds

    def killed(how: str, pids_of: Callable[[subprocess.Popen[str]], Pids], *words: object) -> None:
        folder = results / f"{how}-killed".replace(" ", "-").replace("`", "")
        start = perf_counter()
        batch = start_batch(list_file, folder, "--retries", arguments.kills, *words)
        pause = fastest / (arguments.kills + 1)
        kills = kill_often(batch, pids_of(batch), arguments.kills, pause, arguments.seed)
        finish(batch)
        same = same_results(recordings, alone, folder)
        row(f"{how}, {kills} kills", 2, perf_counter() - start, None, same)

    one = timed("this machine", 1, None, "--workers", 1)
    fastest = timed("this machine", 2, one, "--workers", 2)
    killed("this machine", lambda batch: lambda: children(batch.pid), "--workers", 2)
    with local_cluster(1) as (address, _):
        one = timed("`LocalCluster`", 1, None, "--scheduler", address)
    with local_cluster(2) as (address, pids):
        fastest = timed("`LocalCluster`", 2, one, "--scheduler", address)
        killed("`LocalCluster`", lambda _: pids, "--scheduler", address)
    with own_processes(1, out / "dask") as (address, _):
        one = timed("workers of their own", 1, None, "--scheduler", address)
    with own_processes(2, out / "dask") as (address, pids):
        fastest = timed("workers of their own", 2, one, "--scheduler", address)
        killed("workers of their own", lambda _: pids, "--scheduler", address)


if __name__ == "__main__":
    main()
