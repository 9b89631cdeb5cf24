"""Compilation of kernels, with a cache that can neither become stale nor abort a run.

Numba's on-disk cache does not notice a changed callee in another file, and fails where it can't
write. The cache folder is therefore named by a hash of all kernel sources, the `*_kernels.py` of
all rooms, and a private temporary folder is used where the home folder is read-only.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

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


def cache_folder() -> str:
    """Return a writable folder, which is the same in every run if the machine allows it."""
    return _writable_folder(f"kernels-{source_hash()}")


@cache
def _writable_folder(name: str) -> str:
    try:
        folder = _cache_root() / name
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except (OSError, RuntimeError):
        # Private to this process: code must never be loaded from a folder that others own.
        private = tempfile.mkdtemp(prefix="tofuse-kernels-")
        atexit.register(shutil.rmtree, private, ignore_errors=True)
        return private


def _cache_root() -> Path:
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"])
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", tempfile.gettempdir())) / "tofuse"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tofuse"


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function over arrays: nogil, cached, with reproducible IEEE arithmetic."""
    config: Any = numba.config
    njit: Any = numba.njit  # its type hints lack an option
    previous = config.CACHE_DIR
    config.CACHE_DIR = cache_folder()
    try:
        # Kernels are not called from C, and the wrapper for it takes time to compile.
        decorator = njit(nogil=True, cache=True, error_model="numpy", no_cfunc_wrapper=True)
        compiled: Callable[P, R] = decorator(function)
    finally:
        config.CACHE_DIR = previous
    return compiled
