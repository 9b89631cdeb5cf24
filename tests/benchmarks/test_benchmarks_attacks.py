"""Some hundreds of the damaged files of `benchmarks/attack.py`, and a few of its power cuts."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from paths import BENCHMARKS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="alarms and queues of Linux")

SEEDS = 8


@pytest.fixture
def attacks(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import attack
    import attacks.mutation

    return attack, attacks.mutation


def test_damaged_files_are_read_or_refused(attacks, tmp_path: Path) -> None:
    _, mutation = attacks
    seen: dict[str, int] = {}
    faults = []
    subjects = mutation.subjects()
    assert len(subjects) > 35
    for name, subject in subjects.items():
        original = tmp_path / "whole"
        original.mkdir()
        subject.make(original)
        subject.read(original)
        for seed in range(SEEDS):
            copy = tmp_path / "copy"
            shutil.copytree(original, copy, symlinks=True)
            outcome = mutation.attack(name, subject, seed, copy)
            shutil.rmtree(copy)
            seen[outcome] = seen.get(outcome, 0) + 1
            if outcome not in ("read", "refused"):
                faults.append(f"{name}, seed {seed}: {outcome}")
        shutil.rmtree(original)
    assert faults == []
    assert min(seen["read"], seen["refused"]) > 50


def test_processes_that_crash_are_told_and_the_others_go_on(attacks) -> None:
    _, mutation = attacks
    found = list(mutation.run("pose", 3, first=7))
    assert [seed for seed, _ in found] == [7, 8, 9]
    assert {outcome for _, outcome in found} <= {"read", "refused"}
    (crashed,) = mutation.run("no such format", 1)
    assert crashed == (0, "its process ended with 1")


def test_power_cuts(attacks) -> None:
    attack, _ = attacks
    assert attack.cuts(0, 10, seed=3) == (10, [])


def test_a_journal_goes_on_where_it_was_stopped(attacks, tmp_path: Path) -> None:
    from attacks.journal import Journal

    path, settings = tmp_path / "new" / "a.jsonl", {"seed": 1}
    done: list[int] = []

    def work(number: int) -> tuple[int, list[str]]:
        done.append(number)
        return 10, ["it fell over"] if number == 1 else []

    for most in (2, 3):
        journal = Journal(path, settings)
        for number in range(most):
            journal.do("some", number, lambda n=number: work(n))
    assert done == [0, 1, 2]
    assert Journal(path, settings).table() == [("some", 30, 29)]
    with pytest.raises(SystemExit, match="other settings"):
        Journal(path, {"seed": 2})
