"""Workers that run the jobs: a protocol, and the processes of this machine."""

from __future__ import annotations

import subprocess
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

from tofuse.apps.batch.folder import Record
from tofuse.apps.batch.work import Task, work
from tofuse.engine.errors import InputError


class Workers(Protocol):
    """Runs tasks, several at a time."""

    def accepts(self) -> bool:
        """Whether a task would be started at once."""
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
        """Run up to `count` jobs at a time."""
        self._count = count
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="tofuse-batch")
        self._running: set[Future[Record]] = set()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._closed = False

    def accepts(self) -> bool:
        """See `Workers`."""
        self._running = {f for f in self._running if not f.done()}
        return len(self._running) < self._count

    def start(self, task: Task) -> Future[Record]:
        """See `Workers`."""
        future = self._pool.submit(work, task, self._register_process)
        self._running.add(future)
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
