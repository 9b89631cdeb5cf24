"""Execution of independent tasks on the threads of this process or on other processes.

The result of a task depends on its arguments alone, not on where it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from tofuse.kernels.threads import run_chunks

R = TypeVar("R")
Arguments = Callable[[int], tuple[Any, ...]]


class Executor(Protocol):
    """Runs independent tasks."""

    def map(
        self, function: Callable[..., R], count: int, arguments: Arguments, *, large: bool = False
    ) -> list[R]:
        """Return [function(*arguments(k)) for k in range(count)].

        Parameters
        ----------
        function
            Defined at the top level of a module, as other processes import it by name.
        arguments
            Returns the arguments of task k; called when it starts, as they may have to be read from
            disk.
        large
            Whether a task uses all threads and much memory: one at a time per process.
        """
        ...


class LocalExecutor(Executor):
    """Runs tasks on the threads of this process."""

    def map(
        self, function: Callable[..., R], count: int, arguments: Arguments, *, large: bool = False
    ) -> list[R]:
        """See `Executor.map`."""
        if large:
            return [function(*arguments(k)) for k in range(count)]
        return run_chunks(lambda k, _: function(*arguments(k)), count, count)


_executor: Executor = LocalExecutor()


def executor() -> Executor:
    """Return the current executor."""
    return _executor


@contextmanager
def using_executor(replacement: Executor) -> Iterator[None]:
    """Use an executor inside the block, for all threads."""
    global _executor
    previous, _executor = _executor, replacement
    try:
        yield
    finally:
        _executor = previous
