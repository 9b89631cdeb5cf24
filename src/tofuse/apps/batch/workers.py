"""Workers that run the jobs: a protocol, and the processes of this machine."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from tofuse.apps.batch.folder import Record
from tofuse.apps.batch.jobs import Job
from tofuse.apps.batch.work import Task, work
from tofuse.engine.errors import InputError


class Workers(Protocol):
    """Runs tasks, several at a time."""

    def check(self, job: Job) -> None:
        """Raise an `InputError` if no worker could ever run this job."""
        ...

    def accepts(self, task: Task) -> bool:
        """Whether the task would be started at once."""
        ...

    def start(self, task: Task) -> Future[Record]:
        """Start a task.

        The future is cancelled if the workers are lost; else it returns the record of the job,
        `killed` if its worker was.
        """
        ...

    def lost(self) -> InputError | None:
        """Return the error if no worker can be reached any more; else None."""
        ...

    def close(self) -> None:
        """Start nothing more, and stop jobs that would otherwise continue unattended."""
        ...


class LocalWorkers(Workers):
    """Processes of this machine."""

    def __init__(self, count: int) -> None:
        """Run up to `count` jobs at a time, as long as the memory that they need is available."""
        self._count = count
        self._memory = machine_memory()
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="tofuse-batch")
        self._running: dict[Future[Record], int] = {}
        self._processes: list[subprocess.Popen[bytes]] = []
        self._closed = False

    def check(self, job: Job) -> None:
        """See `Workers`."""
        if self._memory is not None and (job.memory or 0) > self._memory:
            raise InputError(
                f"{job.name} needs {job.memory} bytes, but this machine has {self._memory}",
                where="--memory",
                remedy="state less, or use a larger machine",
            )

    def accepts(self, task: Task) -> bool:
        """See `Workers`."""
        self._running = {f: m for f, m in self._running.items() if not f.done()}
        needed = sum(self._running.values()) + (task.job.memory or 0)
        fits = self._memory is None or needed <= self._memory
        return len(self._running) < self._count and fits

    def start(self, task: Task) -> Future[Record]:
        """See `Workers`."""
        future = self._pool.submit(work, task, self._register_process)
        self._running[future] = task.job.memory or 0
        return future

    def lost(self) -> None:
        """See `Workers`."""
        return

    def close(self) -> None:
        """See `Workers`."""
        self._closed = True
        for process in self._processes:
            process.kill()
        self._pool.shutdown(cancel_futures=True)

    def _register_process(self, process: subprocess.Popen[bytes]) -> None:
        self._processes = [p for p in self._processes if p.returncode is None]
        self._processes.append(process)
        if self._closed:
            process.kill()


def machine_memory() -> int | None:
    """Return the memory limit of this process in bytes; None if unknown."""
    if sys.platform == "win32":
        return None
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:  # of a container
        return min(physical, int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    except (OSError, ValueError):
        return physical
