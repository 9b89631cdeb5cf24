"""One thread pool, used so that results do not depend on the number of threads.

Work is divided into a number of chunks that depends on the work alone. Each chunk is computed by
one call of a GIL-free kernel, and results are combined in chunk order.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from tofuse.engine.bounds import Bounds
from tofuse.engine.compute.cores import usable_cores
from tofuse.engine.parts import check_number

R = TypeVar("R")

_thread_count = usable_cores()
# A pool for each number of threads. Pools are never shut down, as other threads may be using them.
_pools: dict[int, ThreadPoolExecutor] = {}
_lock = threading.Lock()
_thread_state = threading.local()


def thread_count() -> int:
    """Return the number of threads that `run_chunks` uses."""
    return _thread_count


def set_thread_count(count: int) -> None:
    """Use `count` (1 or more) threads from now on."""
    global _thread_count
    check_number(count, Bounds(1), "threads", whole=True)
    _thread_count = count


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Use `count` threads inside the block (None: no change)."""
    previous = _thread_count
    set_thread_count(previous if count is None else count)
    try:
        yield
    finally:
        set_thread_count(previous)


def chunk_bounds(size: int, chunks: int = 16) -> list[tuple[int, int]]:
    """Divide range(size) into at most `chunks` nearly equal, non-empty (start, stop) pieces."""
    chunks = max(1, min(chunks, size))
    edges = [size * k // chunks for k in range(chunks + 1)]
    return [(a, b) for a, b in itertools.pairwise(edges) if b > a]


def run_chunks(function: Callable[[int, int], R], size: int, chunks: int = 16) -> list[R]:
    """Return [function(start, stop) for each chunk], in chunk order, computed on the pool.

    Raises the exception of the first chunk that failed. Nested calls are computed serially on the
    calling thread, as waiting for the pool could deadlock.
    """
    bounds = chunk_bounds(size, chunks)
    if _thread_count == 1 or len(bounds) <= 1 or getattr(_thread_state, "inside", False):
        return [function(a, b) for a, b in bounds]
    return list(_pool(_thread_count).map(lambda ab: function(*ab), bounds))


def _pool(count: int) -> ThreadPoolExecutor:
    with _lock:
        if count not in _pools:
            _pools[count] = ThreadPoolExecutor(
                count, thread_name_prefix="tofuse", initializer=_mark_inside
            )
        return _pools[count]


def _mark_inside() -> None:
    _thread_state.inside = True


def job_pool(count: int, name: str) -> ThreadPoolExecutor:
    """Return a pool for whole jobs in parallel, inside which `run_chunks` is serial.

    Dividing the work of a job further would only add synchronisation.
    """
    return ThreadPoolExecutor(count, thread_name_prefix=name, initializer=_mark_inside)


@contextmanager
def serial_chunks(serial: bool = True) -> Iterator[None]:
    """Compute chunks serially inside the block, while other threads are busy with other work."""
    previous = getattr(_thread_state, "inside", False)
    _thread_state.inside = previous or serial
    try:
        yield
    finally:
        _thread_state.inside = previous


def run_all(tasks: Sequence[Callable[[], R]]) -> list[R]:
    """Run independent tasks on the pool and return their results in the order given."""
    return run_chunks(lambda a, _b: tasks[a](), len(tasks), chunks=max(1, len(tasks)))
