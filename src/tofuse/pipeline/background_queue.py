"""A bounded queue of jobs that run in order on a background thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from tofuse.kernels.threads import job_pool, thread_count

# Bounds memory, as waiting jobs reference frames.
_MAX_WAITING = 4


class BackgroundQueue:
    """Runs jobs in order on a background thread; with a single thread, immediately.

    An error of a job is raised by one of the next calls.
    """

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._jobs: deque[Future[None]] = deque()

    def submit(self, job: Callable[[], None]) -> None:
        """Queue a job; waits while the queue is full."""
        if thread_count() == 1:
            self.wait()
            job()
            return
        if self._pool is None:
            self._pool = job_pool(1, "tofuse-behind")
        self._jobs.append(self._pool.submit(job))
        while len(self._jobs) > _MAX_WAITING:
            self._jobs.popleft().result()

    def wait(self) -> None:
        """Wait for all jobs."""
        while self._jobs:
            self._jobs.popleft().result()

    def finish(self) -> None:
        """Wait for all jobs, and end the thread."""
        self.wait()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None
