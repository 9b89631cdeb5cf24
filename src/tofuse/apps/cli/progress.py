"""Progress of a job on a terminal, as JSON lines, or as notes in a log."""

from __future__ import annotations

import json
import math
import sys
from collections import deque
from collections.abc import Callable
from time import perf_counter
from types import TracebackType
from typing import Any, Literal, Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Column

from tofuse.engine.progress import Silent
from tofuse.engine.results import FrameRecord

_WINDOW = 30  # steps from whose rate the remaining time is estimated
_GOOD_FRACTION = 0.8  # inliers
_MIN_BAR_COLUMNS = 92  # minimum width of a terminal for a bar


class Pace:
    """The rate of a stage over its last steps; the first ones include compilation and loading."""

    def __init__(self, total: int | None = None, clock: Callable[[], float] = perf_counter) -> None:
        self.done, self.total = 0, total or None
        self._clock = clock
        self._start = clock()
        self._times = deque([self._start], maxlen=_WINDOW)

    def step(self) -> None:
        """Count a step as done."""
        self.done += 1
        self._times.append(self._clock())

    @property
    def seconds(self) -> float:
        """Time since the stage began."""
        return self._clock() - self._start

    @property
    def per_second(self) -> float | None:
        """Steps per second; None before the first."""
        elapsed = self._times[-1] - self._times[0]
        return (len(self._times) - 1) / max(elapsed, 1e-3) if self.done else None

    @property
    def seconds_left(self) -> float | None:
        """Estimated time until the stage is done; None where unknown."""
        rate = self.per_second
        if rate is None or self.total is None:
            return None
        return max(0, self.total - self.done) / rate


class Health:
    """The state of tracking in a few words."""

    def __init__(self) -> None:
        self._without = 0  # frames without a pose
        self._consecutive = 0  # of these, the last ones
        self._words, self._color = "", "green"

    def update(self, record: FrameRecord) -> None:
        """Take the outcome of the next frame."""
        missing = record.status in ("lost", "skipped")
        self._without += missing
        self._consecutive = self._consecutive + 1 if missing else 0
        if record.status == "lost":
            self._words, self._color = f"lost for {_frames(self._consecutive)}", "red"
        elif record.status == "skipped":
            self._words, self._color = "unreadable", "yellow"
        elif record.status == "predicted":
            self._words, self._color = "predicting", "yellow"
        else:
            inliers = record.inlier_share
            self._words = "tracking" if inliers is None else f"{inliers:.0%} inliers"
            self._color = "green" if inliers is None or inliers >= _GOOD_FRACTION else "yellow"

    @property
    def markup(self) -> str:
        """The words, with rich's markup."""
        if not self._words:
            return ""
        suffix = f", {self._without} without a pose" if self._without > self._consecutive else ""
        return f"[{self._color}]{self._words}[/]{suffix}"


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
            _column("{task.fields[mark]} {task.description}", 15),
            *([BarColumn(bar_width=20)] if has_bar else []),
            _column("{task.fields[count]}", 9, "right"),
            _column("{task.fields[pace]}", 19),
            _column("{task.fields[health]}", 8),
            console=self._console,
            transient=True,
        )
        self._task: TaskID | None = None
        self._pace = Pace()
        self._health = Health()

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
            steps = self._pace.done or 1
            self._bar.update(
                self._task,
                mark=self._check_mark,
                total=steps,
                completed=steps,
                count=f"{self._pace.done}" if self._pace.done else "",
                pace=f"{_duration(self._pace.seconds)}",
            )
        self._pace, self._health = Pace(total), Health()
        count = f"0/{total}" if total else ""
        self._task = self._bar.add_task(
            name, total=total or None, mark=" ", count=count, pace="", health=""
        )

    def advance(self, record: FrameRecord | None = None) -> None:
        """Finish one step."""
        if self._task is None:
            return
        pace = self._pace
        pace.step()
        words = f"{pace.per_second:.1f}/s" if pace.per_second else ""
        if pace.seconds_left is not None:
            words += f", {_duration(pace.seconds_left)} left"
        if record is not None:
            self._health.update(record)
        count = f"{pace.done}/{pace.total}" if pace.total else f"{pace.done}"
        self._bar.update(self._task, advance=1, count=count, pace=words, health=self._health.markup)

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._console.print(f"[yellow]note:[/] {escaped(text)}")


class JsonProgress(_Context):
    """JSON lines on standard output, for programs."""

    def __init__(self) -> None:
        self._pace = Pace()

    def stage(self, name: str, total: int | None = None) -> None:
        """Print the stage."""
        self._pace = Pace(total)
        emit({"event": "stage", "stage": name, "total": total})

    def advance(self, record: FrameRecord | None = None) -> None:
        """Print the outcome of a frame, and the progress of the stage."""
        self._pace.step()
        if record is None:
            return
        emit(
            {
                "event": "frame",
                "index": record.index,
                "status": record.status,
                "reason": record.reason,
                "inlier_share": _rounded(record.inlier_share, 4),
                "done": self._pace.done,
                "total": self._pace.total,
                "per_second": _rounded(self._pace.per_second, 3),
                "seconds_left": _rounded(self._pace.seconds_left, 2),
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


def progress_for(*, as_json: bool) -> TerminalProgress | JsonProgress | QuietProgress:
    """Return the progress for JSON, a terminal, or a log."""
    if as_json:
        return JsonProgress()
    return TerminalProgress() if sys.stderr.isatty() else QuietProgress()


def emit(data: dict[str, Any]) -> None:
    """Print one JSON line, and flush it."""
    print(json.dumps(data, allow_nan=False), flush=True)


def _column(text: str, width: int, justify: Literal["left", "right"] = "left") -> TextColumn:
    """A column of one line with a minimum width, as long as others can be narrower."""
    column = Column(min_width=width, no_wrap=True, overflow="ellipsis")
    return TextColumn(text, justify=justify, table_column=column)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), digits)


def _frames(count: int) -> str:
    return f"{count} frame{'' if count == 1 else 's'}"


def _duration(seconds: float) -> str:
    """A duration in few characters: 0.4 s, 12 s, 3:07, 1:02:45."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    total = round(seconds)
    if total < 60:
        return f"{total} s"
    minutes, remainder = divmod(total, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{remainder:02}" if hours else f"{minutes}:{remainder:02}"


def escaped(text: str) -> str:
    """Return text for rich, whose markup begins with a bracket."""
    return text.replace("[", r"\[")
