"""Some attacks of each kind of `benchmarks/attack.py`, and what `nonsense.py` counts."""

from __future__ import annotations

import importlib
import json
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


@pytest.fixture
def kinds(attacks):
    from attacks import caches, contradictions, forks, metamorphic

    return caches, contradictions, forks, metamorphic


@pytest.mark.nightly
def test_damaged_caches_are_mended_or_not_used(kinds, tmp_path: Path) -> None:
    caches = kinds[0]
    faults = {kind: caches.attack(kind, 0, tmp_path) for kind in caches.KINDS}
    assert faults == dict.fromkeys(caches.KINDS, "")


@pytest.mark.nightly
def test_contradictory_results_are_refused(kinds, tmp_path: Path) -> None:
    contradictions = kinds[1]
    original = tmp_path / "whole"
    original.mkdir()
    contradictions.made(original)
    edits = list(contradictions.edits())
    assert len({edit.name for edit in edits}) == len(edits) >= 50
    for edit in edits[::4]:
        assert contradictions.attack(edit, original, tmp_path / "edited") == []
    harmless = contradictions.Edit("none", "a/trajectory.txt", Path.exists, ("evaluate",))
    assert contradictions.attack(harmless, original, tmp_path / "edited") == [
        "none: evaluate: status 0"
    ]


@pytest.mark.nightly
def test_changed_pairs_keep_their_poses(kinds) -> None:
    metamorphic = kinds[3]
    for name in metamorphic.CHANGES:
        assert metamorphic.attack(name, 0, 0) == "", name


@pytest.mark.nightly
def test_forked_children_end(kinds) -> None:
    assert kinds[2].attack("register", "register") == ""


def test_outcomes_of_nonsense(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import nonsense

    assert len(nonsense.situations()) >= 100
    nan = float("nan")
    for verdict, error, bound, outcome in (
        ("good", 0.01, 0.02, "good within"),
        ("good", 0.03, 0.02, "good OUTSIDE"),
        ("degraded", 0.01, 0.02, "held"),
        ("failed", 0.03, 0.02, "violated"),
        ("good", 0.03, float("inf"), "no bound"),
        ("refused", nan, nan, "no bound"),
        ("CRASHED", nan, nan, "CRASHED"),
    ):
        assert nonsense._outcome(verdict, error, bound) == outcome
    worst = {"verdict": "good", "outcome": "good OUTSIDE", "error_m": 0.03, "bound_m": 0.02}
    for family, status in (("lens", 1), ("mirrored", 0), ("majority that moves", 1)):
        journal = tmp_path / f"{family}.jsonl"
        row = {"family": family, "name": "a situation", **worst}
        journal.write_text(f'{{"seed": 1}}\n{json.dumps(row)}\n')
        words = ["--only", family, "--limit", "0", "--journal", str(journal)]
        assert nonsense.main(words) == status
        assert "a situation" in capsys.readouterr().out.split("violations:")[1]


def test_pairs_of_clouds_are_right_or_wrong(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import made_clouds

    pairs = [*made_clouds.symmetric_pairs(), *made_clouds.strayed_pairs()]
    assert len(pairs) > 40
    for _, make in pairs:
        pair = make(1)
        assert pair.is_right(pair.T_target_source)
        wrong = pair.T_target_source.copy()
        wrong[:3, 3] += 1.0
        assert not pair.is_right(wrong)
