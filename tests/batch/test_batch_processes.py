"""Batches from the command line: locally and on Dask, uninterrupted, killed and resumed."""

from __future__ import annotations

import csv
import json
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import monotonic, sleep
from types import ModuleType

import pytest

from cli_calls import printed, refuses
from paths import BENCHMARKS
from tofuse.apps.batch import cluster
from tofuse.apps.cli.program import main

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
JOBS = [f"seed-{k}" for k in range(2)]
WORDS = ("--every", "4", "--method", "thesis", "--no-report", "--threads", "1")


@pytest.fixture
def batch_benchmark(monkeypatch) -> ModuleType:
    """The benchmark, which starts clusters, kills their workers and compares results."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    # Shorter than the half minute for which a lost scheduler or worker is retried.
    monkeypatch.setenv("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "3s")
    pytest.importorskip("psutil")
    import batch

    return batch


@pytest.fixture(scope="module")
def listed(room_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of the jobs."""
    path = tmp_path_factory.mktemp("listed") / "list.csv"
    rows = [f"{room_recording},{name},{k},4,thesis,true" for k, name in enumerate(JOBS)]
    path.write_text("\n".join(["recording,name,seed,every,method,no-report", *rows]) + "\n")
    return path


@pytest.fixture(scope="module")
def single_runs(room_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of `tofuse run` for each of them."""
    out = tmp_path_factory.mktemp("single_runs")
    for k, name in enumerate(JOBS):
        words = ("--out", out / name, "--seed", k, *WORDS)
        assert main(["run", str(room_recording), *map(str, words)]) == 0
    return out


def states(out: Path) -> dict[str, str]:
    if not (out / "batch.csv").exists():
        return {}  # no job has ended
    with (out / "batch.csv").open(newline="") as file:
        return {row["name"]: row["state"] for row in csv.DictReader(file)}


def records(out: Path) -> list[dict[str, object]]:
    return [json.loads(path.read_text()) for path in sorted((out / "jobs").glob("*.json"))]


def same(batch_benchmark: ModuleType, single_runs: Path, out: Path) -> bool:
    assert states(out) == dict.fromkeys(JOBS, "done")
    return batch_benchmark.same_results([Path(name) for name in JOBS], single_runs, out) == len(
        JOBS
    )


def wait_until(happened: Callable[[], object], seconds: float = 120) -> None:
    end = monotonic() + seconds
    while not happened():
        assert monotonic() < end, "it did not happen"
        sleep(0.05)


def resume(listed: Path, out: Path) -> None:
    """Run the batch again, on this machine."""
    words = ["batch", str(listed), "--out", str(out), "--workers", "2", "--threads", "1"]
    assert main(words) in (0, 3)


@pytest.mark.nightly_part
def test_bad_recording_does_not_stop_batch(room_recording: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "list.csv").write_text(
        f"recording,every,method\nnothing,,\n{room_recording},4,thesis\n", encoding="utf-8"
    )
    out = tmp_path / "out"
    words = ["batch", str(tmp_path / "list.csv"), "--out", str(out), "--workers", "2"]
    assert main([*words, "--only", "nothing"]) == 2
    output = capsys.readouterr().err
    assert "none of 1 recordings gave a result; nothing: " in output
    assert output.count("\n") == 1
    lines = printed(capsys, *words, "--print-jobs").splitlines()
    assert [shlex.split(line)[-1] for line in lines] == ["nothing", room_recording.name]

    assert main(words) == 3
    output = capsys.readouterr().out
    assert output.startswith("1 of 2 recordings have a result: ")
    assert f"nothing: {tmp_path / 'nothing'}: doesn't exist" in output
    assert states(out) == {"nothing": "failed", room_recording.name: "done"}
    assert f'<img src="jobs/{room_recording.name}.jpg"' in (out / "batch.html").read_text()
    assert (out / "jobs" / f"{room_recording.name}.jpg").read_bytes()[:2] == b"\xff\xd8"
    (made,) = (r for r in records(out) if r["state"] == "done")
    assert made["posed"] == made["frames"] == 2
    assert made["peak_bytes"] > 50_000_000

    before = (out / room_recording.name / "run.json").stat().st_mtime_ns
    assert main([*words, "--json"]) == 3  # only failed jobs are retried
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {e["name"] for e in events if e["event"] == "job"} == {"nothing"}
    assert events[-1] == {
        "event": "result", "out": str(out), "jobs": 2, "done": 1, "failed": 1,
        "verdicts": {made["verdict"]: 1},
    }  # fmt: skip
    assert (out / room_recording.name / "run.json").stat().st_mtime_ns == before


@pytest.mark.nightly
def test_killed_jobs_and_batch_are_resumed(batch_benchmark, listed, single_runs, tmp_path) -> None:
    out = tmp_path / "out"
    words = ("--workers", 2, "--retries", 10)
    batch = batch_benchmark.start_batch(listed, out, *words)
    pids = lambda: batch_benchmark.children(batch.pid)  # noqa: E731
    assert batch_benchmark.kill_often(batch, pids, 2, 0.5, seed=3) == 2
    wait_until(pids)
    jobs = pids()
    batch.kill()
    batch.communicate()
    # Jobs whose batch is gone must end.
    wait_until(lambda: not any(Path(f"/proc/{pid}/exe").exists() for pid in jobs), 20)
    resume(listed, out)
    assert same(batch_benchmark, single_runs, out)
    assert sum(int(r["starts"]) for r in records(out)) >= 4


def test_unreachable_scheduler_is_reported(listed, tmp_path, monkeypatch, capsys) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    monkeypatch.setattr(cluster, "_TIMEOUT_S", 1.0)
    words = ("batch", listed, "--out", tmp_path / "out", "--scheduler")
    for address in ("tcp://127.0.0.1:1", "nonsense://x", "127.0.0.1:99999", str(listed)):
        refuses(capsys, *words, address, says=f"tofuse: {address}: no Dask scheduler answers; ")
    assert not (tmp_path / "out").exists()


def test_job_ends_with_its_parent(room_recording: Path, tmp_path: Path) -> None:
    words = [str(tmp_path / "a.jpg"), str(room_recording), "--out", str(tmp_path / "out")]
    job = subprocess.Popen(
        [sys.executable, "-m", "tofuse.apps.cli.job", *words], stdin=subprocess.PIPE
    )
    assert job.stdin is not None
    job.stdin.close()
    assert job.wait(60) == -signal.SIGKILL
    assert not (tmp_path / "out" / "run.json").exists()
