"""Workers of a Dask cluster, by its scheduler."""

from __future__ import annotations

from concurrent.futures import Future
from time import monotonic
from typing import Any
from uuid import uuid4

from tofuse.batch.client import ANSWERS_S, connected, first_line, unknown_there
from tofuse.batch.folder import Record
from tofuse.batch.jobs import Job
from tofuse.batch.work import Task, work
from tofuse.batch.workers import Workers
from tofuse.errors import InputError

_LOOK_S = 1.0  # how often the workers are counted


class DaskWorkers(Workers):
    """Workers of a cluster: each of their threads does one job at a time.

    All of them see the recordings and the output folder at the same paths, and have this version.
    """

    def __init__(self, address: str) -> None:
        """Find the scheduler by its address, or by the file that it wrote.

        Raises
        ------
        InputError
            If Dask is not installed, or no scheduler answers.
        """
        self._address = address
        self._client: Any = connected(address, "give --workers to stay on this machine")
        self._running: set[Future[Record]] = set()
        self._seen: list[dict[str, Any]] = []
        self._looked = -_LOOK_S

    def check(self, job: Job) -> None:
        """See `Workers`. A cluster without workers may yet get some."""
        if job.memory is None:
            return
        declared = [w["resources"].get("memory", 0) for w in self._workers()]
        if declared and max(declared) < job.memory:
            raise InputError(
                f"{job.name} asks for {job.memory} bytes, and of the {len(declared)} workers none "
                f"declares more than {max(declared):.0f}",
                where=self._address,
                remedy=f'start them with --resources "memory={job.memory}"',
            )

    def accepts(self, task: Task) -> bool:
        """See `Workers`. No more tasks are handed over than workers can do at a time.

        What lies at a worker counts as lost with it each time, though it had not begun.
        """
        self._running = {f for f in self._running if not f.done()}
        if monotonic() - self._looked >= _LOOK_S:
            self._seen, self._looked = self._workers(), monotonic()
        return len(self._running) < sum(_slots(worker, task.job) for worker in self._seen)

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
        remote.add_done_callback(lambda done: self._hand_over(done, future))
        self._running.add(future)
        return future

    def lost(self) -> InputError | None:
        """See `Workers`."""
        if self._client.status == "running":
            return None
        return InputError(
            "the scheduler went away",
            where=self._address,
            remedy="start it again, and give the same command: it goes on",
        )

    def close(self) -> None:
        """See `Workers`. Jobs that workers have begun they end, and their records stay."""
        self._client.close(timeout=ANSWERS_S)

    def _workers(self) -> list[dict[str, Any]]:
        try:
            return list(self._client.scheduler_info(n_workers=-1)["workers"].values())
        except OSError:  # `lost` tells
            return []

    def _hand_over(self, remote: Any, future: Future[Record]) -> None:
        """Give what a remote future holds to a local one."""
        try:
            self._outcome(remote, future)
        except Exception:  # the scheduler went away between two questions
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
            elif unknown_there(error):
                future.set_exception(
                    InputError(
                        f"does not know the jobs of this tofuse ({first_line(error)})",
                        where=self._address,
                        remedy="install this version of tofuse for its scheduler and its workers",
                    )
                )
            else:
                future.set_exception(error)
        else:
            future.cancel()
            future.set_running_or_notify_cancel()


def _slots(worker: dict[str, Any], job: Job) -> int:
    """How many jobs like this a worker can do at a time."""
    threads = int(worker["nthreads"])
    if job.memory is None:
        return threads
    return min(threads, int(worker["resources"].get("memory", 0) // job.memory))
