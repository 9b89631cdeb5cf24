"""Compilation of kernels, with a cache that can neither go stale nor stop a run.

Numba's on-disk cache does not notice a changed callee in another file, and fails where it can't
write. The cache folder is therefore keyed by the hash of all kernel sources, and a private
temporary folder stands in where the home is read-only.
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


_HERE = Path(__file__).parent


@cache
def source_hash(package: Path = _HERE) -> str:
    """Hash of the versions that compile kernels, and of all sources of this package.

    For kernels of another package (a folder), which may call these, of its sources as well.
    """
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for folder in dict.fromkeys((_HERE, package)):
        for file in sorted(folder.glob("*.py")):
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder(package: Path = _HERE) -> str:
    """Return a folder that can be written, the same in every run where the machine allows it."""
    return _writable(f"kernels-{source_hash(package)}")


@cache
def _writable(name: str) -> str:
    try:
        folder = _base() / name
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except (OSError, RuntimeError):
        # Private to this process: compiled code must never be loaded from a folder others own.
        private = tempfile.mkdtemp(prefix="tofuse-kernels-")
        atexit.register(shutil.rmtree, private, ignore_errors=True)
        return private


def _base() -> Path:
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"])
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", tempfile.gettempdir())) / "tofuse"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tofuse"


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function over arrays: nogil, cached, IEEE arithmetic (the same every time)."""
    config: Any = numba.config
    njit: Any = numba.njit  # its type hints lack an option
    before = config.CACHE_DIR
    config.CACHE_DIR = cache_folder(Path(function.__code__.co_filename).parent)
    try:
        # Nothing calls kernels from C, so the wrapper for that would only take time to compile.
        options = njit(nogil=True, cache=True, error_model="numpy", no_cfunc_wrapper=True)
        compiled: Callable[P, R] = options(function)
    finally:
        config.CACHE_DIR = before
    return compiled
