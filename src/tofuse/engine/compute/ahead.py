"""Compilation of kernels ahead of their first call, by other processes.

Installation from source compiles them, if it can (`compile_now`). Else the first run on a machine
compiles every kernel that it calls. Meanwhile, helper processes compile
the same kernels in reverse order into the same cache, each starting at a different position in the
list, and load those that are already cached. The list of kernels and argument types was recorded in
runs of the default method; `python benchmarks/compilation.py --list` records it again.
"""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numba
from llvmlite.binding import get_host_cpu_name

from tofuse.engine.compute import jit, kernel_cache
from tofuse.engine.compute.thread_pool import ProcessLock, job_pool, usable_cores

# Helper processes, each of which takes about 0.5 GB of memory; at most half of the cores.
_MAX_HELPERS = 3
# Net number of allocated objects after which Python collects garbage during compilation.
_GC_THRESHOLD = 100_000
_LIST = Path(__file__).with_name("signatures.txt")
# Names of element types in the list.
DTYPES = {
    "b1": "boolean",
    "i1": "int8",
    "i4": "int32",
    "i8": "int64",
    "u1": "uint8",
    "u2": "uint16",
    "f4": "float32",
    "f8": "float64",
    "c16": "complex128",
}


@contextmanager
def compiling_in_background() -> Iterator[bool]:
    """Compile kernels in other processes during the block, unless they have been compiled.

    The processes are terminated at the end of the block. Kernels that they have not compiled are
    compiled when called.

    Yields
    ------
    Whether kernels have to be compiled.
    """
    if _are_compiled():
        yield False
        return
    with ExitStack() as stack:
        stack.enter_context(rare_garbage_collection())
        for helper in _start(min(usable_cores() // 2, _MAX_HELPERS), False):
            stack.callback(helper.wait)
            stack.callback(helper.terminate)
        yield True


@cache  # once per process
def load_in_background() -> None:
    """Load the listed kernels on another thread if they are compiled, so that no call waits for it.

    In the order of their first use, one after the other: the process may end, or fork, in between.
    """
    if usable_cores() == 1 or not _are_compiled():
        return
    pool, kernels, loading = job_pool(1, "tofuse-kernels"), iter(signatures()), ProcessLock()
    forked = threading.Event()

    def load() -> None:
        with loading:
            kernel = None if forked.is_set() else next(kernels, None)
            if kernel is None:
                pool.shutdown(wait=False)
                return
            compile_all([kernel])
        with suppress(RuntimeError):  # as the process ends
            pool.submit(load)

    def finish() -> None:
        forked.set()
        with loading:
            pass

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=finish)  # Numba's lock must be free in the child
    pool.submit(load)


@contextmanager
def rare_garbage_collection() -> Iterator[None]:
    """Collect garbage rarely during the block, as the compiler creates many long-lived objects."""
    thresholds = gc.get_threshold()
    gc.set_threshold(_GC_THRESHOLD, *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)


def _are_compiled() -> bool:
    """Whether the listed kernels are in the package or in the cache."""
    if jit.shipped_kernels():
        return True
    marker = compiled_marker()
    return marker is not None and marker.exists()


def compile_now(
    all_commands: bool = False, processor: kernel_cache.Processor | None = None
) -> None:
    """Compile kernels into the cache, on all cores, and wait until they are there.

    Parameters
    ----------
    all_commands
        As for `signatures`.
    processor
        What they are for; None: the one of this machine.
    """
    if processor is not None:  # names that Numba reads
        os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = processor
    helpers = list(_start(min(usable_cores(), _MAX_HELPERS + 1), all_commands))
    statuses = [helper.wait() for helper in helpers]
    if not statuses or any(statuses):
        raise RuntimeError("the kernels could not be compiled")


def _start(count: int, all_commands: bool) -> Iterator[subprocess.Popen[bytes]]:
    """Start processes that compile the listed kernels."""
    if jit.cache_folder() is None:
        return
    for k in range(count):
        numbers = map(str, (k, count, int(all_commands)))
        try:
            yield subprocess.Popen(
                [sys.executable, "-m", "tofuse.engine.compute.ahead", *numbers],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the run, which terminates this process
            )
        except OSError:  # no more processes
            return


def signatures(all_commands: bool = False) -> list[tuple[str, tuple[Any, ...]]]:
    """Return the kernels that runs call and their argument types, in the order of first use.

    Parameters
    ----------
    all_commands
        Whether those that only other commands, methods and recordings call follow.
    """
    kernels = []
    usual, _, others = _LIST.read_text(encoding="ascii").partition("\n\n")
    listed = f"{usual}\n{others}" if all_commands else usual
    for line in listed.splitlines():
        name, *types = line.split()
        kernels.append((name, tuple(_type_of(text) for text in types)))
    return kernels


def compile_listed(helper: int = 0, helpers: int = 1, *, all_commands: bool = False) -> None:
    """Compile `signatures` in reverse order, or load them from the cache.

    Each of several `helpers` starts at a different position in the list, and wraps around at its
    end.
    """
    listed = signatures(all_commands)[::-1]
    first = len(listed) * helper // helpers
    compile_all(listed[first:] + listed[:first])
    if marker := compiled_marker():
        marker.touch()


def compile_all(listed: list[tuple[str, tuple[Any, ...]]]) -> None:
    """Compile kernels for their argument types, or load them from the cache."""
    for name, types in listed:
        module, function = name.rsplit(".", 1)
        getattr(import_module(f"tofuse.{module}"), function).compile(types)


def compiled_marker() -> Path | None:
    """Return the file that exists once the listed kernels are kept; None where nothing is."""
    folder = jit.cache_folder()
    # Compiled code is for one type of processor, and a home folder may be shared.
    return None if folder is None else folder / f"compiled-{get_host_cpu_name()}"


def _type_of(text: str) -> Any:
    types: Any = numba.types
    if match := re.fullmatch(r"(\d+)x(.+)", text):
        return types.UniTuple(_type_of(match[2]), int(match[1]))
    if match := re.fullmatch(r"([\w.]+)\.(\w+)\((.+)\)", text):
        cls = getattr(import_module(f"tofuse.{match[1]}"), match[2])
        return types.BaseTuple.from_types([_type_of(field) for field in match[3].split(",")], cls)
    short, _, shape = text.lstrip("!").partition(":")
    dtype = getattr(types, DTYPES[short])
    if not shape:
        return dtype
    return types.Array(dtype, int(shape[0]), shape[1], readonly=text.startswith("!"))


if __name__ == "__main__":
    with rare_garbage_collection():
        numbers = [int(word) for word in sys.argv[1:]]
        compile_listed(*numbers[:2], all_commands=any(numbers[2:]))
