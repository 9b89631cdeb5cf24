"""Compile kernels before the processes that share the tests start, not in each of them."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

from tofuse import kernels
from tofuse.kernels import jit

# Two processes, one from either end of the list, which load what the other has compiled.
_FORWARD = """
from tofuse.kernels import ahead
listed = ahead.signatures()
ahead.signatures = lambda: listed[::-1]
ahead.compile_listed()
"""


def compile_kernels() -> None:
    """Compile the kernels that runs call, unless these very files have been compiled before."""
    marker = Path(jit.cache_folder()) / f"tests-{_files()}"
    if marker.exists():
        return
    ways = (["-m", "tofuse.kernels.ahead"], ["-c", _FORWARD])
    started = [subprocess.Popen([sys.executable, *way]) for way in ways]
    codes = [process.wait() for process in started]
    if not any(codes):
        marker.touch()


def _files() -> str:
    """Hash of what Numba's cache goes by: paths, sizes and times of the files."""
    digest = hashlib.sha256()
    for file in sorted(Path(kernels.__path__[0]).glob("*.py")):
        stat = file.stat()
        digest.update(f"{file} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]
