"""Distribution of one run's work to the workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import platform
from collections import deque
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Any, TypeVar, cast

from threadpoolctl import threadpool_limits

from tofuse._version import __version__
from tofuse.batch.client import TIMEOUT_S, cannot_deserialize, connect, first_line
from tofuse.errors import InputError
from tofuse.kernels.executors import Arguments, Executor, LocalExecutor
from tofuse.kernels.threads import serial_chunks

R = TypeVar("R")

_POLL_S = 1.0  # interval at which the scheduler and its workers are checked
_CHUNK = 4  # small pieces per task: each takes a fraction of a second
_TASKS_PER_THREAD = 2  # so that the next one is present when one is done
_MAX_ATTEMPTS = 3  # to submit a piece, before it is done locally, and to reach a busy scheduler

# Packages whose version influences results.
_PACKAGES = ("numpy", "scipy", "numba")
_FALLBACK = "the rest of the run is done on this machine"


class DaskExecutor(Executor):
    """Sends pieces of work to a cluster: each thread of its workers does one at a time.

    The data of the views is sent with the pieces, so that workers need no access to files. Pieces
    that the cluster does not return, because workers die or the scheduler disappears, are done
    locally.

    Parameters
    ----------
    address
        Address of the scheduler, or the file that it wrote.
    notify
        Called with one line of text if the cluster is abandoned.

    Attributes
    ----------
    n_remote
        Number of pieces that the cluster has done.

    Raises
    ------
    InputError
        If Dask is not installed, no scheduler answers, or a worker has another version of tofuse.
    """

    def __init__(self, address: str, notify: Callable[[str], None]) -> None:
        self._address, self._notify = address, notify
        self._client: Any = connect(address, "leave it out")
        self._abandoned = False
        self._polled_at, self._threads, self._unanswered = -_POLL_S, 0, 0
        self.n_remote = 0
        try:
            self._check_workers()
        except BaseException:
            self.close()
            raise

    def map(
        self, function: Callable[..., R], count: int, arguments: Arguments, *, large: bool = False
    ) -> list[R]:
        """See `Executor.map`."""
        results: dict[int, R] = {}
        if not self._abandoned:
            chunk = 1 if large else _CHUNK
            parts = [range(a, min(a + chunk, count)) for a in range(0, count, chunk)]
            results = self._run_on_cluster(
                function, parts, arguments, 1 if large else _TASKS_PER_THREAD
            )
            self.n_remote += len(results)
        remaining = [k for k in range(count) if k not in results]
        # An error of a piece is raised here as well.
        local_results = LocalExecutor().map(
            function, len(remaining), lambda k: arguments(remaining[k]), large=large
        )
        results |= dict(zip(remaining, local_results, strict=True))
        return [results[k] for k in range(count)]

    def close(self) -> None:
        """Disconnect from the cluster."""
        self._client.close(timeout=TIMEOUT_S)

    def _run_on_cluster(
        self,
        function: Callable[..., R],
        parts: list[range],
        arguments: Arguments,
        tasks_per_thread: int,
    ) -> dict[int, R]:
        """The results that the cluster returns, by number of the piece."""
        results: dict[int, R] = {}
        queue = deque((k, 1) for k in range(len(parts)))
        running: dict[int, tuple[int, Any]] = {}
        finished: SimpleQueue[int] = SimpleQueue()
        while queue or running:
            slots = tasks_per_thread * self._slots()
            if not slots:
                self._abandon()
                break
            try:
                while queue and len(running) < slots:
                    part, attempt = queue.popleft()
                    future = self._submit(function, [arguments(k) for k in parts[part]])
                    running[part] = attempt, future
                    future.add_done_callback(lambda _, part=part: finished.put(part))
                part = finished.get(timeout=_POLL_S)
            except Empty:
                continue
            except _DISCONNECTED:
                if self._client.status == "running" and attempt < _MAX_ATTEMPTS:  # it is busy
                    queue.appendleft((part, attempt + 1))
                    continue
                self._abandon()
                break
            attempt, future = running.pop(part)
            if future.status == "finished":
                values = self._result(future)
                results |= dict(zip(parts[part], values, strict=True)) if values else {}
            elif future.status == "error":
                self._abandon(f"a worker failed ({self._error(future)})")
                break
            elif attempt < _MAX_ATTEMPTS:  # its worker died with its arguments
                queue.append((part, attempt + 1))
        return results

    def _submit(self, function: Callable[..., R], pieces: list[tuple[Any, ...]]) -> Any:
        """A future of the results of pieces."""
        # Arguments go to a worker, and not into the scheduler's memory.
        (remote_pieces,) = self._client.scatter([pieces], hash=False)
        return self._client.submit(_run_pieces, function, remote_pieces, _environment(), pure=False)

    def _result(self, future: Any) -> list[Any] | None:
        """The result of a future; None if it was lost with its worker."""
        try:
            return cast("list[Any]", future.result(timeout=TIMEOUT_S))
        except Exception:  # of any kind: the piece is done locally
            return None

    def _error(self, future: Any) -> str:
        error = future.exception(timeout=TIMEOUT_S)
        return first_line(error)

    def _slots(self) -> int:
        """The number of pieces that the workers can do at a time; 0 without workers."""
        if self._client.status != "running":
            return 0
        if monotonic() - self._polled_at >= _POLL_S:
            try:
                workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
            except OSError:  # a busy scheduler may answer the next request
                self._unanswered += 1
                return self._threads if self._unanswered < _MAX_ATTEMPTS else 0
            self._unanswered = 0
            self._polled_at, self._threads = monotonic(), sum(int(w["nthreads"]) for w in workers)
        return self._threads

    def _abandon(self, problem: str = "") -> None:
        self._abandoned = True
        disconnected = self._client.status != "running"
        problem = problem or (
            "the scheduler " + ("disappeared" if disconnected else "has no workers")
        )
        self._notify(f"{self._address}: {problem}; {_FALLBACK}")

    def _check_workers(self) -> None:
        """Refuse workers that would give different results."""
        with contextlib.suppress(OSError):  # without any, the run is done on this machine
            self._client.wait_for_workers(1, timeout=TIMEOUT_S)
        try:
            environments = self._client.run(_environment)
        except Exception as error:
            if not cannot_deserialize(error) and not isinstance(error, _DISCONNECTED):
                raise
            environments = {self._address: ("no tofuse",)}
        for worker, environment in environments.items():
            for local, remote in zip(_environment(), environment, strict=False):
                if local != remote:
                    raise InputError(
                        f"a worker has {remote}, but this machine has {local}",
                        where=str(worker),
                        remedy="results would differ: install the same versions there",
                    )
        self._threads = len(environments)  # at least, until the scheduler is asked


# Errors if a cluster disappears between two requests.
_DISCONNECTED = (OSError, RuntimeError, ValueError)


@cache
def _environment() -> tuple[str, ...]:
    """Versions and platform: what determines the bytes of a result, apart from its input."""
    packages = [f"{name} {version(name)}" for name in _PACKAGES]
    return f"tofuse {__version__}", *packages, platform.machine()


def _run_pieces(
    function: Callable[..., R], pieces: list[tuple[Any, ...]], environment: tuple[str, ...]
) -> list[R]:
    """Do pieces in the process of a worker."""
    if environment != _environment():  # the worker joined after the check
        raise InputError("a worker has another version", where=platform.node())
    _one_blas_thread()
    with serial_chunks():  # the other threads of the worker do other pieces
        return [function(*arguments) for arguments in pieces]


@cache
def _one_blas_thread() -> None:
    """Limit BLAS to one thread in this worker: its results depend on the number of threads."""
    threadpool_limits(1)
