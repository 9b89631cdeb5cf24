"""Some of the fuzzed files of `benchmarks/attack.py`, and some of its power cuts."""

from __future__ import annotations

import importlib
import pkgutil
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType, FunctionType

import pytest

import tofuse
from paths import BENCHMARKS
from tofuse.formats.recordings.open import readers

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs alarms and FIFOs")

SEEDS = 3


@pytest.fixture
def attacks(monkeypatch):
    # The subjects are made by helpers of the readers' tests, which are imported when needed.
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "recordings"))
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import attack
    import attacks.mutation

    return attack, attacks.mutation


@pytest.mark.slow
def test_fuzzed_files_are_read_or_rejected(attacks, tmp_path: Path) -> None:
    """For every registered format and every function that reads files."""
    _, mutation = attacks
    called: set[CodeType] = set()
    formats = set()
    seen: dict[str, int] = {}
    faults = []
    subjects = mutation.subjects()
    assert len(subjects) > 50
    for name, subject in subjects.items():
        original = tmp_path / "whole"
        original.mkdir()
        subject.make(original)
        with calls_recorded(called):
            formats.add(subject.read(original))
        for seed in range(SEEDS):
            copy = tmp_path / "copy"
            shutil.copytree(original, copy, symlinks=True)
            outcome = mutation.attack(name, subject, seed, copy)
            shutil.rmtree(copy)
            seen[outcome] = seen.get(outcome, 0) + 1
            if outcome not in ("read", "rejected"):
                faults.append(f"{name}, seed {seed}: {outcome}")
        shutil.rmtree(original)
    assert faults == []
    assert min(seen["read"], seen["rejected"]) > 50
    assert formats == {None, *readers()}
    assert [name for name, function in reading().items() if function.__code__ not in called] == []


@contextmanager
def calls_recorded(called: set[CodeType]) -> Iterator[None]:
    """Record the code of all Python functions that are called."""

    def record(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call":
            called.add(frame.f_code)

    before = sys.getprofile()
    sys.setprofile(record)
    try:
        yield
    finally:
        sys.setprofile(before)


def reading() -> dict[str, FunctionType]:
    """The functions of tofuse whose names say that they read files, by name."""
    found = {}
    for module in pkgutil.walk_packages(tofuse.__path__, "tofuse."):
        if module.name == "tofuse.__main__":
            continue
        for name, each in vars(importlib.import_module(module.name)).items():
            own = isinstance(each, FunctionType) and each.__module__ == module.name
            if own and name.lstrip("_").startswith("read_"):
                found[f"{module.name}.{name}"] = each
    assert len(found) > 40
    return found


@pytest.mark.slow
def test_crash_is_recorded_and_next_seed_runs(attacks) -> None:
    _, mutation = attacks
    found = list(mutation.run("pose", 3, first=7))
    assert [seed for seed, _ in found] == [7, 8, 9]
    assert {outcome for _, outcome in found} <= {"read", "rejected"}
    (crashed,) = mutation.run("no such format", 1)
    assert crashed == (0, "its process ended with 1")


def test_signal_stages_name_existing_functions(attacks) -> None:
    from attacks.environments import ENVIRONMENTS, STAGES

    assert len(ENVIRONMENTS) >= 40
    for _, place in STAGES:
        module, name = place.split(":")
        owner = importlib.import_module(module)
        for part in name.split("."):
            owner = getattr(owner, part)
        assert callable(owner)


def test_power_cuts_cause_no_faults(attacks) -> None:
    attack, _ = attacks
    assert attack.cuts(0, 10, seed=3) == (10, [])


def test_journal_resumes_where_it_stopped(attacks, tmp_path: Path) -> None:
    from attacks.journal import Journal

    path, settings = tmp_path / "new" / "a.jsonl", {"seed": 1}
    done: list[int] = []

    def work(number: int) -> tuple[int, list[str]]:
        done.append(number)
        return 10, ["it crashed"] if number == 1 else []

    for most in (2, 3):
        journal = Journal(path, settings)
        for number in range(most):
            journal.do("some", number, lambda n=number: work(n))
    assert done == [0, 1, 2]
    assert Journal(path, settings).table() == [("some", 30, 29)]
    with pytest.raises(SystemExit, match="other settings"):
        Journal(path, {"seed": 2})
