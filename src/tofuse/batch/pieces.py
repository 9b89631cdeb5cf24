"""Pieces of one run's work, done by the workers of a Dask cluster."""

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
from tofuse.batch.client import ANSWERS_S, connected, first_line, unknown_there
from tofuse.errors import InputError
from tofuse.kernels.executors import Arguments, Executor, LocalExecutor
from tofuse.kernels.threads import serial_chunks

R = TypeVar("R")

_LOOK_S = 1.0  # how often the scheduler and its workers are looked at
_TOGETHER = 4  # small pieces that are sent as one: each takes a fraction of a second
_WAITING = 2  # tasks for each thread of the workers, so that the next is there when one is done
_TIMES = 3  # that a piece is sent, before it is done here

# What gives results other than here, where it differs.
_PACKAGES = ("numpy", "scipy", "numba")
_IN_ONE_LINE = "the rest of the run is done on this machine"


class DaskExecutor(Executor):
    """Sends pieces of work to a cluster: each thread of its workers does one at a time.

    What a run needs of its views travels with the pieces, so that workers need to see no files.
    What the cluster does not give back, as workers die or the scheduler goes away, is done here.

    Parameters
    ----------
    address
        Of the scheduler, or the file that it wrote.
    tell
        Is told in one line if the cluster is given up.

    Raises
    ------
    InputError
        If Dask is not installed, no scheduler answers, or a worker has another version of tofuse.
    """

    def __init__(self, address: str, tell: Callable[[str], None]) -> None:
        self._address, self._tell = address, tell
        self._client: Any = connected(address, "leave it out")
        self._given_up = False
        self._looked, self._threads = -_LOOK_S, 0
        self.done_there = 0
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
            together = 1 if large else _TOGETHER
            parts = [range(a, min(a + together, count)) for a in range(0, count, together)]
            found = self._spread(function, parts, arguments, 1 if large else _WAITING)
            self.done_there += len(found)
        left = [k for k in range(count) if k not in found]
        # An error of a piece is raised here as well.
        here = LocalExecutor().map(function, len(left), lambda k: arguments(left[k]), large=large)
        found |= dict(zip(left, here, strict=True))
        return [found[k] for k in range(count)]

    def close(self) -> None:
        """Leave the cluster as it was."""
        self._client.close(timeout=ANSWERS_S)

    def _spread(
        self,
        function: Callable[..., R],
        parts: list[range],
        arguments: Arguments,
        waiting: int,
    ) -> dict[int, R]:
        """What the cluster gives back, by number."""
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
                part = ended.get(timeout=_LOOK_S)
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
            elif times < _TIMES:  # its worker died with its arguments
                todo.append((part, times + 1))
        return found

    def _submitted(self, function: Callable[..., R], pieces: list[tuple[Any, ...]]) -> Any:
        """A future of what some pieces return."""
        # Arguments go to a worker, and not into the scheduler's memory.
        (sent,) = self._client.scatter([pieces], hash=False)
        return self._client.submit(_do, function, sent, _program(), pure=False)

    def _result(self, future: Any) -> list[Any] | None:
        """What a future holds; None where its worker died with it."""
        try:
            return cast("list[Any]", future.result(timeout=ANSWERS_S))
        except Exception:  # whatever it is: it is done here
            return None

    def _error(self, future: Any) -> str:
        error = future.exception(timeout=ANSWERS_S)
        return first_line(error)

    def _slots(self) -> int:
        """How many pieces the workers can do at a time; 0 where nobody is there."""
        if self._client.status != "running":
            return 0
        if monotonic() - self._looked >= _LOOK_S:
            try:
                workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
            except OSError:
                return 0
            self._looked, self._threads = monotonic(), sum(int(w["nthreads"]) for w in workers)
        return self._threads

    def _give_up(self, problem: str = "") -> None:
        self._given_up = True
        gone = self._client.status != "running"
        problem = problem or ("the scheduler " + ("went away" if gone else "has no workers"))
        self._tell(f"{self._address}: {problem}; {_IN_ONE_LINE}")

    def _check_workers(self) -> None:
        """Refuse workers that would give other results, before any work."""
        try:
            programs = self._client.run(_program)
        except Exception as error:
            if not unknown_there(error) and not isinstance(error, _LOST):
                raise
            programs = {self._address: ("no tofuse",)}
        for worker, program in programs.items():
            for here, there in zip(_program(), program, strict=False):
                if here != there:
                    raise InputError(
                        f"a worker has {there}, and this machine {here}",
                        where=str(worker),
                        remedy="results would differ: install the same versions there",
                    )


# What is raised when a cluster goes away between two questions.
_LOST = (OSError, RuntimeError, ValueError)


@cache
def _program() -> tuple[str, ...]:
    """What decides the bytes of a result beside its input."""
    packages = [f"{name} {version(name)}" for name in _PACKAGES]
    return f"tofuse {__version__}", *packages, platform.machine()


def _do(
    function: Callable[..., R], pieces: list[tuple[Any, ...]], program: tuple[str, ...]
) -> list[R]:
    """Do some pieces, in the process of a worker."""
    if program != _program():  # it came later than the check
        raise InputError("a worker has another version", where=platform.node())
    _one_blas_thread()
    with serial_chunks():  # other threads of the worker have pieces of their own
        return [function(*arguments) for arguments in pieces]


@cache
def _one_blas_thread() -> None:
    """Limit BLAS to one thread for as long as the worker lives: its sums differ with more."""
    threadpool_limits(1)
