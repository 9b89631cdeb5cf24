"""The times of stages: what `tofuse run --profile` prints, and `run.json` has."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cli_calls import refuses
from tofuse.engine.stopwatch import Stopwatch, timing


def test_stage_inside_another_is_not_part_of_it(monkeypatch) -> None:
    wall, cpu = iter([0, 1, 3, 7, 15]), iter([0, 10, 20, 30, 50])
    monkeypatch.setattr("tofuse.engine.stopwatch.perf_counter", lambda: next(wall))
    monkeypatch.setattr("tofuse.engine.stopwatch.process_time", lambda: next(cpu))
    watch = Stopwatch()
    with timing("no stopwatch is running"), watch.running(), timing("outer"), timing("inner"):
        pass
    assert watch.seconds == {"outer": 2 + 8, "inner": 4}
    assert watch.cpu_seconds == {"outer": 10 + 20, "inner": 10}


def test_profile_names_all_time_of_the_process(tmp_path: Path, room_recording: Path) -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = ["run", room_recording, "--out", tmp_path / "result", "--threads", "2", "--profile"]
    done = subprocess.run(
        [sys.executable, "-m", "tofuse", *words], capture_output=True, text=True, check=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    lines = done.stderr[done.stderr.index("stage ") :].splitlines()
    rows = {}
    for line in lines[1:]:
        *name, s, share, per_frame, cpu, busy = line.split()
        rows[" ".join(name)] = [float(number) for number in (s, share, per_frame, cpu, busy)]
    total = rows.pop("all, 2 threads")
    stages = "starting imports opening trials inspection tracking loops refinement fusion meshing"
    assert {*stages.split(), "kernels", "writing", "report", "exit"} <= set(rows)
    assert rows["other"][1] < 3  # % of the wall time
    assert sum(row[0] for row in rows.values()) == pytest.approx(total[0], abs=0.2)
    assert total[3] > 0.97 * cpu_s  # CPU time as it is measured from outside

    written = json.loads((tmp_path / "result" / "run.json").read_text())
    for stage in ("starting", "tracking", "report"):
        s, _, per_frame, cpu, _ = rows[stage]
        assert written["seconds"][stage] == pytest.approx(s, abs=0.01)
        assert written["cpu_seconds"][stage] == pytest.approx(cpu, abs=0.01)
        assert per_frame == pytest.approx(1e3 * s / 8, abs=1)


def test_profile_is_of_single_runs(capfd, tmp_path: Path, room_recording: Path) -> None:
    run = ("run", room_recording, "--out", tmp_path / "result", "--profile")
    refuses(capfd, *run, "--view", says=("--profile", "--view"))
    refuses(capfd, *run, "--rig", "rig.json", says=("--profile", "rig"))
