"""Locks on files, and stamps of files."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tofuse.formats.files.locking import locked
from tofuse.formats.files.stamps import stamp, stamps_in


def test_lock_is_exclusive(tmp_path: Path) -> None:
    inside, most = 0, 0

    def work() -> None:
        nonlocal inside, most
        for _ in range(20):
            with locked(tmp_path / "lock"):
                inside += 1
                most = max(most, inside)
                inside -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (inside, most) == (0, 1)


HOLD = """
import subprocess, sys
from tofuse.formats.files.locking import locked
with locked(sys.argv[1]) as handle:
    command = [sys.executable, "-c", "input()"]
    subprocess.Popen(command, pass_fds=(handle,), stdout=subprocess.DEVNULL)
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX locks")
def test_child_of_killed_process_holds_lock(tmp_path: Path) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "lock")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdin is not None
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    holder.kill()
    holder.wait()
    holder.stdout.close()
    taken = threading.Event()

    def take() -> None:
        with locked(tmp_path / "lock"):
            taken.set()

    thread = threading.Thread(target=take)
    thread.start()
    assert not taken.wait(0.3)
    holder.stdin.close()  # which ends the child
    assert taken.wait(30)
    thread.join()


def test_stamps_change_with_files(tmp_path: Path) -> None:
    for name in ("b/2", "b/1", "a", "out/c"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    found = stamps_in(tmp_path, tmp_path / "out")
    assert [Path(path).name for path, _, _ in found] == ["a", "1", "2"]
    before = stamp(tmp_path / "a")
    assert before[1] == 1
    (tmp_path / "a").write_text("longer")
    assert stamp(tmp_path / "a") != before
