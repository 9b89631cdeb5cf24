"""Ownership of an output folder is established, by one process, before anything is changed."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from made_results import contents, result, torn
from tofuse.errors import InputError, OutputError
from tofuse.files import locking
from tofuse.files.locking import Claim
from tofuse.lab.demo import _replacing_recording
from tofuse.results.folder import LOCK, STAGING, OutputFolder, finish_interrupted, is_result
from tofuse.results.output import write_result
from tofuse.results.pair import pair_folder

FILE = ["file", 6, 0.0]
RUN = {"schema": 1, "version": "0", "verdict": "good"}

# Plans that may be left in a folder by others: none of them may be followed.
PLANS: dict[str, object] = {
    "of version 0.1": {"files": [], "old": ["precious.txt"]},
    "a list": [],
    "numbers": {"new": [1], "old": [2]},
    "a number": {"new": {"run.json": 1}, "old": {}},
    "no JSON": b"{",
    "nested": b"[" * 100_000,
    "empty": b"",
    "large": b" " * (5 << 20),
    "binary": b"\xff\xfe\x00",
    "a foreign name": {"new": {}, "old": {"run.json": FILE, "precious.txt": FILE}},
    "upwards": {"new": {}, "old": {"run.json": FILE, "../precious.txt": FILE}},
    "absolute": {"new": {}, "old": {"run.json": FILE, "/etc/passwd": FILE}},
    "upwards in a component": {
        "new": {},
        "old": {"run.json": FILE, "component-1": {"../../precious.txt": FILE}},
    },
    "upwards in tiles": {
        "new": {},
        "old": {"run.json": FILE, "tiles": {"../precious.txt": FILE}},
    },
    "a foreign file in tiles of a component": {
        "new": {},
        "old": {"run.json": FILE, "component-1": {"tiles": {"cloud.ply": FILE}}},
    },
    "tiles in tiles": {"new": {}, "old": {"run.json": FILE, "tiles": {"tiles": {}}}},
    "a component elsewhere": {"new": {}, "old": {"run.json": FILE, "component-1/..": {}}},
    "no result replaced": {"new": {}, "old": {"cloud.ply": FILE}},
    "no result made": {"new": {"cloud.ply": FILE}, "old": {}},
    "a link as new": {"new": {"run.json": ["link", 6, 0.0]}, "old": {}},
    "was changed": {"new": {}, "old": {"run.json": FILE, "cloud.ply": FILE}},
    "infinite": {"new": {}, "old": {"run.json": ["file", 6, float("nan")]}},
    "huge numbers": b'{"new": {}, "old": {"run.json": ["file", 1' + b"0" * 10_000 + b", 0]}}",
}


def planted(folder: Path, plan: object, name: str) -> None:
    (folder / "precious.txt").write_text("precious")
    (folder / "cloud.ply").write_text("mine, and precious as well")
    staging = folder / STAGING
    (staging / "replaced").mkdir(parents=True)
    data = plan if isinstance(plan, bytes) else json.dumps(plan).encode()
    (staging / name).write_bytes(data)


@pytest.mark.parametrize("name", ["plan.json", "undo.json"])
@pytest.mark.parametrize("theirs", [True, False], ids=["beside a result", "beside none"])
@pytest.mark.parametrize("plan", PLANS)
def test_foreign_plans_are_not_followed(tmp_path, plan, theirs, name) -> None:
    out = tmp_path / "out"
    out.mkdir()
    planted(out, PLANS[plan], name)
    if theirs:
        (out / "run.json").write_text(json.dumps(RUN))
    before = contents(tmp_path)
    for overwrite in (False, True):
        with pytest.raises(OutputError) as caught:
            OutputFolder(out, overwrite=overwrite)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 500
        assert contents(tmp_path) == before
    if plan not in ("was changed", "no result made"):  # these are not checked by readers
        with pytest.raises(InputError):
            finish_interrupted(out)
    assert contents(tmp_path) == before
    assert not (out / LOCK).exists()


@pytest.mark.parametrize("what", ["staging", "replaced", "plan", "lock", "component"])
def test_links_are_never_followed(tmp_path, what) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    write_result(torn(), OutputFolder(out))
    elsewhere.mkdir()
    (elsewhere / "cloud.ply").write_text("precious")
    (elsewhere / "plan.json").write_text(json.dumps({"new": {}, "old": {}}))
    staging = out / STAGING
    if what == "staging":
        staging.symlink_to(elsewhere)
    elif what == "lock":
        (out / LOCK).symlink_to(elsewhere / "cloud.ply")
    elif what == "component":
        (out / "component-9").symlink_to(elsewhere)
    else:
        staging.mkdir()
        at = staging / ("replaced" if what == "replaced" else "plan.json")
        at.symlink_to(elsewhere if what == "replaced" else elsewhere / "plan.json")
        if what == "replaced":
            (staging / "plan.json").write_text(json.dumps({"new": {}, "old": {}}))
    before = contents(tmp_path)
    with pytest.raises(OutputError):
        write_result(torn(seed=3), OutputFolder(out, overwrite=True))
    assert contents(tmp_path) == before


def test_foreign_files_in_staging_folder_are_kept(tmp_path) -> None:
    staging = tmp_path / STAGING
    staging.mkdir()
    (staging / "precious.txt").write_text("mine")
    with pytest.raises(OutputError, match="is not a file of an earlier result"):
        OutputFolder(tmp_path)
    assert (staging / "precious.txt").read_text() == "mine"


def test_result_of_other_kind_is_not_recovered(tmp_path) -> None:
    write_result(result(), OutputFolder(tmp_path))
    planted(tmp_path, {"new": {}, "old": {"run.json": FILE}}, "plan.json")
    before = contents(tmp_path)
    with pytest.raises(OutputError):
        pair_folder(tmp_path, overwrite=True)
    assert contents(tmp_path) == before


HOLD = """
import sys
from tofuse.results.folder import OutputFolder
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
        assert (out / STAGING).is_dir()
        if end == "is killed":
            first.kill()
    if end == "is killed":
        assert (out / LOCK).exists()  # is taken over
    with OutputFolder(out) as mine:
        assert mine.path == out
        note = json.loads((out / LOCK).read_text())
        assert note["pid"] == os.getpid()
        with pytest.raises(OutputError, match="another process"):
            OutputFolder(out)
    assert not (out / LOCK).exists()


