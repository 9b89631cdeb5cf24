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
    """Limit BLAS to one thread inside the block.

    The limit is global to the process.
    """
    limit: AbstractContextManager[object] = _controller().limit(limits=1, user_api="blas")
    return limit


@cache
def _controller() -> ThreadpoolController:
    """Return the controller of the loaded libraries, whose detection takes milliseconds."""
    return ThreadpoolController()
