"""``tofuse batch``: from the arguments of the command line to the summary."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict

from tofuse.apps.batch import (
    BatchFolder,
    DaskWorkers,
    Job,
    LocalWorkers,
    Record,
    Workers,
    pending,
    read_jobs,
    run_batch,
    status_of,
    write_table,
)
from tofuse.apps.cli.commands import VERDICT_COLORS, show
from tofuse.apps.cli.options import Batch
from tofuse.apps.cli.progress import emit, escaped, progress_for
from tofuse.apps.cli.run_arguments import run_arguments
from tofuse.engine.compute import thread_count
from tofuse.engine.errors import Ended, InputError, TofuseError

_RETRIES = 3
_MAX_LISTED = 10  # recordings without a result that the summary names


def batch(arguments: Batch) -> int:
    """Do all pending jobs, and print a summary."""
    jobs = read_jobs(arguments.recordings, run_arguments)
    for name in set(arguments.only or ()) - {job.name for job in jobs}:
        raise InputError(f"there is no job {name}", where="--only", remedy="see --print-jobs")
    selected = [job for job in jobs if arguments.only is None or job.name in arguments.only]
    folder = BatchFolder(arguments.out.absolute())
    remaining = pending(selected, folder, overwrite=arguments.overwrite)
    if arguments.print_jobs:
        for job in remaining:
            print(_command_line(arguments, job))
        return 0
    if not remaining:
        write_table(jobs, folder)  # the list may have changed
    else:
        try:
            _run(arguments, jobs, remaining, folder)
        except (KeyboardInterrupt, Ended) as error:
            done = sum(r is not None and r.state == "done" for r in map(folder.record, selected))
            print(
                f"tofuse: interrupted, {done} of {len(selected)} recordings are done; run the same "
                "command again to resume",
                file=sys.stderr,
            )
            return 128 + error.number if isinstance(error, Ended) else 130
        except TofuseError as error:
            if status_of(selected, folder) == 2:
                raise
            print(f"tofuse: {error}", file=sys.stderr)  # there are results: status 3, not 2
    return _summary(arguments, selected, folder)


def _command_line(arguments: Batch, job: Job) -> str:
    """A command that does a single job, from any folder."""
    command = ["tofuse", "batch", *(str(path.absolute()) for path in arguments.recordings)]
    command += ["--out", str(arguments.out.absolute()), "--only", job.name]
    for option in ("threads", "retries"):
        value = getattr(arguments, option)
        command += [] if value is None else [f"--{option}", str(value)]
    return shlex.join([*command, *(["--overwrite"] if arguments.overwrite else [])])


def _run(
    arguments: Batch, jobs: Sequence[Job], remaining: Sequence[Job], folder: BatchFolder
) -> None:
    if arguments.scheduler is None:
        count = min(arguments.workers or 1, len(remaining))
        workers: Workers = LocalWorkers(count)
        threads = max(1, thread_count() // count)
    else:
        # A worker has a thread per core that it may use, and each thread does one job.
        workers, threads = DaskWorkers(arguments.scheduler), 1
    try:
        folder.prepare()
        with progress_for(as_json=arguments.json) as progress:
            progress.stage("jobs", len(remaining))

            def on_ended(job: Job, record: Record) -> None:
                progress.advance()
                if arguments.json:
                    emit({"event": "job", "name": job.name, **asdict(record)})

            run_batch(
                jobs,
                remaining,
                folder,
                workers,
                threads=arguments.threads or threads,
                retries=_RETRIES if arguments.retries is None else arguments.retries,
                on_ended=on_ended,
                note=progress.note,
            )
    finally:
        workers.close()


def _summary(arguments: Batch, selected: Sequence[Job], folder: BatchFolder) -> int:
    """Print a summary, and return the exit status."""
    records = {job.name: folder.record(job) for job in selected}
    verdicts = Counter(r.verdict for r in records.values() if r is not None and r.state == "done")
    failed = {n: r.reason for n, r in records.items() if r is not None and r.state == "failed"}
    done, status = sum(verdicts.values()), status_of(selected, folder)
    if status == 2 and failed:
        name, reason = next(iter(failed.items()))
        raise InputError(
            f"none of {len(selected)} recordings gave a result; {name}: {reason}", where=folder.html
        )
    facts = {"jobs": len(selected), "done": done, "failed": len(failed), "verdicts": dict(verdicts)}
    colors = VERDICT_COLORS.items()
    counts = [f"[{color}]{verdicts[v]} {v}[/]" for v, color in colors if verdicts[v]]
    listed = [f"  {name}: {reason}" for name, reason in failed.items()][:_MAX_LISTED]
    others = len(failed) - len(listed)
    return show(
        arguments,
        {"event": "result", "out": str(folder.path), **facts},
        f"{done} of {len(selected)} recordings have a result"
        + (f": {', '.join(counts)}" if counts else ""),
        *map(escaped, listed),
        *([f"  and {others} more"] if others else []),
        escaped(f"see {folder.html}"),
        status=status,
    )
