"""Whether this process may have what the program can't do without."""

from __future__ import annotations

import sys

from tofuse.errors import InputError

# What the smallest run was seen to need of addresses: 1.2 GB with two threads, most of it for
# libraries. Where the compiler in them gets no memory it ends the process, which can't be caught.
_LEAST_BYTES = 1792 << 20
_EACH_THREAD_BYTES = 72 << 20  # its stack, and what the C library sets aside for it
_COUNTED_THREADS = 2


def check_machine(threads: int | None = None) -> None:
    """Refuse to begin with less than is needed in any case.

    Raises
    ------
    InputError
        If addresses are limited to less (`ulimit -v`).
    """
    limit = address_limit()
    if limit is None:
        return
    if threads is None:
        from tofuse.kernels.cores import usable_cores

        threads = usable_cores()
    needed = _LEAST_BYTES + _EACH_THREAD_BYTES * max(0, threads - _COUNTED_THREADS)
    if limit < needed:
        raise InputError(
            f"not enough memory: this process may have {limit / 1e9:.1f} GB of addresses, and "
            f"needs {needed / 1e9:.1f} GB with {threads} threads",
            where="memory",
            remedy="raise the limit (ulimit -v), or use --threads 1",
        )


def address_limit() -> int | None:
    """Bytes of addresses that this process may have; None where that is not limited."""
    if sys.platform == "win32":
        return None
    import resource

    soft, _hard = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft
