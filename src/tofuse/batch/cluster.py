"""The workers of a Dask cluster."""

from __future__ import annotations

from concurrent.futures import Future
from time import monotonic
from typing import Any
from uuid import uuid4

from tofuse.batch.client import TIMEOUT_S, cannot_deserialize, connect, first_line
from tofuse.batch.folder import Record
from tofuse.batch.jobs import Job
from tofuse.batch.work import Task, work
from tofuse.batch.workers import Workers
from tofuse.errors import InputError

_POLL_S = 1.0  # interval at which the workers are counted


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
        self._client: Any = connect(address, "use --workers to stay on this machine")
        self._running: set[Future[Record]] = set()
        self._worker_infos: list[dict[str, Any]] = []
        self._polled_at = -_POLL_S

    def check(self, job: Job) -> None:
        """See `Workers`. A cluster without workers may get some later."""
        if job.memory is None:
            return
        declared = [w["resources"].get("memory", 0) for w in self._workers()]
        if declared and max(declared) < job.memory:
            raise InputError(
                f"{job.name} needs {job.memory} bytes, but none of the {len(declared)} workers "
                f"declares more than {max(declared):.0f}",
                where=self._address,
                remedy=f'start them with --resources "memory={job.memory}"',
            )

    def accepts(self, task: Task) -> bool:
        """See `Workers`. No more tasks are submitted than workers can do at a time.

        Dask counts a queued task as failed whenever its worker dies, even if it had not started.
        """
        self._running = {f for f in self._running if not f.done()}
        if monotonic() - self._polled_at >= _POLL_S:
            self._worker_infos, self._polled_at = self._workers(), monotonic()
        return len(self._running) < sum(_slots(worker, task.job) for worker in self._worker_infos)

    def start(self, task: Task) -> Future[Record]:
        """See `Workers`."""
        memory = task.job.memory
        remote = self._client.submit(
            work,
            task,
            key=f"{task.job.name}-{uuid4().hex}",
            pure=False,
            resources={} if memory is None else {"memory": memory},
        )
        future: Future[Record] = Future()
        remote.add_done_callback(lambda done: self._transfer(done, future))
        self._running.add(future)
        return future

    def lost(self) -> InputError | None:
        """See `Workers`."""
        if self._client.status == "running":
            return None
        return InputError(
            "the scheduler disappeared",
            where=self._address,
            remedy="restart it, and run the same command again to resume",
        )

    def close(self) -> None:
        """See `Workers`. Workers finish jobs that they have started, and write their records."""
        self._client.close(timeout=TIMEOUT_S)

    def _workers(self) -> list[dict[str, Any]]:
        try:
            return list(self._client.scheduler_info(n_workers=-1)["workers"].values())
        except OSError:  # `lost` reports it
            return []

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
        elif remote.status == "error":
            error = remote.exception()
            if isinstance(error, KilledWorker):
                future.set_result(Record("", "killed", reason="its workers were killed"))
            elif cannot_deserialize(error):
                future.set_exception(
                    InputError(
                        f"can't load the jobs of this version ({first_line(error)})",
                        where=self._address,
                        remedy="install this version of tofuse on its scheduler and its workers",
                    )
                )
            else:
                future.set_exception(error)
        else:
            future.cancel()
            future.set_running_or_notify_cancel()


def _slots(worker: dict[str, Any], job: Job) -> int:
    """The number of such jobs that a worker can run at a time."""
    threads = int(worker["nthreads"])
    if job.memory is None:
        return threads
    return min(threads, int(worker["resources"].get("memory", 0) // job.memory))
