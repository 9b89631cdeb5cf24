"""The workers of a Dask cluster."""

from __future__ import annotations

import json
import os
from concurrent.futures import Future
from typing import Any
from uuid import uuid4

from tofuse.apps.batch.folder import Record
from tofuse.apps.batch.work import Task, Workers, work
from tofuse.engine.errors import InputError
from tofuse.formats.files import reading

_TIMEOUT_S = 10.0  # of requests to a scheduler


class DaskWorkers(Workers):
    """Workers of a cluster: each of their threads does one job at a time.

    All of them must access the recordings and the output folder at the same paths, and have this
    version of tofuse.
    """

    def __init__(self, address: str) -> None:
        """Connect to the scheduler at an address, or to the one that wrote a file.

        Raises
        ------
        InputError
            If Dask is not installed, or no scheduler answers.
        """
        self._address = address
        self._client: Any = _connect(address)

    def start(self, task: Task) -> Future[Record]:
        """See `Workers`."""
        remote = self._client.submit(work, task, key=f"{task.job.name}-{uuid4().hex}", pure=False)
        future: Future[Record] = Future()
        remote.add_done_callback(lambda done: self._transfer(done, future))
        return future

    def lost(self) -> InputError | None:
        """See `Workers`."""
        if self._client.status == "running":
            return None
        return InputError(
            "the Dask scheduler no longer answers",
            where=self._address,
            remedy="start it again, and run the same command again to resume",
        )

    def close(self) -> None:
        """See `Workers`. Workers finish jobs that they have started, and write their records."""
        self._client.close(timeout=_TIMEOUT_S)

    def _transfer(self, remote: Any, future: Future[Record]) -> None:
        """Copy the outcome of a remote future to a local one."""
        try:
            self._outcome(remote, future)
        except Exception:  # the scheduler disappeared between two requests
            future.cancel()
            future.set_running_or_notify_cancel()

    def _outcome(self, remote: Any, future: Future[Record]) -> None:
        from distributed.scheduler import KilledWorker

        if remote.status == "finished":
            future.set_result(remote.result())
        elif remote.status == "error" and self.lost() is None:
            error = remote.exception()
            if isinstance(error, KilledWorker):
                future.set_result(Record("", "killed", reason="its workers were killed"))
            elif isinstance(error, ImportError | AttributeError) or "deserializ" in str(error):
                future.set_exception(
                    InputError(
                        f"can't load the jobs of this version ({str(error).partition(chr(10))[0]})",
                        where=self._address,
                        remedy="install this version of tofuse on its scheduler and its workers",
                    )
                )
            else:
                future.set_exception(error)
        else:
            future.cancel()
            future.set_running_or_notify_cancel()


def _connect(address: str) -> Any:
    """Return a client of the scheduler at an address, or of the one that wrote a file."""
    try:
        import dask

        # Dask would log errors that are reported here; it reads this when it is imported.
        levels = {"distributed": "critical", "distributed.client": "critical"}
        with dask.config.set({"logging": levels}):
            import distributed
    except ImportError as error:
        raise InputError(
            "needs Dask distributed",
            where="--scheduler",
            remedy="pip install 'tofuse[dask]', or use --workers to stay on this machine",
        ) from error
    client: Any = distributed.Client
    try:
        # A file that a scheduler wrote, or its address.
        is_file = os.path.isfile(address)
        target = json.loads(reading.read_text(address))["address"] if is_file else address
        return client(target, timeout=_TIMEOUT_S, set_as_default=False, name="tofuse")
    except (OSError, ValueError, LookupError, TypeError, RuntimeError) as error:
        raise InputError(
            "no Dask scheduler answers",
            where=address,
            remedy="start one with `dask scheduler`, and pass the address that it prints",
        ) from error
