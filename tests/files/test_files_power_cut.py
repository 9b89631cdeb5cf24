"""After a power cut at any point, a folder has the old result, the new one, or a recovery plan."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest

from made_results import contents, result, torn
from paths import BENCHMARKS
from tofuse.batch.folder import BatchFolder, Record
from tofuse.batch.jobs import Job
from tofuse.batch.table import write_table
from tofuse.errors import OutputError
from tofuse.files.atomic import new_folder, write_text
from tofuse.files.staging import is_interrupted
from tofuse.recordings.rig import Rig, RigCamera, write_rig
from tofuse.results.folder import STAGING, OutputFolder, finish_interrupted, is_result
from tofuse.results.output import write_result

MINE = {"notes.txt": b"mine", "pictures/a.jpg": b"mine as well"}


@pytest.fixture
def power(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import attacks.power

    return attacks.power


@pytest.fixture
def memory(tmp_path):
    """A folder where fsync takes no time, if there is one."""
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else tmp_path) as folder:
        yield Path(folder)


def shown(folder: Path) -> dict[str, bytes]:
    """The visible files of a folder."""
    found = contents(folder)
    return {name: data for name, data in found.items() if not name.startswith(".tofuse-")}


def with_mine(folder: Path, *, old: bool) -> None:
    if old:
        write_result(torn(seed=1), OutputFolder(folder))
        (folder / "cloud.pcd").write_bytes(b"exported")
        for name, data in MINE.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("old", [True, False], ids=["over an old one", "a first one"])
def test_result_is_old_or_new_after_power_cut(memory, power, old) -> None:
    numbers = itertools.count()
    made = memory / "made"
    made.mkdir()
    with_mine(made, old=old)

    def prepare() -> Path:
        return shutil.copytree(made, memory / f"folder-{next(numbers):06}")

    def write(folder: Path) -> None:
        write_result(torn(seed=2), OutputFolder(folder, overwrite=True))

    before = shown(prepare())
    written = prepare()
    write(written)
    after = shown(written)
    assert {n: after.get(n) for n in MINE} == (MINE if old else dict.fromkeys(MINE))
    seen = set()

    def check(folder: Path, calls: int) -> None:
        stopped = is_interrupted(folder / STAGING)
        if not stopped:
            assert shown(folder) in (before, after), calls
        else:  # it does not pass as a complete result
            assert shown(folder) in (before, after) or not is_result(folder), calls
        # The next access is by a reader, or by another run.
        read = shutil.copytree(folder, folder.with_name(f"{folder.name}-read"), symlinks=True)
        finish_interrupted(read)
        assert shown(read) == after if stopped else shown(read) in (before, after), calls
        shutil.rmtree(read)
        OutputFolder(folder, overwrite=True).discard()
        assert shown(folder) in (before, after), calls
        assert shown(folder) == contents(folder), calls
        assert stopped <= (shown(folder) == after), calls
        seen.add((stopped, shown(folder) == after))

    assert power.cut_everywhere(prepare, write, check) > 40
    assert seen == {(False, False), (True, True), (False, True)}


@pytest.mark.slow
@pytest.mark.parametrize("way", ["forward", "back"])
def test_recovery_survives_another_power_cut(memory, power, monkeypatch, way) -> None:
    numbers = itertools.count()
    move = os.replace

    def prepare() -> Path:
        """Moves that were interrupted halfway, or while they were undone."""
        folder = memory / f"folder-{next(numbers):06}"
        folder.mkdir()
        with_mine(folder, old=True)
        moves = []

        def fails(source, target) -> None:
            if folder in (Path(target).parent, Path(source).parent):
                moves.append(target)
                if len(moves) == 9 or (len(moves) > 9 and way == "forward") or len(moves) > 11:
                    raise OSError(5, "gone")
            elif len(moves) >= 9 and way == "forward":
                raise OSError(5, "gone")
            move(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", fails)
            with pytest.raises(OutputError):
                write_result(torn(seed=2), OutputFolder(folder, overwrite=True))
        assert is_interrupted(folder / STAGING)
        assert not is_result(folder)
        return folder

    whole = prepare()
    finish_interrupted(whole)
    wanted = shown(whole)
    assert is_result(whole)
    assert MINE.items() <= wanted.items()

    def check(folder: Path, calls: int) -> None:
        finish_interrupted(folder)
        assert shown(folder) == wanted, calls
        OutputFolder(folder, overwrite=True).discard()
        assert contents(folder) == wanted, calls

    assert power.cut_everywhere(prepare, finish_interrupted, check) > 10


def _record(folder: Path, state: str, job: Job) -> None:
    BatchFolder(folder).write(job, Record(job.key(folder), state))  # type: ignore[arg-type]


def _batch(folder: Path, number: int) -> None:
    job, batch = Job("one", "/nowhere", ()), BatchFolder(folder)
    batch.prepare()
    _record(folder, "done" if number else "failed", job)
    write_table([job], batch)


def _rig(folder: Path, number: int) -> None:
    cameras = tuple(
        RigCamera(name, "", np.eye(4), np.eye(6), 0.0, 0.01 * number) for name in ("a", "b")
    )
    write_rig(folder / "rig.json", Rig(cameras))


def _text(folder: Path, number: int) -> None:
    write_text(folder / "a.txt", 1000 * str(number))


def _folder(folder: Path, number: int) -> None:
    if number and not (folder / "made").exists():
        with new_folder(folder / "made") as made:
            (made / "depth").mkdir()
            for k in range(3):
                write_text(made / "depth" / f"{k}", "depth")
            write_text(made / "camera.json", "{}")


@pytest.mark.parametrize("write", [_batch, _rig, _text, _folder])
def test_other_files_are_old_or_new_after_power_cut(memory, power, write) -> None:
    numbers = itertools.count()

    def prepare() -> Path:
        folder = memory / f"folder-{next(numbers):06}"
        folder.mkdir()
        write(folder, 0)
        return folder

    def known(folder: Path) -> dict[str, bytes]:
        """All files without temporary ones, and without the name of the folder itself."""
        found = {n: d for n, d in contents(folder).items() if ".part" not in n}
        return {
            n: d.replace(str(folder).encode(), b"").replace(folder.name.encode(), b"")
            for n, d in found.items()
            if ".lock" not in n and not n.startswith(".tofuse-")
        }

    before, written = known(prepare()), prepare()
    write(written, 1)
    after = known(written)
    assert before != after

    def check(folder: Path, _calls: int) -> None:
        found = known(folder)
        for name, data in found.items():
            assert data in (before.get(name), after.get(name)), name
        if write is _folder:
            assert found in (before, after)
        assert set(before) <= set(found)
        write(folder, 1)
        assert set(known(folder)) == set(after)

    assert power.cut_everywhere(prepare, lambda folder: write(folder, 1), check) >= 4


def test_power_cut_loses_unsynced_data(tmp_path, power) -> None:
    """Checks the simulation: without fsync a file that was moved into place is truncated."""
    cut = power.Power(2)
    (tmp_path / "a").mkdir()
    with cut.connected():
        (tmp_path / "a" / "part").write_text("0123456789")
        os.replace(tmp_path / "a" / "part", tmp_path / "a" / "whole")
        with pytest.raises(power.PowerCut):
            os.unlink(tmp_path / "a" / "whole")
    cut.lose(tmp_path)
    assert (tmp_path / "a" / "whole").read_text() == "01234"
    write_result(result(), OutputFolder(tmp_path / "b"))
    assert json.loads((tmp_path / "b" / "run.json").read_text())["seed"] == 0
