"""Loops that are closed while frames arrive: later than the frame, but always equally late."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from tofuse.kernels.threads import side_threads
from tofuse.posegraph.loops import ClosedLoop, Loops

# A job begins at one frame and counts this many frames later, however soon it was done: the poses
# are then the same on every machine. A slow machine waits there.
DELAY = 10


class LiveLoops:
    """Looks for loops on another thread.

    Attributes
    ----------
    closed
        Accepted loops that count already.
    """

    def __init__(self, loops: Loops) -> None:
        self.closed: list[ClosedLoop] = []
        self._loops = loops
        self._pool: ThreadPoolExecutor | None = None
        self._job: Future[list[ClosedLoop]] | None = None
        self._frames = 0
        self._due = 0

    def step(self) -> bool:
        """Go on by a frame with a pose, already known to the loops; True if new loops count now."""
        self._frames += 1
        found: list[ClosedLoop] = []
        if self._job is not None and self._frames >= self._due:
            found = [loop for loop in self._job.result() if loop.T_i_j is not None]
            self.closed += found
            self._job = None
        if self._job is None:
            work = self._loops.look()
            if work is not None:
                if self._pool is None:
                    self._pool = side_threads(1, "tofuse-loops")
                self._job = self._pool.submit(work)
                self._due = self._frames + DELAY
        return bool(found)

    def wait(self) -> None:
        """Wait for the job that is under way; what it found counts when it is due."""
        if self._job is not None:
            self._job.result()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the thread, with what the job found."""
        found = None if self._job is None else self._job.result()
        return {**self.__dict__, "_pool": None, "_job": found}

    def __setstate__(self, state: dict[str, Any]) -> None:
        found = state["_job"]
        self.__dict__.update(state)
        if found is not None:
            self._job = Future()
            self._job.set_result(found)

    def finish(self) -> None:
        """Wait for the job that is under way, and let the thread go."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool, self._job = None, None
