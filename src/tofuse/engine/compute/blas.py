"""One thread for BLAS: sums depend on the number of threads, and small matrices gain nothing.

On two busy cores an eigendecomposition of 120 x 120 took 60 times as long with two threads as with
one, as threads wait for each other by spinning.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

import scipy.linalg  # noqa: F401, brings its own BLAS, which the controller must find
from threadpoolctl import ThreadpoolController

_lock = Lock()
_active_blocks = 0
_limit: Any = None


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread inside the block.

    The limit applies to the whole process, and is lifted at the end of the last of several
    overlapping blocks.
    """
    global _active_blocks, _limit
    with _lock:
        if not _active_blocks:
            _limit = _controller().limit(limits=1, user_api="blas")
        _active_blocks += 1
    try:
        yield
    finally:
        with _lock:
            _active_blocks -= 1
            if not _active_blocks:
                _limit.restore_original_limits()


@cache
def _controller() -> ThreadpoolController:
    """Return the controller of the loaded libraries, whose detection takes milliseconds."""
    return ThreadpoolController()
