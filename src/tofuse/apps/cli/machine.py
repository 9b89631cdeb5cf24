"""Whether this process is allowed enough memory to start."""

from __future__ import annotations

import sys

from tofuse.engine.errors import InputError

# The smallest run needs 1.2 GB of address space with two threads, most of it for libraries. A
# compiler that gets no memory aborts the process, which can't be caught.
_MIN_BYTES = 1792 << 20
_BYTES_PER_THREAD = 72 << 20  # its stack and the C library's arena
_INCLUDED_THREADS = 2


def check_machine(threads: int | None = None) -> None:
    """Refuse to start with less memory than any run needs.

    Parameters
    ----------
    threads
        Number of threads; by default that of usable cores.

    Raises
    ------
    InputError
        If the address space is limited to less (`ulimit -v`).
    """
    limit = address_limit()
    if limit is None:
        return
    if threads is None:
        from tofuse.engine.compute import thread_count

        threads = thread_count()
    needed = _MIN_BYTES + _BYTES_PER_THREAD * max(0, threads - _INCLUDED_THREADS)
    if limit < needed:
        raise InputError(
            f"not enough memory: the address space is limited to {limit / 1e9:.1f} GB, and "
            f"{needed / 1e9:.1f} GB are needed with {threads} threads",
            where="memory",
            remedy="raise the limit (ulimit -v), or use --threads 1",
        )


def address_limit() -> int | None:
    """Return the limit of the address space in bytes; None without one."""
    if sys.platform == "win32":
        return None
    import resource

    soft, _hard = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft
