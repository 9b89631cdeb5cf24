"""Wall and CPU time of the stages of a job.

A job starts a `Stopwatch`; whatever it calls on the same thread counts its own time as that of a
stage with `timing`. The CPU time of a stage is that of all threads meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from time import perf_counter, process_time


@dataclass
class Stopwatch:
    """Times of each stage in s, summed over its blocks; a stage inside another is not part of it.

    Attributes
    ----------
    seconds, cpu_seconds
        Wall and CPU time by stage, until the last time a stage began or ended.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._stages: list[str] = []
        self._last = perf_counter(), process_time()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Make this the stopwatch of the current thread during the block."""
        token = _running.set(self)
        try:
            yield
        finally:
            _running.reset(token)

    def begin(self, stage: str) -> None:
        """Count the time from now on as that of a stage."""
        self._lap()
        self._stages.append(stage)

    def end(self) -> None:
        """Return to the stage in which the present one began."""
        self._lap()
        self._stages.pop()

    def _lap(self) -> None:
        now = perf_counter(), process_time()
        if self._stages:
            stage = self._stages[-1]
            for times, a, b in zip((self.seconds, self.cpu_seconds), self._last, now, strict=True):
                times[stage] = times.get(stage, 0.0) + b - a
        self._last = now


_running: ContextVar[Stopwatch | None] = ContextVar("stopwatch", default=None)


def current() -> Stopwatch:
    """Return the stopwatch of this thread, or a new one if none is running."""
    return _running.get() or Stopwatch()


@contextmanager
def timing(stage: str) -> Iterator[None]:
    """Count the time of the block as that of a stage, if a stopwatch of this thread is running."""
    watch = _running.get()
    if watch is None:
        yield
        return
    watch.begin(stage)
    try:
        yield
    finally:
        watch.end()
