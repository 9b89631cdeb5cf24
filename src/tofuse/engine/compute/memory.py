"""Returning freed memory to the operating system."""

from __future__ import annotations

import ctypes
import sys
from functools import cache
from typing import Any


def trim_memory() -> None:
    """Return freed memory to the operating system, where the C library (glibc) retains it.

    The memory that a stage frees is fragmented, so that the next one would allocate more.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> Any:
    if sys.platform != "linux":
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):  # another C library
        return None
