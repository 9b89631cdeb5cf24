"""Connecting to a Dask scheduler."""

from __future__ import annotations

import json
import os
from typing import Any

from tofuse.errors import InputError
from tofuse.files.reading import read_text

TIMEOUT_S = 10.0  # of requests to a scheduler


def connect(address: str, remedy: str) -> Any:
    """Return a client of the scheduler at an address, or of the one that wrote a file.

    Parameters
    ----------
    address
        The address or the file.
    remedy
        The alternative to installing Dask, for the error message.

    Raises
    ------
    InputError
        If Dask is not installed, or no scheduler answers.
    """
    try:
        import dask
    except ImportError as error:
        raise _not_installed(remedy) from error
    # Dask would log errors that are reported here. It reads this when distributed is imported.
    levels = {"distributed": "critical", "distributed.client": "critical"}
    with dask.config.set({"logging": levels}):
        try:
            import distributed
        except ImportError as error:
            raise _not_installed(remedy) from error
    client: Any = distributed.Client
    target = _from_file(address) if os.path.isfile(address) else address
    try:
        return client(target, timeout=TIMEOUT_S, set_as_default=False, name="tofuse")
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            "no Dask scheduler answers",
            where=address,
            remedy="start one with `dask scheduler`, and pass the address that it prints",
        ) from error


def cannot_deserialize(error: BaseException) -> bool:
    """Whether a scheduler or worker could not load the objects of a task."""
    return isinstance(error, ImportError | AttributeError) or "deserializ" in str(error)


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its type."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def _from_file(path: str) -> str:
    """The address in a file that a scheduler wrote."""
    try:
        return str(json.loads(read_text(path))["address"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            "is not a file of a Dask scheduler",
            where=path,
            remedy="pass the address that it prints",
        ) from error


def _not_installed(remedy: str) -> InputError:
    return InputError(
        "needs Dask distributed",
        where="--scheduler",
        remedy=f"pip install 'tofuse[dask]', or {remedy}",
    )
