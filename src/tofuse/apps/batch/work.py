"""Running jobs, each a `tofuse run` in its own process, and the workers of this machine.

Imports nothing heavy, as the workers and the scheduler of a cluster load it.
"""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from tofuse._version import __version__
from tofuse.apps.batch.folder import BatchFolder, Record
from tofuse.apps.batch.jobs import Job
from tofuse.engine.errors import InputError, output_error
from tofuse.formats.files import locked

# Runs the command, and ends when its parent does.
_MODULE = "tofuse.apps.cli.job"
# Dask's nannies set it for their workers, so that these return freed memory at once. It makes jobs
# slower, whose memory is returned when they end.
_NOT_INHERITED = "MALLOC_TRIM_THRESHOLD_"


@dataclass(frozen=True)
class Task:
    """A job, and the parameters of its run.

    Attributes
    ----------
    job
        The job.
    out
        Absolute path of the batch's folder.
    threads
        Number of threads of its run.
    version
        Version of tofuse that requests it.
    """

    job: Job
    out: str
    threads: int
    version: str = __version__


def work(task: Task, on_start: Callable[[subprocess.Popen[bytes]], None] | None = None) -> Record:
    """Run a job and write its record.

    If two workers get the same job, the second one waits and finds it done.

    Parameters
    ----------
    task
        The job.
    on_start
        Called with its process.

    Raises
    ------
    OutputError
        If the record can't be written.
    """
    job, folder = task.job, BatchFolder(Path(task.out))
    if not folder.csv.is_file():
        return _refused(f"{platform.node()} can't access {task.out}: use a shared file system")
    if task.version != __version__:
        return _refused(
            f"{platform.node()} has tofuse {__version__}, not {task.version}: install that version"
        )
    with locked(folder.lock(job.name)) as handle:
        previous = folder.record(job)
        if previous is not None and folder.finished(job):
            return previous
        record = Record(job.key(folder.path), "running", _count_starts(previous), platform.node())
        folder.write(job, record)
        process = _start_process(task, folder, handle)
        with process:
            if on_start is not None:
                on_start(process)
            assert process.stdout is not None
            output = process.stdout.read()
            status = process.wait()
        record = _outcome(record, status, output, folder, job)
        folder.write(job, record)
        return record


def _start_process(task: Task, folder: BatchFolder, lock: int) -> subprocess.Popen[bytes]:
    """Start the process of a job, which holds the lock as well."""
    job = task.job
    arguments = [job.recording, f"--out={folder.result(job)}", "--overwrite", *job.arguments]
    arguments.append(f"--threads={task.threads}")
    try:
        with folder.log(job).open("wb") as log:
            return subprocess.Popen(
                [sys.executable, "-m", _MODULE, str(folder.picture(job)), *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env={k: v for k, v in os.environ.items() if k != _NOT_INHERITED},
                start_new_session=True,  # Ctrl-C reaches only this process
                pass_fds=() if sys.platform == "win32" else (lock,),
            )
    except OSError as error:
        raise output_error(error, folder.log(job)) from error


def _refused(reason: str) -> Record:
    return Record("", "failed", host=platform.node(), reason=reason)


def _count_starts(previous: Record | None) -> int:
    """Number of starts of a job since it ended last, including this one."""
    in_progress = previous is not None and previous.state in ("running", "killed")
    return previous.starts + 1 if previous is not None and in_progress else 1


def _outcome(record: Record, status: int, output: bytes, folder: BatchFolder, job: Job) -> Record:
    """The record of a job whose process has ended."""
    result: dict[str, Any] = {}
    for line in output.splitlines():
        try:
            result |= json.loads(line)
        except ValueError:  # cut off
            continue
    if status in (0, 3) and "verdict" in result:
        return _done(replace(record, state="done", status=status), result, folder.digest(job))
    if status == 2:
        return replace(record, state="failed", status=status, reason=_last_line(folder.log(job)))
    if status < 0 or status > 128:
        reason = f"its process was killed ({_signal(status)})"
        return replace(record, state="killed", status=status, reason=reason)
    reason = f"ended with status {status}: {_last_line(folder.log(job))}; see {folder.log(job)}"
    return replace(record, state="failed", status=status, reason=reason)


def _done(record: Record, result: dict[str, Any], run: str) -> Record:
    accuracy, counts = result["accuracy"], result["frames"]
    bounded = accuracy["assessed"] and accuracy["position_m"] is not None
    return replace(
        record,
        run=run,
        verdict=result["verdict"],
        reason=result["reasons"][0]["text"] if result["reasons"] else "",
        position_m=accuracy["position_m"] if bounded else None,
        relative=accuracy["relative"] if bounded else None,
        frames=sum(counts.values()) - counts["skipped"],
        posed=result["posed"],
        seconds=result["seconds"],
        peak_bytes=result.get("peak_bytes"),
    )


def _last_line(log: Path) -> str:
    """The last line of a process's log, without the program's name."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    last = next((line for line in reversed(lines) if line.strip()), "no message")
    return last.strip().removeprefix("tofuse: ")


def _signal(status: int) -> str:
    number = -status if status < 0 else status - 128
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"status {status}"


class Workers(Protocol):
    """Runs tasks, several at a time, in the order in which they are started."""

    def start(self, task: Task) -> Future[Record]:
        """Start a task as soon as possible.

        The future is cancelled if the workers are lost; else it returns the record of the job,
        `killed` if its worker was.
        """
        ...

    def lost(self) -> InputError | None:
        """Return the error if no worker can be reached any more; else None."""
        ...

    def close(self) -> None:
        """Start nothing more, and stop jobs that would otherwise continue unattended."""
        ...


class LocalWorkers(Workers):
    """Processes of this machine."""

    def __init__(self, count: int) -> None:
        """Run up to `count` jobs at a time."""
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="tofuse-batch")
        self._processes: list[subprocess.Popen[bytes]] = []
        self._closed = False

    def start(self, task: Task) -> Future[Record]:
        """See `Workers`."""
        return self._pool.submit(work, task, self._register_process)

    def lost(self) -> None:
        """See `Workers`."""
        return

    def close(self) -> None:
        """See `Workers`."""
        self._closed = True
        for process in self._processes:
            process.kill()
        self._pool.shutdown(cancel_futures=True)

    def _register_process(self, process: subprocess.Popen[bytes]) -> None:
        self._processes = [p for p in self._processes if p.returncode is None]
        self._processes.append(process)
        if self._closed:
            process.kill()
