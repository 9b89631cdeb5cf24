"""Compilation of kernels ahead of their first call, by other processes during the first run.

The first run on a machine compiles every kernel that it calls. Meanwhile other processes compile
the same kernels in reverse order into the same cache, each from another place of the list on, and
load what is there already. The list of kernels and argument types was recorded in runs of the
default method; `python benchmarks/compilation.py --list` records it again.
"""

from __future__ import annotations

import gc
import hashlib
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numba

from tofuse.kernels import jit
from tofuse.kernels.cores import usable_cores

# Processes, of which each takes about 0.5 GB of memory; no more than half of the cores.
_MAX_HELPERS = 3
# Net number of new objects after which Python collects garbage.
_COLLECT_AFTER = 100_000
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
def compiling_in_background() -> Iterator[None]:
    """Compile kernels in other processes during the block, unless they are in the cache.

    The processes are terminated with the block. What they have not compiled is compiled when
    called.
    """
    with ExitStack() as stack:
        helpers = list(_start())
        if helpers:
            stack.enter_context(collecting_rarely())
        for helper in helpers:
            stack.callback(helper.wait)
            stack.callback(helper.terminate)
        yield


@contextmanager
def collecting_rarely() -> Iterator[None]:
    """Collect garbage rarely during the block: the compiler makes many objects that stay."""
    before = gc.get_threshold()
    gc.set_threshold(_COLLECT_AFTER, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _start() -> Iterator[subprocess.Popen[bytes]]:
    if compiled_marker().exists():
        return
    count = min(usable_cores() // 2, _MAX_HELPERS)
    for k in range(count):
        try:
            yield subprocess.Popen(
                [sys.executable, "-m", "tofuse.kernels.ahead", str(k), str(count)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the run, which ends this process
            )
        except OSError:  # no more processes
            return


def signatures() -> list[tuple[str, tuple[Any, ...]]]:
    """Return the kernels that runs call and their argument types, in the order of first use."""
    found = []
    for line in _LIST.read_text(encoding="ascii").splitlines():
        name, *types = line.split()
        found.append((name, tuple(_type_of(text) for text in types)))
    return found


def compile_listed(helper: int = 0, helpers: int = 1) -> None:
    """Compile all of `signatures` in reverse order, or load them from the cache.

    Of several `helpers` each begins at another place of the list, and continues at its end.
    """
    listed = signatures()[::-1]
    first = len(listed) * helper // helpers
    for name, types in listed[first:] + listed[:first]:
        module, function = name.rsplit(".", 1)
        getattr(import_module(f"tofuse.kernels.{module}"), function).compile(types)
    compiled_marker().touch()


def compiled_marker() -> Path:
    """Return the file that exists once the listed kernels of this installation are in the cache.

    Its name contains what Numba's cache depends on: paths, sizes and times of the source files.
    """
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        stat = file.stat()
        digest.update(f"{file} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return Path(jit.cache_folder()) / f"compiled-{digest.hexdigest()[:16]}"


def _type_of(text: str) -> Any:
    kinds: Any = numba.types
    if found := re.fullmatch(r"(\d+)x(.+)", text):
        return kinds.UniTuple(_type_of(found[2]), int(found[1]))
    if found := re.fullmatch(r"(\w+)\.(\w+)\((.+)\)", text):
        named = getattr(import_module(f"tofuse.kernels.{found[1]}"), found[2])
        return kinds.BaseTuple.from_types([_type_of(field) for field in found[3].split(",")], named)
    short, _, shape = text.lstrip("!").partition(":")
    dtype = getattr(kinds, DTYPES[short])
    if not shape:
        return dtype
    return kinds.Array(dtype, int(shape[0]), shape[1], readonly=text.startswith("!"))


if __name__ == "__main__":
    with collecting_rarely():
        compile_listed(*map(int, sys.argv[1:]))
