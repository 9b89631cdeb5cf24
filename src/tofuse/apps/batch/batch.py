"""The loop of ``tofuse batch``: start jobs, retry those that were killed, update the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import replace

from tofuse.apps.batch.folder import BatchFolder, Record
from tofuse.apps.batch.jobs import Job
from tofuse.apps.batch.table import write_table
from tofuse.apps.batch.work import Task, Workers

_POLL_S = 0.5  # interval at which it is checked whether there are workers at all

OnEnded = Callable[[Job, Record], None]


def pending(jobs: Sequence[Job], folder: BatchFolder, *, overwrite: bool) -> list[Job]:
    """Return the jobs without an up-to-date result, in order; the folder need not exist.

    Raises
    ------
    OutputError
        If one of them would replace other files; see `BatchFolder.check`.
    """
    remaining = [job for job in jobs if not folder.finished(job)]
    for job in remaining:
        folder.check(job, overwrite=overwrite)
    return remaining


def status_of(jobs: Sequence[Job], folder: BatchFolder) -> int:
    """Return 0 if all jobs have a result and all frames a pose, 2 without any result, else 3."""
    records = [folder.record(job) for job in jobs]
    done = [r.status for r in records if r is not None and r.state == "done"]
    if not done:
        return 2
    return 0 if len(done) == len(jobs) and not any(done) else 3


def run_batch(
    jobs: Sequence[Job],
    remaining: Sequence[Job],
    folder: BatchFolder,
    workers: Workers,
    *,
    threads: int,
    retries: int,
    on_ended: OnEnded,
    note: Callable[[str], None],
) -> None:
    """Run the `remaining` jobs, and update the table of all `jobs`.

    Parameters
    ----------
    jobs, remaining
        All jobs of the batch, and those to be run.
    folder
        The output folder.
    workers
        Run the jobs.
    threads
        Number of threads of each job.
    retries
        Number of restarts of a job whose process or worker was killed.
    on_ended
        Called with each job that has ended.
    note
        Called with messages for the user.

    Raises
    ------
    InputError
        If the workers are lost; finished jobs are in the table.
    OutputError
        If a record or the table can't be written.
    """
    for job in remaining:  # earlier outcomes no longer count
        record = folder.record(job)
        if record is not None and record.ended:
            folder.write(job, replace(record, state="waiting"))
    write_table(jobs, folder)
    tasks = [Task(job, str(folder.path), threads) for job in remaining]
    running: dict[Future[Record], Task] = {}
    killed: Counter[str] = Counter()
    while tasks or running:
        running |= {workers.start(task): task for task in tasks}
        tasks = []
        done, _ = wait(running, _POLL_S, FIRST_COMPLETED)
        for future in done:
            task = running.pop(future)
            if future.cancelled():
                tasks.append(task)
                continue
            record = _completed(future.result(), task.job, folder)
            if record.state == "killed":
                killed[task.job.name] += 1
                if killed[task.job.name] <= retries:
                    note(f"{task.job.name}: {record.reason}; restarting it")
                    tasks.append(task)
                    continue
                record = _failed(record, killed[task.job.name])
            if folder.record(task.job) != record:
                folder.write(task.job, record)
            write_table(jobs, folder)
            on_ended(task.job, record)
        if (error := workers.lost()) is not None:
            write_table(jobs, folder)  # workers may have finished jobs meanwhile
            raise error


def _completed(record: Record, job: Job, folder: BatchFolder) -> Record:
    """Complete the record of a worker that could not write it."""
    if record.key:
        return record
    previous = folder.record(job)
    starts = 1 if previous is None else previous.starts
    return replace(record, key=job.key(folder.path), starts=starts)


def _failed(record: Record, times: int) -> Record:
    attempts = f", {times} times" if times > 1 else ""
    reason = f"{record.reason}{attempts}; was there enough memory?"
    return replace(record, state="failed", reason=reason)
