"""One thread for BLAS: its sums differ with the number of threads, and small matrices gain nothing.

On two busy cores an eigendecomposition of 120 x 120 took 60 times as long with two threads as with
one, as they wait for each other without sleeping.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

import scipy.linalg  # noqa: F401, brings its own BLAS, which the controller must find
from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager[object]:
    """Let BLAS use one thread inside the block.

    The number is one of the whole process: where several threads ask, the first decides.
    """
    limit: AbstractContextManager[object] = _controller().limit(limits=1, user_api="blas")
    return limit


@cache
def _controller() -> ThreadpoolController:
    """Of the libraries that are loaded: looking for them takes milliseconds."""
    return ThreadpoolController()
