"""Ownership of an output folder is established, by one process, before anything is changed."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest

from made_results import contents, result, torn
from refused import refused
from tofuse.apps.results.folders import OutputFolder, check_output, finish_interrupted, is_result
from tofuse.apps.results.output import write_result
from tofuse.apps.results.run_json import read_run_json
from tofuse.engine.errors import OutputError
from tofuse.formats.files import staging
from tofuse.formats.files.staging import beside
from tofuse.lab.demo import _check_simulated


@pytest.mark.parametrize("what", ["new", "old", "lock", "component", "file"])
def test_links_are_never_followed(tmp_path, what) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    write_result(torn(), OutputFolder(out))
    elsewhere.mkdir()
    (elsewhere / "cloud.ply").write_text("precious")
    if what == "component":
        (out / "component-9").symlink_to(elsewhere)
    elif what == "file":
        (out / "cloud.ply").unlink()
        (out / "cloud.ply").symlink_to(elsewhere / "cloud.ply")
    else:
        beside(out, what).symlink_to(elsewhere / ("cloud.ply" if what == "lock" else ""))
    before = contents(tmp_path)
    with pytest.raises(OutputError):
        write_result(torn(seed=3), OutputFolder(out, overwrite=True))
    assert contents(tmp_path) == before


@pytest.mark.parametrize("foreign", [None, "tiles/notes.txt", "component-1/view.npy"])
def test_result_of_version_0_2_is_replaced_without_foreign_files(tmp_path, foreign) -> None:
    out = tmp_path / "out"
    write_result(torn(), OutputFolder(out))
    of_version = ["view.npz", "mesh.usdz", "tiles/tileset.json", "tiles/3-0-1-12.glb"]
    of_version += ["component-1/view.npz", "component-1/tiles/tileset.json"]
    for name in (*of_version, foreign or "view.npz"):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).touch()
    if foreign:
        with pytest.raises(OutputError, match=rf"{foreign}: is not a file of an earlier result"):
            OutputFolder(out, overwrite=True)
        return
    write_result(torn(seed=3), OutputFolder(out, overwrite=True))
    assert not any((out / name).exists() for name in of_version)


HOLD = """
import sys
from tofuse.apps.results.folders import OutputFolder
with OutputFolder(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def holder(out: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


@pytest.mark.parametrize("end", ["ends", "is killed"])
def test_second_run_is_refused_and_names_first(tmp_path, end) -> None:
    out = tmp_path / "out"
    with holder(out) as first:
        with pytest.raises(OutputError) as caught:
            OutputFolder(out, overwrite=True)
        for word in (str(out), f"pid {first.pid}", f"on {platform.node()}", "since 2"):
            assert word in str(caught.value)
        assert beside(out, "new").is_dir()
        if end == "is killed":
            first.kill()
    if end == "is killed":
        assert beside(out, "lock").exists()  # is taken over
    with OutputFolder(out) as mine:
        assert mine.path == out
        assert f"pid {os.getpid()}" in beside(out, "lock").read_text()
        refused("another process", out, by=OutputFolder, error=OutputError)
    assert not list(tmp_path.glob(".tofuse-*"))


def interrupted(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace a result with seed 1 by one with seed 2, and stop between the two moves."""
    write_result(result(seed=1), OutputFolder(out))
    folder, move = OutputFolder(out, overwrite=True), os.replace

    def stops(source, target) -> None:
        if Path(source) == beside(out, "new"):
            raise KeyboardInterrupt
        move(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", stops)
        with pytest.raises(KeyboardInterrupt):
            write_result(result(seed=2), folder)
    assert not out.exists()


def test_signal_between_the_moves_leaves_the_new_result(tmp_path, monkeypatch) -> None:
    out = tmp_path / "out"
    write_result(result(seed=1), OutputFolder(out))
    folder, move, signals = OutputFolder(out, overwrite=True), staging._move_into_place, [True]

    def interrupted_once(*paths) -> None:
        if signals:
            signals.clear()
            raise KeyboardInterrupt
        move(*paths)

    monkeypatch.setattr(staging, "_move_into_place", interrupted_once)
    with pytest.raises(KeyboardInterrupt):
        write_result(result(seed=2), folder)
    assert read_run_json(out / "run.json")["seed"] == 2
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("meanwhile", ["nothing", "an empty folder"])
@pytest.mark.parametrize("by", ["a reader", "a run"])
def test_interrupted_replacement_is_finished(tmp_path, monkeypatch, by, meanwhile) -> None:
    out = tmp_path / "out"
    interrupted(out, monkeypatch)
    if by == "a reader":
        finish_interrupted(out)
    else:
        if meanwhile == "an empty folder":
            out.mkdir()
        with pytest.raises(OutputError, match="contains an earlier result; pass overwrite"):
            OutputFolder(out)
    assert is_result(out)
    assert read_run_json(out / "run.json")["seed"] == 2
    assert list(tmp_path.iterdir()) == [out]


def test_reader_names_process_that_replaces_result(tmp_path, monkeypatch) -> None:
    out = tmp_path / "out"
    interrupted(out, monkeypatch)
    out.mkdir()
    with OutputFolder(out, overwrite=True):  # finishes it
        shutil.move(out, beside(out, "old"))
        refused(f"another process .pid {os.getpid()}", out, by=finish_interrupted)
        shutil.move(beside(out, "old"), out)


@pytest.mark.parametrize("where", ["out", "out/below"])
def test_current_folder_is_not_replaced(tmp_path, monkeypatch, where) -> None:
    (tmp_path / "out/below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / where)
    with pytest.raises(OutputError, match="is or contains the current folder"):
        OutputFolder(os.path.relpath(tmp_path / "out"))
    refused("is or contains the current folder", "/", by=OutputFolder, error=OutputError)
    assert OutputFolder("new").folder == tmp_path / where / "new"


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX permissions")
@pytest.mark.parametrize("read_only", ["out", "its parent"])
def test_read_only_folder_is_refused(tmp_path, read_only) -> None:
    out = tmp_path / "parent/out"
    out.mkdir(parents=True)
    folder = out if read_only == "out" else out.parent
    folder.chmod(0o555)
    try:
        if os.access(folder, os.W_OK):
            pytest.skip("root may write everywhere")
        with pytest.raises(OutputError, match=r"can't be written \(permission denied\)") as caught:
            check_output(out, overwrite=False)
        assert caught.value.where == str(folder)
    finally:
        folder.chmod(0o755)


def test_result_behind_link_is_replaced(tmp_path) -> None:
    (tmp_path / "link").symlink_to("disk/out")
    with pytest.raises(OutputError, match=r"link: is a link to disk/out, which doesn't exist"):
        OutputFolder(tmp_path / "link")
    assert [p.name for p in tmp_path.iterdir()] == ["link"]
    (tmp_path / "disk/out").mkdir(parents=True)
    for seed in (1, 2):
        write_result(result(seed=seed), OutputFolder(tmp_path / "link", overwrite=seed > 1))
        assert read_run_json(tmp_path / "disk/out/run.json")["seed"] == seed
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize("theirs", ["notes.txt", "depth/mine.txt", "link"])
def test_demo_does_not_replace_recording_with_foreign_files(tmp_path, theirs) -> None:
    recording = tmp_path / "recording"
    _check_simulated(recording)
    (recording / "truth").mkdir(parents=True)
    (recording / "depth").mkdir()
    (recording / "depth" / "000000.png").write_text("made")
    _check_simulated(recording)
    if theirs == "link":
        (recording / "depth" / "000001.png").symlink_to("elsewhere")
    else:
        (recording / theirs).write_text("mine")
    refused("or holds something else", recording, by=_check_simulated, error=OutputError)


def test_refused_process_leaves_the_folder_that_the_other_one_creates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"

    def taken(*_args: object, **_options: object) -> NoReturn:
        folder.mkdir()  # by the other process, which has the lock
        raise OutputError("is being written by another process")

    monkeypatch.setattr(staging, "Claim", taken)
    refused("another process", folder, by=OutputFolder, error=OutputError)
    assert folder.is_dir()
