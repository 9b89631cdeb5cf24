"""Independent pieces of a run's work: on the threads here, or spread over other processes.

What a piece returns depends on its arguments alone, so that it does not matter where it is done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from tofuse.kernels.threads import run_chunks

R = TypeVar("R")
Arguments = Callable[[int], tuple[Any, ...]]


class Executor(Protocol):
    """Does pieces of work that know nothing of each other."""

    def map(
        self, function: Callable[..., R], count: int, arguments: Arguments, *, large: bool = False
    ) -> list[R]:
        """Return [function(*arguments(k)) for k in range(count)].

        Parameters
        ----------
        function
            At the top level of a module, as other processes look it up by its name.
        arguments
            Gives those of one piece when it begins: what they are made of may be on disk.
        large
            Whether a piece uses all threads by itself, and much memory: one at a time in a process.
        """
        ...


class Here(Executor):
    """The threads of this process."""

    def map(
        self, function: Callable[..., R], count: int, arguments: Arguments, *, large: bool = False
    ) -> list[R]:
        """See `Executor.map`."""
        if large:
            return [function(*arguments(k)) for k in range(count)]
        return run_chunks(lambda k, _: function(*arguments(k)), count, count)


_executor: Executor = Here()


def executor() -> Executor:
    """Return who does pieces of work at present."""
    return _executor


@contextmanager
def spread_over(wanted: Executor) -> Iterator[None]:
    """Give pieces of work to an executor inside the block, whichever thread asks."""
    global _executor
    before, _executor = _executor, wanted
    try:
        yield
    finally:
        _executor = before
