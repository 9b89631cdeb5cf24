"""After a power cut at any point, a folder has the old content or the new one."""

from __future__ import annotations

import itertools
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest

from made_results import contents, torn
from paths import BENCHMARKS
from tofuse.apps.batch.folder import BatchFolder, Record
from tofuse.apps.batch.jobs import Job
from tofuse.apps.batch.table import write_table
from tofuse.apps.results.folders import OutputFolder, finish_interrupted
from tofuse.apps.results.output import write_result
from tofuse.formats.files.atomic import write_text
from tofuse.formats.files.staging import finish_replacing, is_interrupted, new_folder
from tofuse.formats.rigs.rig_file import Rig, RigCamera, write_rig


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


@pytest.mark.nightly_part
@pytest.mark.parametrize("old", [True, False], ids=["over an old one", "a first one"])
def test_result_is_old_or_new_after_power_cut(memory, power, old) -> None:
    numbers = itertools.count()

    def prepare() -> Path:
        """A folder with an earlier result that was exported, and with a recording."""
        folder = memory / f"{next(numbers):06}" / "out"
        if old:
            write_result(torn(seed=1), OutputFolder(folder))
            (folder / "cloud.pcd").write_bytes(b"exported")
        (folder / "recording").mkdir(parents=True)
        (folder / "recording" / "mine.txt").write_bytes(b"mine")
        return folder

    def write(folder: Path) -> None:
        write_result(torn(seed=2), OutputFolder(folder, overwrite=True))

    before, written = shown(prepare()), prepare()
    write(written)
    after = shown(written)
    assert after["recording/mine.txt"] == b"mine"
    assert contents(written.parent).keys() == {f"out/{name}" for name in after}
    seen = set()

    def check(folder: Path, calls: int) -> None:
        stopped = is_interrupted(folder)
        assert stopped != folder.exists(), calls
        # The next access is by a reader, or by another run.
        read = shutil.copytree(folder.parent, folder.parent.with_name("read")) / folder.name
        finish_interrupted(read)
        assert shown(read) in (before, after), calls
        OutputFolder(folder, overwrite=True).discard()
        assert shown(folder) == shown(read), calls
        shutil.rmtree(read.parent)
        assert contents(folder.parent).keys() == {f"out/{name}" for name in shown(folder)}, calls
        seen.add((stopped, shown(folder) == after))

    assert power.cut_everywhere(prepare, write, check) > 40
    # It is also interrupted when it tries at first whether the folder can be renamed.
    assert seen == {(False, False), (True, False), (True, True), (False, True)}


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
    made = folder / "made"
    finish_replacing(made)
    if number and not (made.exists() and any(made.iterdir())):
        with new_folder(made) as made:
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
