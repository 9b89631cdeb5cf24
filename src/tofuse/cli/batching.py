"""``tofuse batch``: from the words of the command line to what is said in the end."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from difflib import get_close_matches

from rich.console import Console

from tofuse.batch.batch import pending, run_batch, status_of
from tofuse.batch.folder import BatchFolder, Record
from tofuse.batch.jobs import Job, read_jobs
from tofuse.batch.table import write_table
from tofuse.batch.workers import LocalWorkers, Workers
from tofuse.cli.progress import emit, progress_for
from tofuse.cli.run_words import run_words
from tofuse.errors import Ended, InputError, TofuseError
from tofuse.kernels.cores import usable_cores

_RETRIES = 3
_TOLD = 10  # recordings without a result, that are named in the end


def batch(arguments: argparse.Namespace) -> int:
    """Do all jobs that are not done, and say what came out."""
    jobs = read_jobs(arguments.list, run_words)
    jobs = tuple(replace(j, memory=j.memory or arguments.memory) for j in jobs)
    chosen = _chosen(jobs, arguments)
    folder = BatchFolder(arguments.out.absolute())
    left = pending(chosen, folder, overwrite=arguments.overwrite)
    if arguments.print_jobs:
        for job in left:
            print(_command_line(arguments, job))
        return 0
    if not left:
        write_table(jobs, folder)  # the list may have changed
    else:
        try:
            _work(arguments, jobs, left, folder)
        except (KeyboardInterrupt, Ended) as error:
            done = sum(r is not None and r.state == "done" for r in map(folder.record, chosen))
            words = f"{done} of {len(chosen)} recordings are done; the same command goes on"
            print(f"tofuse: interrupted, {words}", file=sys.stderr)
            return 128 + error.number if isinstance(error, Ended) else 130
        except TofuseError as error:
            if status_of(chosen, folder) == 2:
                raise
            print(f"tofuse: {error}", file=sys.stderr)  # there are results, so this is no 2
    return _tell(chosen, folder, as_json=arguments.json)


def _chosen(jobs: Sequence[Job], arguments: argparse.Namespace) -> list[Job]:
    """The jobs of --only, or all."""
    if arguments.only is None:
        return list(jobs)
    names = [job.name for job in jobs]
    for name in arguments.only:
        if name not in names:
            near = get_close_matches(name, names, 1)
            raise InputError(
                f"there is no job {name} in {arguments.list}",
                where="--only",
                remedy=f"did you mean {near[0]}?" if near else "see --print-jobs",
            )
    return [job for job in jobs if job.name in arguments.only]


def _command_line(arguments: argparse.Namespace, job: Job) -> str:
    """A command that does one job alone, from any folder."""
    words = ["tofuse", "batch", str(arguments.list.absolute())]
    words += ["--out", str(arguments.out.absolute()), "--only", job.name]
    for option in ("threads", "retries"):
        value = getattr(arguments, option)
        words += [] if value is None else [f"--{option}", str(value)]
    return shlex.join([*words, *(["--overwrite"] if arguments.overwrite else [])])


def _work(
    arguments: argparse.Namespace, jobs: Sequence[Job], left: Sequence[Job], folder: BatchFolder
) -> None:
    workers, threads = _workers(arguments, len(left))
    try:
        folder.prepare()
        with progress_for(as_json=arguments.json) as progress:
            progress.stage("jobs", len(left))

            def ended(job: Job, record: Record) -> None:
                progress.advance()
                if arguments.json:
                    emit({"event": "job", "name": job.name, **asdict(record)})

            run_batch(
                jobs,
                left,
                folder,
                workers,
                threads=threads,
                retries=_RETRIES if arguments.retries is None else arguments.retries,
                ended=ended,
                note=progress.note,
            )
    finally:
        workers.close()


def _workers(arguments: argparse.Namespace, jobs: int) -> tuple[Workers, int]:
    """Who works, and with how many threads each job."""
    if arguments.scheduler is not None:
        from tofuse.batch.cluster import DaskWorkers

        # A worker has as many threads as it may use cores, and each of them does a job.
        return DaskWorkers(arguments.scheduler), arguments.threads or 1
    count = min(arguments.workers or 1, jobs)
    return LocalWorkers(count), arguments.threads or max(1, usable_cores() // count)


def _tell(chosen: Sequence[Job], folder: BatchFolder, *, as_json: bool) -> int:
    """Say in a few lines what came out, and return the exit status."""
    from tofuse.cli.commands import COLORS

    records = {job.name: folder.record(job) for job in chosen}
    verdicts = Counter(r.verdict for r in records.values() if r is not None and r.state == "done")
    failed = {n: r.reason for n, r in records.items() if r is not None and r.state == "failed"}
    done, status = sum(verdicts.values()), status_of(chosen, folder)
    if status == 2 and failed:
        name, reason = next(iter(failed.items()))
        raise InputError(
            f"none of {len(chosen)} recordings gave a result; {name}: {reason}", where=folder.html
        )
    if as_json:
        emit(
            {
                "event": "result",
                "out": str(folder.path),
                "jobs": len(chosen),
                "done": done,
                "failed": len(failed),
                "verdicts": dict(verdicts),
            }
        )
        return status
    console = Console(highlight=False, soft_wrap=True)
    counts = [
        f"[{COLORS[v]}]{verdicts[v]} {v}[/]" for v in ("good", "degraded", "failed") if verdicts[v]
    ]
    said = f": {', '.join(counts)}" if counts else ""
    console.print(f"{done} of {len(chosen)} recordings have a result{said}")
    for name, reason in list(failed.items())[:_TOLD]:
        console.print(f"  {name}: {reason}", markup=False)
    if len(failed) > _TOLD:
        console.print(f"  and {len(failed) - _TOLD} others have none")
    console.print(f"see {folder.html}", markup=False)
    return status
