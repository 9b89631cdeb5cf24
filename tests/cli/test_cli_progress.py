"""Progress of a job: on a terminal, in a log, and as JSON lines."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import time
from importlib.machinery import ModuleSpec
from types import ModuleType

import numba
import pytest
from rich.console import Console

from tofuse.apps.cli.progress import (
    JsonProgress,
    LineProgress,
    QuietProgress,
    TerminalProgress,
    progress_for,
    progress_in_python,
)
from tofuse.engine.results.types import FrameRecord


def test_output_stream_selects_progress_type(monkeypatch) -> None:
    assert isinstance(progress_for(as_json=True), JsonProgress)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert isinstance(progress_for(as_json=False), QuietProgress)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert isinstance(progress_for(as_json=False), TerminalProgress)


def test_python_shows_bars_where_it_can(monkeypatch, capsys) -> None:
    """rich warns in a notebook without ipywidgets, and shows nothing."""
    assert isinstance(progress_in_python(), LineProgress)
    with monkeypatch.context() as patch:
        patch.setattr(Console, "is_terminal", True)
        assert isinstance(progress_in_python(), TerminalProgress)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    for module, kind in ((None, LineProgress), (ModuleType("ipywidgets"), TerminalProgress)):
        if module is not None:
            module.__spec__ = ModuleSpec("ipywidgets", None)
        monkeypatch.setitem(sys.modules, "ipywidgets", module)
        assert isinstance(progress_in_python(), kind)
    with LineProgress() as progress:
        progress.stage("tracking", 2)
        progress.note("words")
    assert re.fullmatch(r" +0\.\d s  tracking\nnote: words\n", capsys.readouterr().err)


def test_json_progress_reports_events(capsys) -> None:
    with JsonProgress() as progress:
        progress.stage("tracking", 2)
        progress.advance(FrameRecord(4, 0.0, "tracked", inlier_share=0.912345))
        progress.advance(FrameRecord(6, 0.1, "lost", "why", inlier_share=float("nan")))
        progress.stage("fusing", 3)
        progress.advance()
        progress.note("words")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["event"] for line in lines] == ["stage", "frame", "frame", "stage", "note"]
    first, last = lines[1:3]
    assert (first["index"], first["status"], first["inlier_share"]) == (4, "tracked", 0.9123)
    assert (first["done"], first["total"], last["done"]) == (1, 2, 2)
    assert last["per_second"] > 0
    assert (last["seconds_left"], last["inlier_share"], last["reason"]) == (0, None, "why")


def test_terminal_says_that_kernels_are_compiled() -> None:
    shown = []

    class Recording(TerminalProgress):
        def notify(self, event) -> None:
            super().notify(event)
            shown.extend(task.fields["health"] for task in self._bar.tasks)

    with Recording(io.StringIO()) as progress:
        progress.stage("opening")
        numba.njit(lambda x: x + 1)(1)
    numba.njit(lambda x: x + 2)(1)
    assert shown == ["compiling kernels", ""]


_SHOW = """
import time
from tofuse.apps.cli.progress import progress_for
from tofuse.engine.results.types import FrameRecord
with progress_for(as_json=False) as progress:
    progress.stage("tracking", 40)
    progress.note("read [this]")
    for k in range(40):
        time.sleep(0.01)
        progress.advance(FrameRecord(k, 0.0, "lost" if k == 5 else "tracked", inlier_share=0.93))
    progress.stage("refining")
    time.sleep(0.2)
print("done")
"""


@pytest.mark.nightly_part
@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX terminal")
@pytest.mark.parametrize("columns", [50, 100])
def test_terminal_shows_stages_and_is_cleared_at_end(columns: int) -> None:
    import pty

    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": str(columns)}
    job = subprocess.Popen(
        [sys.executable, "-c", _SHOW], stdout=theirs, stderr=theirs, env=environment
    )
    os.close(theirs)
    data, deadline = b"", time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            chunk = os.read(ours, 65536)
        except OSError:  # raised by Linux when the other end is closed
            break
        if not chunk:
            break
        data += chunk
    os.close(ours)
    assert job.wait(60) == 0
    text = data.decode()
    words = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
    lines = [line.rstrip() for line in re.split(r"[\r\n]+", words)]
    assert max(map(len, lines)) <= columns
    assert any("note: read [this]" in line for line in lines)
    assert any(re.match(r"  tracking .*\d+/40", line) for line in lines)
    assert any(re.match(r"\u2713 tracking ", line) for line in lines)
    assert any(line.startswith("  refining") for line in lines)
    health = "93 % inliers, 1 without a pose" if columns == 100 else "93 %"
    time_left = r"\d+:\d+ +" if columns == 100 else ""  # left out where it is narrow
    pattern = rf"\d/40 +{time_left}{health}"
    assert any(re.search(pattern, line) for line in lines), lines
    # The display is erased line by line before the final output.
    assert lines[-2:] == ["done", ""] or lines[-1] == "done"
    assert re.search(r"\x1b\[2K[^a-zA-Z0-9]*done", text)
