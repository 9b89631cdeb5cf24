"""Distribution of one run's work to the workers of a Dask cluster."""

from __future__ import annotations

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
_CHUNK = 4  # small pieces that are sent together: each takes a fraction of a second
_QUEUED = 2  # tasks per thread of the workers, so that the next one is there when one is done
_MAX_ATTEMPTS = 3  # to send a piece, before it is done locally

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
        self._given_up = False
        self._looked, self._threads = -_POLL_S, 0
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
        found: dict[int, R] = {}
        if not self._given_up:
            together = 1 if large else _CHUNK
            parts = [range(a, min(a + together, count)) for a in range(0, count, together)]
            found = self._spread(function, parts, arguments, 1 if large else _QUEUED)
            self.n_remote += len(found)
        left = [k for k in range(count) if k not in found]
        # An error of a piece is raised here as well.
        here = LocalExecutor().map(function, len(left), lambda k: arguments(left[k]), large=large)
        found |= dict(zip(left, here, strict=True))
        return [found[k] for k in range(count)]

    def close(self) -> None:
        """Disconnect from the cluster."""
        self._client.close(timeout=TIMEOUT_S)

    def _spread(
        self,
        function: Callable[..., R],
        parts: list[range],
        arguments: Arguments,
        waiting: int,
    ) -> dict[int, R]:
        """The results that the cluster returns, by number of the piece."""
        found: dict[int, R] = {}
        todo = deque((k, 1) for k in range(len(parts)))
        running: dict[int, tuple[int, Any]] = {}
        ended: SimpleQueue[int] = SimpleQueue()
        while todo or running:
            slots = waiting * self._slots()
            if not slots:
                self._give_up()
                break
            try:
                while todo and len(running) < slots:
                    part, times = todo.popleft()
                    future = self._submitted(function, [arguments(k) for k in parts[part]])
                    running[part] = times, future
                    future.add_done_callback(lambda _, part=part: ended.put(part))
                part = ended.get(timeout=_POLL_S)
            except Empty:
                continue
            except _LOST:
                self._give_up()
                break
            times, future = running.pop(part)
            if future.status == "finished":
                results = self._result(future)
                found |= dict(zip(parts[part], results, strict=True)) if results else {}
            elif future.status == "error":
                self._give_up(f"a worker failed ({self._error(future)})")
                break
            elif times < _MAX_ATTEMPTS:  # its worker died with its arguments
                todo.append((part, times + 1))
        return found

    def _submitted(self, function: Callable[..., R], pieces: list[tuple[Any, ...]]) -> Any:
        """A future of what some pieces return."""
        # Arguments go to a worker, and not into the scheduler's memory.
        (sent,) = self._client.scatter([pieces], hash=False)
        return self._client.submit(_run_pieces, function, sent, _program(), pure=False)

    def _result(self, future: Any) -> list[Any] | None:
        """The result of a future; None if it was lost with its worker."""
        try:
            return cast("list[Any]", future.result(timeout=TIMEOUT_S))
        except Exception:  # whatever it is: the piece is done locally
            return None

    def _error(self, future: Any) -> str:
        error = future.exception(timeout=TIMEOUT_S)
        return first_line(error)

    def _slots(self) -> int:
        """The number of pieces that the workers can do at a time; 0 without workers."""
        if self._client.status != "running":
            return 0
        if monotonic() - self._looked >= _POLL_S:
            try:
                workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
            except OSError:
                return 0
            self._looked, self._threads = monotonic(), sum(int(w["nthreads"]) for w in workers)
        return self._threads

    def _give_up(self, problem: str = "") -> None:
        self._given_up = True
        gone = self._client.status != "running"
        problem = problem or ("the scheduler " + ("disappeared" if gone else "has no workers"))
        self._notify(f"{self._address}: {problem}; {_FALLBACK}")

    def _check_workers(self) -> None:
        """Refuse workers that would give different results."""
        try:
            programs = self._client.run(_program)
        except Exception as error:
            if not cannot_deserialize(error) and not isinstance(error, _LOST):
                raise
            programs = {self._address: ("no tofuse",)}
        for worker, program in programs.items():
            for here, there in zip(_program(), program, strict=False):
                if here != there:
                    raise InputError(
                        f"a worker has {there}, but this machine has {here}",
                        where=str(worker),
                        remedy="results would differ: install the same versions there",
                    )


# Errors if a cluster disappears between two requests.
_LOST = (OSError, RuntimeError, ValueError)


@cache
def _program() -> tuple[str, ...]:
    """What determines the bytes of a result, apart from its input."""
    packages = [f"{name} {version(name)}" for name in _PACKAGES]
    return f"tofuse {__version__}", *packages, platform.machine()


def _run_pieces(
    function: Callable[..., R], pieces: list[tuple[Any, ...]], program: tuple[str, ...]
) -> list[R]:
    """Do some pieces in the process of a worker."""
    if program != _program():  # the worker joined after the check
        raise InputError("a worker has another version", where=platform.node())
    _one_blas_thread()
    with serial_chunks():  # other threads of the worker have pieces of their own
        return [function(*arguments) for arguments in pieces]


@cache
def _one_blas_thread() -> None:
    """Limit BLAS to one thread in this worker: its results depend on the number of threads."""
    threadpool_limits(1)
