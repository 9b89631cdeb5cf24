"""Where the time of a process goes, from its start to its end: ``tofuse run --profile``."""

from __future__ import annotations

import atexit
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import get_ident
from typing import Any, cast

from numba.core import event as numba_event
from rich.console import Console
from rich.table import Table

from tofuse.engine.stopwatch import Stopwatch

_KERNELS = "numba:compiler_lock"  # an event of each kernel that is compiled or loaded


class _KernelTimes(numba_event.Listener):
    """Counts compiling and loading kernels, and waiting for threads that do, as a stage."""

    def __init__(self, watch: Stopwatch) -> None:
        self._watch, self._thread = watch, get_ident()

    def on_start(self, event: object) -> None:
        """See `Listener`."""
        if get_ident() == self._thread:
            self._watch.begin("kernels")

    def on_end(self, event: object) -> None:
        """See `Listener`."""
        if get_ident() == self._thread:
            self._watch.end()


@contextmanager
def process_watch() -> Iterator[Stopwatch]:
    """Run a stopwatch of this process; what is in no stage of its own is "other"."""
    watch = Stopwatch({"starting": _age_s()}, {"starting": time.process_time()})
    watch.begin("other")
    listener, events = _KernelTimes(watch), cast(Any, numba_event)
    events.register(_KERNELS, listener)
    try:
        with watch.running():
            yield watch
    finally:
        events.unregister(_KERNELS, listener)


def _age_s() -> float:
    """Wall time since this process began; where that is not known its CPU time, which is less."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        started_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - started_s
    except (OSError, AttributeError):  # not on Linux
        return time.process_time()


def print_at_exit(watch: Stopwatch, frames: int, threads: int) -> None:
    """Print the table when the process ends: what is left to do is the stage "exit"."""
    watch.begin("exit")

    def finish() -> None:
        watch.end()
        Console(file=sys.stderr, highlight=False).print(table(watch, frames, threads))

    atexit.register(finish)


def table(watch: Stopwatch, frames: int, threads: int) -> Table:
    """Return wall and CPU time of each stage, and how busy it kept the threads."""
    made = Table("stage", *("s", "%", "ms/frame", "CPU s", "busy %"), box=None, pad_edge=False)
    for column in made.columns[1:]:
        column.justify = "right"
    total, total_cpu = sum(watch.seconds.values()), sum(watch.cpu_seconds.values())
    rows = [(stage, s, watch.cpu_seconds[stage]) for stage, s in watch.seconds.items()]
    for stage, s, cpu in [*rows, (f"all, {threads} threads", total, total_cpu)]:
        busy = 100 * cpu / max(threads * s, 1e-9)
        numbers = (f"{s:.2f}", f"{100 * s / total:.1f}", f"{1e3 * s / max(frames, 1):.2f}")
        made.add_row(stage, *numbers, f"{cpu:.2f}", f"{busy:.0f}")
    return made
