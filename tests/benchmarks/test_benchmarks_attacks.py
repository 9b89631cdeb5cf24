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
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import attack
    import attacks.mutation

    return attack, attacks.mutation


@pytest.mark.nightly
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


def test_signal_stages_name_existing_functions(attacks) -> None:
    from attacks.environments import ENVIRONMENTS, STAGES

    assert len(ENVIRONMENTS) >= 40
    for _, place in STAGES:
        module, name = place.split(":")
        owner = importlib.import_module(module)
        for part in name.split("."):
            owner = getattr(owner, part)
        assert callable(owner)
