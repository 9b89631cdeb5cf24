"""Workers that run the jobs: a protocol, and the processes of this machine."""

from __future__ import annotations

import subprocess
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

from tofuse.apps.batch.folder import Record
from tofuse.apps.batch.work import Task, work
from tofuse.engine.errors import InputError


class Workers(Protocol):
    """Runs tasks, several at a time, in the order in which they are started."""

    def start(self, task: Task) -> Future[Record]:
        """Start a task as soon as possible.

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
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="tofuse-batch")
        self._processes: list[subprocess.Popen[bytes]] = []
        self._closed = False

    def start(self, task: Task) -> Future[Record]:
        """See `Workers`."""
        return self._pool.submit(work, task, self._register_process)

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
