"""Progress of a job on a terminal, as JSON lines, or as lines or notes in a log."""

from __future__ import annotations

import importlib.util
import json
import math
import sys
import time
from types import TracebackType
from typing import Any, Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

from tofuse.engine.progress import Silent
from tofuse.engine.quantities import percent
from tofuse.engine.results import FrameRecord

_GOOD_FRACTION = 0.8  # inliers
_MIN_BAR_COLUMNS = 92  # minimum width of a terminal for a bar


class Health:
    """The state of tracking in a few words."""

    def __init__(self) -> None:
        self._without = 0  # frames without a pose
        self._consecutive = 0  # of these, the last ones

    def after(self, record: FrameRecord) -> str:
        """Return the words after the next frame, with rich's markup."""
        missing = record.status in ("lost", "skipped")
        self._without += missing
        self._consecutive = self._consecutive + 1 if missing else 0
        inliers = 1.0 if record.inlier_share is None else record.inlier_share
        words, color = {
            "lost": (f"lost for {self._consecutive} frame{'s'[: self._consecutive > 1]}", "red"),
            "skipped": ("unreadable", "yellow"),
            "predicted": ("predicting", "yellow"),
        }.get(
            record.status,
            (
                "tracking" if record.inlier_share is None else f"{percent(inliers)} inliers",
                "green" if inliers >= _GOOD_FRACTION else "yellow",
            ),
        )
        suffix = f", {self._without} without a pose" if self._without > self._consecutive else ""
        return f"[{color}]{words}[/]{suffix}"


class _Context(Silent):
    """Progress as a context manager, which has nothing to clean up by default."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        """Nothing to clean up."""


class TerminalProgress(Silent):
    """The stages on a terminal: finished ones with their times, and a bar for the current one.

    It disappears when the job is done, to make space for the summary.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._console = Console(file=stream or sys.stderr, highlight=False)
        self._check_mark = "[green]\u2713[/]" if self._console.encoding.startswith("utf") else "+"
        has_bar = self._console.width >= _MIN_BAR_COLUMNS
        self._bar = Progress(
            TextColumn("{task.fields[mark]} {task.description}", table_column=_one_line(15)),
            *([BarColumn(bar_width=20)] if has_bar else []),
            TextColumn("{task.fields[count]}", justify="right", table_column=_one_line(9)),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[health]}", table_column=_one_line(8)),
            console=self._console,
            transient=True,
        )
        self._health = Health()

    def __enter__(self) -> Self:
        self._bar.start()
        _listen("register", self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        _listen("unregister", self)
        self._bar.stop()

    def notify(self, event: Any) -> None:
        """Show that a kernel is being compiled; called by Numba when it begins and ends."""
        for task in self._bar.tasks[-1:]:
            self._bar.update(task.id, health="compiling kernels" if event.is_start else "")

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage."""
        for task in self._bar.tasks[-1:]:
            steps = task.completed or 1
            self._bar.update(task.id, mark=self._check_mark, total=steps, completed=steps)
        self._health = Health()
        count = f"0/{total}" if total else ""
        self._bar.add_task(name, total=total or None, mark=" ", count=count, health="")

    def advance(self, record: FrameRecord | None = None) -> None:
        """Finish one step."""
        for task in self._bar.tasks[-1:]:
            done = int(task.completed) + 1
            count = f"{done}/{task.total}" if task.total else f"{done}"
            if record is not None:
                self._bar.update(task.id, health=self._health.after(record))
            self._bar.update(task.id, advance=1, count=count)

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._console.print(f"[yellow]note:[/] {escaped(text)}")


class JsonProgress(_Context):
    """JSON lines on standard output, for programs."""

    def __init__(self) -> None:
        self._pace = Progress(disable=True)
        self._pace.add_task("")

    def stage(self, name: str, total: int | None = None) -> None:
        """Print the stage."""
        self._pace.add_task(name, total=total or None)
        emit({"event": "stage", "stage": name, "total": total})

    def advance(self, record: FrameRecord | None = None) -> None:
        """Print the outcome of a frame, and the progress of the stage."""
        task = self._pace.tasks[-1]
        self._pace.advance(task.id)
        if record is None:
            return
        emit(
            {
                "event": "frame",
                "index": record.index,
                "status": record.status,
                "reason": record.reason,
                "inlier_share": _rounded(record.inlier_share, 4),
                "done": int(task.completed),
                "total": task.total,
                "per_second": _rounded(task.finished_speed or task.speed, 3),
                "seconds_left": _rounded(task.time_remaining, 2),
            }
        )

    def note(self, text: str) -> None:
        """Print a note."""
        emit({"event": "note", "text": text})


class QuietProgress(_Context):
    """Only notes on standard error, for logs and pipes.

    They are printed after a job that succeeded: one that fails prints only its error.
    """

    def __init__(self) -> None:
        self._notes: list[str] = []

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        if kind is None:
            for text in self._notes:
                print(f"note: {text}", file=sys.stderr)

    def note(self, text: str) -> None:
        """Keep the note for the end."""
        self._notes.append(text)


class LineProgress(_Context):
    """A line on standard error for each stage, with the time since the start."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def stage(self, name: str, total: int | None = None) -> None:
        """Print the stage."""
        seconds = time.monotonic() - self._start
        print(f"{seconds:6.1f} s  {name}", file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        """Print a note."""
        print(f"note: {text}", file=sys.stderr, flush=True)


def _listen(action: str, listener: TerminalProgress) -> None:
    """Register or unregister for the compilation of kernels, where Numba is in use."""
    if numba_event := sys.modules.get("numba.core.event"):
        numba_event.Listener.register(TerminalProgress)
        getattr(numba_event, action)("numba:compile", listener)


def progress_for(*, as_json: bool) -> TerminalProgress | JsonProgress | QuietProgress:
    """Return the progress for JSON, a terminal, or a log."""
    if as_json:
        return JsonProgress()
    return TerminalProgress() if sys.stderr.isatty() else QuietProgress()


def progress_in_python() -> TerminalProgress | LineProgress:
    """Return bars on a terminal or in a notebook that can show them, and else lines."""
    console = Console(file=sys.stderr)
    in_notebook = console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None
    return TerminalProgress() if console.is_terminal or in_notebook else LineProgress()


def emit(data: dict[str, Any]) -> None:
    """Print one JSON line, and flush it."""
    print(json.dumps(data, allow_nan=False), flush=True)


def _one_line(width: int) -> Column:
    """A column of one line with a minimum width, as long as others can be narrower."""
    return Column(min_width=width, no_wrap=True, overflow="ellipsis")


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), digits)


def escaped(text: str) -> str:
    """Return text for rich, whose markup begins with a bracket."""
    return text.replace("[", r"\[")
