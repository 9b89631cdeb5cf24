"""Jobs that nobody waits for: done in order, on another thread, and never many at once."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from tofuse.kernels.threads import job_pool, thread_count

# What waits to be done holds on to frames.
_MOST = 4


class Behind:
    """Does jobs in the order in which they come, beside what comes next.

    With one thread they are done at once. An error is raised by one of the next calls.
    """

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._jobs: deque[Future[None]] = deque()

    def do(self, job: Callable[[], None]) -> None:
        """Do a job, soon; waits where several are under way."""
        if thread_count() == 1:
            self.wait()
            job()
            return
        if self._pool is None:
            self._pool = job_pool(1, "tofuse-behind")
        self._jobs.append(self._pool.submit(job))
        while len(self._jobs) > _MOST:
            self._jobs.popleft().result()

    def wait(self) -> None:
        """Wait until all is done."""
        while self._jobs:
            self._jobs.popleft().result()

    def finish(self) -> None:
        """Wait until all is done, and let the thread go."""
        self.wait()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None

    def __getstate__(self) -> dict[str, Any]:
        """As it begins, once all is done: the jobs changed what others hold."""
        self.wait()
        return {"_pool": None, "_jobs": deque()}
