"""Compilation of kernels ahead of their first call, by a second process during the first run.

The first run on a machine compiles every kernel that it calls. Meanwhile a second process compiles
the same kernels in reverse order into the same cache, until the two meet. The list of kernels and
argument types was recorded in runs of the default method; `python benchmarks/compilation.py --list`
records it again.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numba

from tofuse.kernels import jit
from tofuse.kernels.cores import usable_cores

_LIST = Path(__file__).with_name("signatures.txt")
_DTYPES = {
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
_NAMES = {name: short for short, name in _DTYPES.items()} | {"bool": "b1"}


@contextmanager
def compiling_in_background() -> Iterator[None]:
    """Compile kernels in another process during the block, unless they are in the cache.

    The process is terminated with the block. What it has not compiled is compiled when called.
    """
    helper = _start()
    try:
        yield
    finally:
        if helper is not None:
            helper.terminate()
            helper.wait()


def _start() -> subprocess.Popen[bytes] | None:
    if usable_cores() < 2 or compiled_marker().exists():
        return None
    try:
        return subprocess.Popen(
            [sys.executable, "-m", "tofuse.kernels.ahead"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the run, which ends this process
        )
    except OSError:  # no more processes
        return None


def signatures() -> list[tuple[str, tuple[Any, ...]]]:
    """Return the kernels that runs call and their argument types, in the order of first use."""
    found = []
    for line in _LIST.read_text(encoding="ascii").splitlines():
        name, *types = line.split()
        found.append((name, tuple(_type_of(text) for text in types)))
    return found


def compile_listed(listed: Iterable[tuple[str, tuple[Any, ...]]]) -> None:
    """Compile all of `signatures`, in the given order, or load them from the cache."""
    for name, types in listed:
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


def signature_line(name: str, types: tuple[Any, ...]) -> str:
    """Return the line of the list for a kernel, "module.function", and types of arguments."""
    return " ".join([name, *(_text_of(kind) for kind in types)])


def _type_of(text: str) -> Any:
    kinds: Any = numba.types
    if found := re.fullmatch(r"(\d+)x(.+)", text):
        return kinds.UniTuple(_type_of(found[2]), int(found[1]))
    if found := re.fullmatch(r"(\w+)\.(\w+)\((.+)\)", text):
        named = getattr(import_module(f"tofuse.kernels.{found[1]}"), found[2])
        return kinds.BaseTuple.from_types([_type_of(field) for field in found[3].split(",")], named)
    short, _, shape = text.lstrip("!").partition(":")
    dtype = getattr(kinds, _DTYPES[short])
    if not shape:
        return dtype
    return kinds.Array(dtype, int(shape[0]), shape[1], readonly=text.startswith("!"))


def _text_of(kind: Any) -> str:
    kinds: Any = numba.types
    if isinstance(kind, kinds.BaseNamedTuple):
        named = kind.instance_class
        fields = ",".join(_text_of(field) for field in kind.types)
        return f"{named.__module__.rsplit('.', 1)[1]}.{named.__name__}({fields})"
    if isinstance(kind, kinds.UniTuple):
        return f"{kind.count}x{_text_of(kind.dtype)}"
    if isinstance(kind, kinds.Array):
        mark = "" if kind.mutable else "!"
        return f"{mark}{_NAMES[str(kind.dtype)]}:{kind.ndim}{kind.layout}"
    return _NAMES[str(kind)]


if __name__ == "__main__":
    compile_listed(reversed(signatures()))
