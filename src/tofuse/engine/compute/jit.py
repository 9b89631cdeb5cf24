"""Compilation of kernels, with a cache that can neither become stale nor abort a run.

Numba's on-disk cache does not notice a changed callee in another file, and is fatal where it can't
write or is damaged. Kernels are therefore kept in files of our own, in a folder named by a hash of
all kernel sources, the `*_kernels.py` of all rooms.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

from tofuse.engine.compute import kernel_cache

P = ParamSpec("P")
R = TypeVar("R")


_PACKAGE = Path(__file__).parents[2]


def kernel_files(package: Path = _PACKAGE) -> list[Path]:
    """Return all source files that define kernels, in a fixed order."""
    return sorted(package.rglob("*_kernels.py"))


@cache
def source_hash(package: Path = _PACKAGE) -> str:
    """Return a hash of the versions of Numba and Python, and of all files with kernels."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for file in kernel_files(package):
        name = file.relative_to(package).as_posix()
        digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path | None:
    """Return the folder of compiled kernels; None where they can't be kept."""
    return kernel_cache.trusted_folder(f"kernels-{source_hash()}")


@cache
def shipped_kernels() -> tuple[Path, kernel_cache.Processor] | None:
    """Return the folder of the kernels in the installed package, and the processor they are for.

    None if there are none, or if they are of other sources or versions, or for other processors.
    """
    folder = Path(__file__).with_name("compiled") / f"kernels-{source_hash()}"
    processor = kernel_cache.shipped_processor()
    if processor is None or not folder.is_dir() or not kernel_cache.runs_here(processor):
        return None
    return folder, processor


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function over arrays: nogil, cached, with reproducible IEEE arithmetic."""
    return _compiled(function)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel into the loops of its callers: those with calls are not vectorised."""
    return _compiled(function, forceinline=True)


def _compiled(function: Callable[P, R], **options: bool) -> Callable[P, R]:
    njit: Any = numba.njit  # its type hints lack an option
    # Kernels are not called from C, and the wrapper for it takes time to compile.
    compiled = njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)(function)
    compiled._cache = kernel_cache.KernelCache(function, cache_folder, shipped_kernels())
    result: Callable[P, R] = compiled
    return result
