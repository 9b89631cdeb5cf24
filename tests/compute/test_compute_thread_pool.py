"""The thread pool: the same results, in order, for any number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tofuse.engine.compute.thread_pool import (
    chunk_bounds,
    job_pool,
    run_chunks,
    set_thread_count,
    thread_count,
    threads,
)
from tofuse.engine.errors import InputError


@pytest.mark.parametrize("size", [0, 1, 2, 15, 16, 17, 1000])
@pytest.mark.parametrize("chunks", [1, 3, 16])
def test_chunks_cover_work_once_and_evenly(size, chunks) -> None:
    bounds = chunk_bounds(size, chunks)
    assert [k for a, b in bounds for k in range(a, b)] == list(range(size))
    assert len(bounds) == min(size, chunks)
    lengths = [b - a for a, b in bounds]
    assert not lengths or max(lengths) - min(lengths) <= 1


def test_sums_are_independent_of_threads() -> None:
    values = np.random.default_rng(0).normal(size=100_003).astype(np.float32)

    def total() -> bytes:
        return np.array(run_chunks(lambda a, b: values[a:b].sum(), len(values))).tobytes()

    found = set()
    for count in (1, 2, 3, 4):
        with threads(count):
            assert thread_count() == count
            found.add(total())
    assert len(found) == 1


def test_chunks_run_in_parallel_and_results_keep_order() -> None:
    both = threading.Barrier(2, timeout=20)

    def wait(start: int, _stop: int) -> tuple[int, str]:
        both.wait()  # passes only if two chunks run at the same time
        return start, threading.current_thread().name

    with threads(2):
        found = run_chunks(wait, 2, chunks=2)
    assert [start for start, _ in found] == [0, 1]
    assert len({name for _, name in found}) == 2


def test_caller_computes_chunks_while_pool_is_busy() -> None:
    """And does not wait for threads that have not begun."""
    both, release = threading.Barrier(3, timeout=20), threading.Event()

    def hold(_a: int, _b: int) -> str:
        both.wait()
        release.wait(20)
        return threading.current_thread().name

    with threads(2), ThreadPoolExecutor(1) as other:
        blocking = other.submit(run_chunks, hold, 2, 2)  # its caller, and the thread of the pool
        both.wait()
        found = run_chunks(lambda _a, _b: threading.current_thread().name, 8, chunks=8)
        assert found == [threading.current_thread().name] * 8
        release.set()
        assert len(set(blocking.result())) == 2


@pytest.mark.parametrize("count", [1, 2, 4])
def test_first_error_in_order_is_raised_and_nothing_begins_after_it(count) -> None:
    begun = []

    def fail(start: int, _stop: int) -> None:
        begun.append(start)
        raise ValueError(f"chunk at {start}")

    with threads(count), pytest.raises(ValueError, match="chunk at 0"):
        run_chunks(fail, 100, chunks=100)
    assert len(begun) <= count


@pytest.mark.parametrize("count", [1, 2, 4])
def test_exception_is_raised_and_pool_survives(count) -> None:
    def fail(start: int, _stop: int) -> int:
        if start >= 5:
            raise ValueError(f"chunk at {start}")
        return start

    with threads(count):
        with pytest.raises(ValueError, match="chunk at 5"):
            run_chunks(fail, 10, chunks=10)
        assert run_chunks(lambda a, b: b - a, 10, chunks=5) == [2] * 5


def test_nested_chunks_do_not_deadlock() -> None:
    def outer(a: int, _b: int) -> int:
        return sum(run_chunks(lambda c, d: sum(range(c, d)) + a, 8, chunks=8))

    expected = [28 + 8 * a for a in range(8)]
    for count in (1, 2):
        with threads(count):
            assert run_chunks(outer, 8, chunks=8) == expected


def test_concurrent_callers_with_changing_thread_counts() -> None:
    def job(k: int) -> list[int]:
        found = []
        for count in (1, 2, 3):
            with threads(count):
                found += run_chunks(lambda a, b: b - a + k, 12, chunks=4)
        return found

    before = thread_count()
    with ThreadPoolExecutor(4) as callers:
        assert list(callers.map(job, range(8))) == [[3 + k] * 12 for k in range(8)]
    set_thread_count(before)


def test_thread_count_is_restored() -> None:
    before = thread_count()
    with pytest.raises(RuntimeError), threads(before + 1):
        raise RuntimeError
    assert thread_count() == before
    with threads(None):
        assert thread_count() == before
    for wrong in (0, -1, 1.5, "2"):
        with pytest.raises(InputError, match=r"threads: .*1 or more"):
            set_thread_count(wrong)
    assert thread_count() == before


def test_work_in_job_pool_is_serial() -> None:
    def names() -> list[str]:
        return run_chunks(lambda _a, _b: threading.current_thread().name, 8, chunks=8)

    with threads(2):
        with job_pool(1, "beside") as pool:
            assert set(pool.submit(names).result()) == {"beside_0"}
        with threads(2, serial=True):
            assert set(names()) == {threading.current_thread().name}
        assert thread_count() == 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_forked_child_has_pools_and_locks_of_its_own() -> None:
    """Also where another thread of its parent holds a lock for ever."""
    program = textwrap.dedent(
        """
        import multiprocessing, threading
        from tofuse.engine.compute import thread_pool
        from tofuse.engine.compute.thread_pool import one_blas_thread, run_chunks, threads

        def work():
            with threads(2), one_blas_thread():
                return sum(run_chunks(lambda a, b: b - a, 100))

        assert work() == 100
        def hold(lock, held):
            with lock:
                held.set()
                threading.Event().wait()
        for lock in (thread_pool._lock, thread_pool._blas_lock):
            held = threading.Event()
            threading.Thread(target=hold, args=(lock, held), daemon=True).start()
            held.wait()
        with multiprocessing.get_context("fork").Pool(2) as pool:
            print([pool.apply_async(work).get(30) for _ in range(2)])
        """
    )
    words = [sys.executable, "-W", "ignore", "-c", program]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "[100, 100]\n", done.stderr
