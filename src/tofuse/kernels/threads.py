"""One thread pool, used so that the result does not depend on how many threads there are.

Work is cut into a number of chunks that depends on the work alone. Each chunk is computed by one
call of a GIL-free kernel, and results are combined in chunk order.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

R = TypeVar("R")

_count = max(1, os.cpu_count() or 1)
_pool: ThreadPoolExecutor | None = None


def thread_count() -> int:
    """Return how many threads `run_chunks` uses."""
    return _count


def set_thread_count(count: int) -> None:
    """Use `count` (1 or more) threads from now on."""
    global _count, _pool
    if count < 1:
        raise ValueError("the number of threads must be at least 1")
    if count != _count and _pool is not None:
        _pool.shutdown(wait=True)
        _pool = None
    _count = count


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Use `count` threads inside the block (None: leave it as it is)."""
    before = _count
    set_thread_count(before if count is None else count)
    try:
        yield
    finally:
        set_thread_count(before)


def chunk_bounds(size: int, chunks: int = 16) -> list[tuple[int, int]]:
    """Cut range(size) into at most `chunks` nearly equal, non-empty (start, stop) pieces."""
    chunks = max(1, min(chunks, size))
    edges = [size * k // chunks for k in range(chunks + 1)]
    return [(a, b) for a, b in itertools.pairwise(edges) if b > a]


def run_chunks(function: Callable[[int, int], R], size: int, chunks: int = 16) -> list[R]:
    """Return [function(start, stop) for each chunk], in chunk order, computed on the pool.

    Must not be called from inside a chunk.
    """
    global _pool
    bounds = chunk_bounds(size, chunks)
    if _count == 1 or len(bounds) <= 1:
        return [function(a, b) for a, b in bounds]
    if _pool is None:
        _pool = ThreadPoolExecutor(_count, thread_name_prefix="tofuse")
    return list(_pool.map(lambda ab: function(*ab), bounds))


def run_all(tasks: Sequence[Callable[[], R]]) -> list[R]:
    """Run independent tasks on the pool and return their results in the order given."""
    return run_chunks(lambda a, _b: tasks[a](), len(tasks), chunks=max(1, len(tasks)))