def test_note_decides_where_locks_are_unsupported(tmp_path, monkeypatch) -> None:
    def none(_handle: int) -> None:
        raise OSError(38, "no locks available")

    monkeypatch.setattr(locking, "_lock_nonblocking", none)
    lock = tmp_path / "lock"
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"],
                          capture_output=True, text=True, check=True)  # fmt: skip
    note = {"pid": int(gone.stdout), "host": platform.node(), "since": "then"}
    for held, refused in (
        (note, False),
        (note | {"pid": os.getppid()}, True),
        (note | {"host": "elsewhere"}, True),
        (note | {"pid": -1}, False),
        (note | {"pid": 10**30}, True),
        ([], False),
    ):
        lock.write_text(json.dumps(held))
        if refused:
            with pytest.raises(OutputError, match="another process"):
                Claim(lock, target="out")
        else:
            Claim(lock, target="out").release()


def test_reader_refuses_running_moves_and_finishes_interrupted_ones(tmp_path, monkeypatch) -> None:
    write_result(result(seed=1), OutputFolder(tmp_path))
    folder, moves, move = OutputFolder(tmp_path, overwrite=True), [], os.replace

    def fails(source, target) -> None:
        if tmp_path in (Path(target).parent, Path(source).parent):
            moves.append(target)
            if len(moves) > 3:
                with pytest.raises(InputError, match=f"pid {os.getpid()}"):
                    finish_interrupted(tmp_path)  # during the moves
                raise OSError(5, "gone")
        move(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fails)
        with pytest.raises(OutputError):
            write_result(result(seed=2), folder)
    assert not is_result(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", lambda *_a, **_o: (_ for _ in ()).throw(OSError(30, "read-only")))
        with pytest.raises(InputError, match="read-only"):
            finish_interrupted(tmp_path)
    finish_interrupted(tmp_path)
    assert is_result(tmp_path)
    assert not (tmp_path / STAGING).exists()


@pytest.mark.parametrize("theirs", ["notes.txt", "depth/mine.txt", "link"])
def test_demo_does_not_replace_recording_with_foreign_files(tmp_path, theirs) -> None:
    recording = tmp_path / "recording"
    (recording / "truth").mkdir(parents=True)
    (recording / "depth").mkdir()
    (recording / "depth" / "000000.png").write_text("made")
    with _replacing_recording(recording) as fresh:
        (fresh / "truth").mkdir(parents=True)
        os.replace(fresh, recording)
    assert not (recording / "depth").exists()
    (recording / "depth").mkdir()
    if theirs == "link":
        (recording / "depth" / "000000.png").symlink_to("elsewhere")
    else:
        (recording / theirs).write_text("mine")
    with (
        pytest.raises(OutputError, match="or holds something else"),
        _replacing_recording(recording),
    ):
        pass
    assert os.path.lexists(recording / ("depth/000000.png" if theirs == "link" else theirs))


def test_dangling_link_is_named(tmp_path) -> None:
    link = tmp_path / "out"
    link.symlink_to(tmp_path / "missing" / "folder")
    with pytest.raises(OutputError, match=r"out: is a link to .*folder, which doesn't exist"):
        OutputFolder(link)
    assert link.is_symlink()
    assert list(tmp_path.iterdir()) == [link]
