"""What a person or a program sees while a job runs."""

from __future__ import annotations

import json
import sys
from time import perf_counter
from types import TracebackType
from typing import Any, Self, TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from tofuse.results.types import FrameRecord


class TerminalProgress:
    """A progress bar on a terminal, with frames a second and how tracking goes."""

    def __init__(self, stream: TextIO = sys.stderr) -> None:
        self._console = Console(file=stream, highlight=False)
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description:<13}"),
            BarColumn(bar_width=28),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[health]}"),
            console=self._console,
            transient=True,
        )
        self._task: TaskID | None = None
        self._start = 0.0
        self._done = 0
        self._lost = 0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage."""
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = self._bar.add_task(name, total=total or None, rate="", health="")
        self._start, self._done, self._lost = perf_counter(), 0, 0

    def advance(self, record: FrameRecord | None = None) -> None:
        """Finish one step."""
        if self._task is None:
            return
        self._done += 1
        rate = f"{self._done / max(perf_counter() - self._start, 1e-3):.1f}/s"
        health = ""
        if record is not None:
            self._lost += record.status in ("lost", "skipped")
            health = f"[red]{self._lost} without a pose" if self._lost else "[green]tracking"
        self._bar.update(self._task, advance=1, rate=rate, health=health)

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._console.print(f"[yellow]note:[/] {_escaped(text)}")


class JsonProgress:
    """JSON lines on standard output, for programs."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        """Nothing to put away."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Tell the stage."""
        emit({"event": "stage", "stage": name, "total": total})

    def advance(self, record: FrameRecord | None = None) -> None:
        """Tell what became of a frame."""
        if record is not None:
            emit(
                {
                    "event": "frame",
                    "index": record.index,
                    "status": record.status,
                    "reason": record.reason,
                }
            )

    def note(self, text: str) -> None:
        """Tell a warning."""
        emit({"event": "note", "text": text})


class QuietProgress:
    """Notes on standard error and nothing else, for logs and pipes.

    They come at the end of a job that succeeded: one that fails says its one line alone.
    """

    def __init__(self) -> None:
        self._notes: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        if kind is None:
            for text in self._notes:
                print(f"note: {text}", file=sys.stderr)

    def stage(self, name: str, total: int | None = None) -> None:
        """Say nothing."""

    def advance(self, record: FrameRecord | None = None) -> None:
        """Say nothing."""

    def note(self, text: str) -> None:
        """Keep the note for the end."""
        self._notes.append(text)


def progress_for(*, as_json: bool) -> TerminalProgress | JsonProgress | QuietProgress:
    """Choose by who is looking: a program, a terminal, or a log."""
    if as_json:
        return JsonProgress()
    return TerminalProgress() if sys.stderr.isatty() else QuietProgress()


def emit(data: dict[str, Any]) -> None:
    """Print one JSON line at once."""
    print(json.dumps(data, allow_nan=False), flush=True)


def _escaped(text: str) -> str:
    return text.replace("[", r"\[")
