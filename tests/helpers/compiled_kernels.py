"""Compile kernels before the processes that share the tests start, not in each of them."""

from __future__ import annotations

import subprocess
import sys

from tofuse.kernels import ahead

# From the other end of the list: two processes load what the other one has compiled.
_FORWARD = """
from tofuse.kernels import ahead
listed = ahead.signatures()
ahead.signatures = lambda: listed[::-1]
ahead.compile_listed()
"""


def compile_kernels() -> None:
    """Compile the kernels that runs call, unless they are in the cache."""
    if not ahead.compiled_marker().exists():
        ways = (["-m", "tofuse.kernels.ahead"], ["-c", _FORWARD])
        started = [subprocess.Popen([sys.executable, *way]) for way in ways]
        for process in started:
            process.wait()
