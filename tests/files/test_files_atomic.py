from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from tofuse.engine.errors import OutputError
from tofuse.formats.files.atomic import replacing, write_text


def test_file_is_replaced_atomically(tmp_path: Path) -> None:
    with replacing(tmp_path / "a.png") as beside:
        assert beside.parent == tmp_path
        assert beside.suffix == ".png"
        beside.write_text("new")
        assert not (tmp_path / "a.png").exists()
    assert (tmp_path / "a.png").read_text() == "new"
    assert os.listdir(tmp_path) == ["a.png"]


def test_failure_keeps_earlier_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def interrupted() -> None:
        with replacing(tmp_path / "a.txt") as beside:
            beside.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "free some space"), (errno.EACCES, "may write to"), (errno.EROFS, "may write")],
)
def test_write_errors_state_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def fail(*_args: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(OutputError, match=words) as caught:
        write_text(tmp_path / "a.txt", "x")
    assert str(tmp_path / "a.txt") in str(caught.value)
    assert "\n" not in str(caught.value)
