"""Kernels that a second process compiles during the first run."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import threading
from contextlib import nullcontext
from pathlib import Path

import pytest

from tofuse.engine.compute import ahead, jit, kernel_cache


def test_listed_kernels_exist() -> None:
    listed = ahead.signatures(all_commands=True)
    for name, _ in listed:
        module, function = name.rsplit(".", 1)
        __import__(f"tofuse.{module}")
        assert hasattr(sys.modules[f"tofuse.{module}"], function)
    assert len(listed) == len(set(listed)) > len(ahead.signatures()) > 50


def test_listed_signatures_compile() -> None:
    """From the cache of these tests, or compiled now: unsupported types would fail."""
    words = [sys.executable, "-m", "tofuse.engine.compute.ahead"]
    subprocess.run(words, check=True, capture_output=True)
    marker = ahead.compiled_marker()
    assert marker is not None
    assert marker.exists()


@pytest.mark.nightly_part
def test_run_uses_listed_signatures(room_recording: Path) -> None:
    program = textwrap.dedent(
        """
        import sys, tofuse
        from importlib import import_module
        from tofuse.engine.compute import ahead
        tofuse.reconstruct(tofuse.open(sys.argv[1]).select(end=3))
        for name, types in ahead.signatures():
            module, function = name.rsplit(".", 1)
            module = sys.modules.get(f"tofuse.{module}")
            if module is not None and types in getattr(module, function).overloads:
                print(name)
        """
    )
    words = [sys.executable, "-c", program, str(room_recording)]
    called = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    for name in (
        "engine.alignment.step_kernels.iterate_level",
        "engine.views.view_planes_kernels.fit_planes",
        "engine.stored_views.pair_equation_kernels.target_equations",
    ):
        assert name in called
    assert len(called) > 40


def test_failed_process_start_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(subprocess, "Popen", refused)
    with ahead.compiling_in_background() as is_first_run:
        assert is_first_run


def test_compile_now_waits_for_all_processes(monkeypatch) -> None:
    waited = []

    class Helper:
        def __init__(self, status: int) -> None:
            self.status = status

        def wait(self) -> int:
            waited.append(self.status)
            return self.status

    monkeypatch.setenv("NUMBA_CPU_NAME", "")
    monkeypatch.setenv("NUMBA_CPU_FEATURES", "")
    processor = kernel_cache.Processor("generic", "+avx")
    for statuses, succeeds in (((0, 0), True), ((1, 0), False), ((), False)):
        monkeypatch.setattr(ahead, "_start", lambda *_, s=statuses: map(Helper, s))
        with nullcontext() if succeeds else pytest.raises(RuntimeError, match="compiled"):
            ahead.compile_now(processor=processor)
    assert waited == [0, 0, 1, 0]
    assert (os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"]) == processor


def test_nothing_is_compiled_ahead_that_package_contains(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(jit, "shipped_kernels", lambda: (tmp_path, None))
    with ahead.compiling_in_background() as is_first_run:
        assert not is_first_run


def test_compiled_kernels_are_loaded_in_order_on_another_thread(monkeypatch) -> None:
    loaded: list[tuple[str, object]] = []
    everything = threading.Event()

    def load(kernels) -> None:
        loaded.extend(kernels)
        assert threading.current_thread() is not threading.main_thread()
        if len(loaded) == len(ahead.signatures()):
            everything.set()

    monkeypatch.setattr(ahead, "compile_all", load)
    monkeypatch.setattr(ahead, "usable_cores", lambda: 2)
    monkeypatch.setattr(ahead, "_are_compiled", lambda: True)
    ahead.load_in_background.__wrapped__()
    assert everything.wait(20)
    assert loaded == ahead.signatures()


@pytest.mark.parametrize(("cores", "compiled"), [(1, True), (2, False)])
def test_nothing_is_loaded_without_a_second_core_or_compiled_kernels(
    monkeypatch, cores: int, compiled: bool
) -> None:
    monkeypatch.setattr(ahead, "job_pool", None)
    monkeypatch.setattr(ahead, "usable_cores", lambda: cores)
    monkeypatch.setattr(ahead, "_are_compiled", lambda: compiled)
    ahead.load_in_background.__wrapped__()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_process_that_loads_may_fork_and_end() -> None:
    """Neither waits for all kernels, and a child can call them."""
    program = textwrap.dedent(
        """
        import atexit, os, threading, time
        from tofuse.engine.compute import ahead
        begun, lock, loaded = threading.Event(), threading.Lock(), []
        def slow(kernels):
            with lock:
                begun.set()
                time.sleep(0.2)
                loaded.extend(kernels)
        atexit.register(lambda: print(0 < len(loaded) < len(ahead.signatures())))
        ahead.compile_all, ahead.usable_cores = slow, lambda: 2
        ahead._are_compiled = lambda: True
        ahead.load_in_background()
        begun.wait()
        child = os.fork()
        if not child:
            os._exit(0 if lock.acquire(timeout=5) else 1)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        """
    )
    words = [sys.executable, "-W", "ignore", "-c", program]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "0\nTrue\n", done.stderr
