"""The cores of this machine, and one thread pool with results that do not depend on their number.

Work is divided into a number of chunks that depends on the work alone. Each chunk is computed by
one call of a GIL-free kernel, and results are combined in chunk order. BLAS, whose sums depend on
its threads, is limited to one.

A child of `fork` has none of its parent's threads: pools and locks are renewed in it.
"""

from __future__ import annotations

import itertools
import math
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from threadpoolctl import ThreadpoolController

from tofuse.engine.bounds import Bounds
from tofuse.engine.parts import check_number

R = TypeVar("R")


@cache
def usable_cores() -> int:
    """Return the number of threads that can run at once, by affinity and quota."""
    allowed = quota()
    return max(1, _affinity() if allowed is None else min(_affinity(), math.ceil(allowed)))


def _affinity() -> int:
    """Return the number of cores that this process may be scheduled on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def quota(root: Path = Path("/")) -> float | None:
    """Return the CPU quota of this process's control groups, in cores; None without a limit.

    Parameters
    ----------
    root
        Root of the file system.
    """
    limits = [limit for folder in _groups(root) if (limit := _cpu_limit(folder)) is not None]
    return min(limits, default=None)


def _groups(root: Path) -> list[Path]:
    """Return the folders of this process's control groups (v1 and v2) and of their parents."""
    mount = root / "sys/fs/cgroup"
    found: list[Path] = []
    for line in _read(root / "proc/self/cgroup").splitlines():
        hierarchy, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if hierarchy == "0" and not controllers:
            top = mount
        elif "cpu" in controllers.split(","):
            top = mount / "cpu"
        else:
            continue
        parts = [part for part in path.split("/") if part not in ("", ".", "..")]
        # In a container the path may be the host's, while the mount is the container's.
        found += [top.joinpath(*parts[:k]) for k in range(len(parts) + 1)]
    return found


def _cpu_limit(folder: Path) -> float | None:
    words = _read(folder / "cpu.max").split() or [
        *_read(folder / "cpu.cfs_quota_us").split(),
        *_read(folder / "cpu.cfs_period_us").split(),
    ]
    try:
        time, period = (float(word) for word in words)
    except ValueError:  # "max", or nothing
        return None
    return time / period if time > 0 and period > 0 else None


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""


class ProcessLock:
    """A lock that is open in a forked child, whatever its parent's threads were doing."""

    def __init__(self) -> None:
        self._renew()
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._renew)

    def _renew(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


_thread_count = usable_cores()
# Threads beside the calling one, for each number of threads. Pools are never shut down, as other
# threads may be using them.
_pools: dict[int, ThreadPoolExecutor] = {}
_lock = ProcessLock()
_thread_state = threading.local()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)


def thread_count() -> int:
    """Return the number of threads that `run_chunks` uses, by default `usable_cores`."""
    return _thread_count


def set_thread_count(count: int) -> None:
    """Use `count` (1 or more) threads from now on."""
    global _thread_count
    check_number(count, Bounds(1), "threads", whole=True)
    _thread_count = count


@contextmanager
def threads(count: int | None, *, serial: bool = False) -> Iterator[None]:
    """Use `count` threads inside the block (None: no change).

    `serial`: not for chunks of this thread, while other threads are busy with other work.
    """
    previous, inside = _thread_count, getattr(_thread_state, "inside", False)
    set_thread_count(previous if count is None else count)
    _thread_state.inside = inside or serial
    try:
        yield
    finally:
        set_thread_count(previous)
        _thread_state.inside = inside


def chunk_bounds(size: int, chunks: int = 16) -> list[tuple[int, int]]:
    """Divide range(size) into at most `chunks` nearly equal, non-empty (start, stop) pieces."""
    chunks = max(1, min(chunks, size))
    edges = [size * k // chunks for k in range(chunks + 1)]
    return [(a, b) for a, b in itertools.pairwise(edges) if b > a]


def run_chunks(function: Callable[[int, int], R], size: int, chunks: int = 16) -> list[R]:
    """Return [function(start, stop) for each chunk], in chunk order.

    The calling thread computes chunks, too, beside one thread less of the pool: where they take
    less time than waking another thread, it has done them all by then.

    Raises the exception of the first chunk that failed. Nested calls are computed serially on the
    calling thread, as waiting for the pool could deadlock.
    """
    bounds = chunk_bounds(size, chunks)
    if _thread_count == 1 or len(bounds) <= 1 or getattr(_thread_state, "inside", False):
        return [function(a, b) for a, b in bounds]
    return _Shared(function, bounds).run(_thread_count)


class _Shared(Generic[R]):
    """Chunks that several threads take in turn, each the next one that nobody has taken."""

    def __init__(self, function: Callable[[int, int], R], bounds: list[tuple[int, int]]) -> None:
        self._function, self._bounds = function, bounds
        self._results: dict[int, R] = {}
        self._errors: dict[int, BaseException] = {}
        self._numbers = iter(range(len(bounds)))  # of which each is taken once

    def run(self, count: int) -> list[R]:
        """Compute the chunks on `count` threads and return their results in order."""
        helpers = min(count, len(self._bounds)) - 1
        pool = _pool(count)
        started = [pool.submit(self._work) for _ in range(helpers)]
        _thread_state.inside = True
        try:
            self._work()
        finally:
            _thread_state.inside = False
            for helper in started:
                if not helper.cancel():
                    helper.result()
        if self._errors:
            # Chunks are taken in order: those before the first that failed are complete.
            raise self._errors[min(self._errors)]
        return [self._results[k] for k in range(len(self._bounds))]

    def _work(self) -> None:
        for k in self._numbers:
            try:
                self._results[k] = self._function(*self._bounds[k])
            except BaseException as error:
                self._errors[k] = error
                for _ in self._numbers:  # nothing more for anybody
                    pass


def _pool(count: int) -> ThreadPoolExecutor:
    with _lock:
        if count not in _pools:
            _pools[count] = ThreadPoolExecutor(
                count - 1, thread_name_prefix="tofuse", initializer=_mark_inside
            )
        return _pools[count]


def _mark_inside() -> None:
    _thread_state.inside = True


def job_pool(count: int, name: str) -> ThreadPoolExecutor:
    """Return a pool for whole jobs in parallel, inside which `run_chunks` is serial.

    Dividing the work of a job further would only add synchronisation.
    """
    return ThreadPoolExecutor(count, thread_name_prefix=name, initializer=_mark_inside)


def run_all(tasks: Sequence[Callable[[], R]]) -> list[R]:
    """Run independent tasks on the pool and return their results in the order given."""
    return run_chunks(lambda a, _b: tasks[a](), len(tasks), chunks=max(1, len(tasks)))


# How many blocks limit BLAS now, and the limit to lift after the last of them.
_blas_lock = ProcessLock()
_active_blocks = 0
_blas_limit: Any = None


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread inside the block.

    The limit applies to the whole process, and is lifted at the end of the last of several
    overlapping blocks.
    """
    global _active_blocks, _blas_limit
    with _blas_lock:
        if not _active_blocks:
            _blas_limit = _controller().limit(limits=1, user_api="blas")
        _active_blocks += 1
    try:
        yield
    finally:
        with _blas_lock:
            _active_blocks -= 1
            if not _active_blocks:
                _blas_limit.restore_original_limits()


@cache
def _controller() -> ThreadpoolController:
    """Return the controller of the loaded libraries, whose detection takes milliseconds."""
    return ThreadpoolController()
