"""Compiled kernels, threads and memory: what makes the engine fast and its results reproducible.

`kernel` compiles a function over arrays; `ahead` compiles or loads kernels before they are called.
`run_chunks` and `run_all` use one thread pool, and their results are the same for any number of
`threads`; `one_blas_thread` does the same for BLAS. `Spill` keeps arrays within a budget of memory,
the rest on disk. `median` and `tukey_kernels` are the statistics that several rooms share.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.compute import ahead, tukey_kernels
    from tofuse.engine.compute.jit import inlined, kernel
    from tofuse.engine.compute.partition import median
    from tofuse.engine.compute.spill import Scratch, Spill, trim_memory
    from tofuse.engine.compute.thread_pool import (
        ProcessLock,
        job_pool,
        one_blas_thread,
        run_all,
        run_chunks,
        thread_count,
        threads,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
