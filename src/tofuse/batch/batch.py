"""The whole job of ``tofuse batch``: begin jobs, again where one was killed, and keep a table."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import replace
from math import inf
from time import monotonic, sleep

from tofuse.batch.folder import BatchFolder, Record
from tofuse.batch.jobs import Job
from tofuse.batch.table import write_table
from tofuse.batch.work import Task
from tofuse.batch.workers import Workers

_LOOK_S = 0.5  # how often it is looked for workers that came or went
_PATIENCE_S = 10.0  # without any worker, until that is said

Heard = Callable[[Job, Record], None]


def pending(jobs: Sequence[Job], folder: BatchFolder, *, overwrite: bool) -> list[Job]:
    """Return the jobs that are not done, in order; the folder may not be there yet.

    Raises
    ------
    OutputError
        If one of them would replace something else; see `BatchFolder.check`.
    """
    left = [job for job in jobs if not folder.finished(job)]
    for job in left:
        folder.check(job, overwrite=overwrite)
    return left


def status_of(jobs: Sequence[Job], folder: BatchFolder) -> int:
    """Return 0 if all have a result and all their frames a pose, 2 without any result, else 3."""
    records = [folder.record(job) for job in jobs]
    done = [r.status for r in records if r is not None and r.state == "done"]
    if not done:
        return 2
    return 0 if len(done) == len(jobs) and not any(done) else 3


def run_batch(
    jobs: Sequence[Job],
    left: Sequence[Job],
    folder: BatchFolder,
    workers: Workers,
    *,
    threads: int,
    retries: int,
    ended: Heard,
    note: Callable[[str], None],
) -> None:
    """Do the jobs that are left, and keep the table of all `jobs`.

    Parameters
    ----------
    threads
        For each job.
    retries
        How often a job is begun again whose process or worker was killed.
    ended
        Hears of each job that ended.
    note
        Hears what a person should know.

    Raises
    ------
    InputError
        If the workers are lost or can't do the jobs; what is done stays, and is in the table.
    OutputError
        If a record or the table can't be written.
    """
    for job in left:
        workers.check(job)
    for job in left:  # what became of them before counts no more
        record = folder.record(job)
        if record is not None and record.ended:
            folder.write(job, replace(record, state="waiting"))
    write_table(jobs, folder)
    waiting = deque(Task(job, str(folder.path), threads) for job in left)
    running: dict[Future[Record], Task] = {}
    killed: Counter[str] = Counter()
    idle_since = monotonic()
    while waiting or running:
        while waiting and workers.accepts(waiting[0]):
            task = waiting.popleft()
            running[workers.start(task)] = task
        if running:
            idle_since = monotonic()
            done, _ = wait(running, _LOOK_S, FIRST_COMPLETED)
        else:
            if monotonic() - idle_since > _PATIENCE_S:
                note(f"no worker can take {waiting[0].job.name} yet: waiting for one")
                idle_since = inf
            sleep(_LOOK_S)
            done = set()
        for future in done:
            task = running.pop(future)
            if future.cancelled():
                waiting.append(task)
                continue
            record = _known(future.result(), task.job, folder)
            if record.state == "killed":
                killed[task.job.name] += 1
                if killed[task.job.name] <= retries:
                    note(f"{task.job.name}: {record.reason}; it is begun again")
                    waiting.append(task)
                    continue
                record = _given_up(record, killed[task.job.name])
            if folder.record(task.job) != record:
                folder.write(task.job, record)
            write_table(jobs, folder)
            ended(task.job, record)
        if (gone := workers.lost()) is not None:
            write_table(jobs, folder)  # workers may have ended some in between
            raise gone


def _known(record: Record, job: Job, folder: BatchFolder) -> Record:
    """Add to the record of a worker that could not write it what is known here."""
    if record.key:
        return record
    before = folder.record(job)
    starts = 1 if before is None else before.starts
    return replace(record, key=job.key(folder.path), starts=starts)


def _given_up(record: Record, times: int) -> Record:
    again = f", {times} times" if times > 1 else ""
    reason = f"{record.reason}{again}; was there enough memory?"
    return replace(record, state="failed", reason=reason)
