"""The loop of a batch, its records and its tables, with scripted workers."""

from __future__ import annotations

import csv
import errno
import json
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from cli_calls import refuses
from refused import refused
from tofuse.apps.batch.batch import pending, run_batch, status_of
from tofuse.apps.batch.cluster import DaskWorkers
from tofuse.apps.batch.folder import BatchFolder, Record
from tofuse.apps.batch.jobs import Job
from tofuse.apps.batch.table import COLUMNS, write_table
from tofuse.apps.batch.work import Task, Workers
from tofuse.engine.errors import InputError, OutputError

Outcome = Callable[[Task], Record]
JOBS = tuple(Job(name, f"/{name}") for name in ("a", "b", "c"))


def done(task: Task, verdict: str = "good", status: int = 0, **more: object) -> Record:
    """Leave a result as a process would."""
    folder = BatchFolder(Path(task.out))
    folder.result(task.job).mkdir(exist_ok=True)
    (folder.result(task.job) / "run.json").write_text(json.dumps({"job": task.job.name}))
    record = Record(
        task.job.key(folder.path), "done", status=status, run=folder.digest(task.job),
        verdict=verdict, frames=8, posed=8, seconds=1.5, **more,
    )  # fmt: skip
    folder.write(task.job, record)
    return record


def killed(task: Task) -> Record:
    return Record(task.job.key(Path(task.out)), "killed", reason="its process was killed (SIGKILL)")


def failed(task: Task) -> Record:
    return Record(task.job.key(Path(task.out)), "failed", status=2, reason="is broken")


def cancelled(task: Task) -> Record:
    raise CancelledError


class Scripted(Workers):
    """Return the scripted outcome of the next start of a job, or finish it; one job at a time."""

    def __init__(self, script: dict[str, Sequence[Outcome]] | None = None) -> None:
        self.script = {name: list(steps) for name, steps in (script or {}).items()}
        self.started: list[str] = []
        self.gone: InputError | None = None
        self.waiting: list[tuple[Task, Future[Record]]] = []
        self.busy = False

    def start(self, task: Task) -> Future[Record]:
        self.started.append(task.job.name)
        self.waiting.append((task, Future()))
        future = self.waiting[-1][1]
        if not self.busy:
            self.finish_one()
        return future

    def finish_one(self) -> None:
        self.busy = bool(self.waiting)
        for task, future in self.waiting[:1]:
            self.waiting = self.waiting[1:]
            steps = self.script.get(task.job.name) or [done]
            try:
                future.set_result(steps.pop(0)(task))
            except CancelledError:
                future.cancel()
                future.set_running_or_notify_cancel()

    def lost(self) -> InputError | None:
        self.finish_one()  # the loop asks this after it has received the outcome
        return self.gone

    def close(self) -> None:
        pass


@pytest.fixture
def folder(tmp_path: Path) -> BatchFolder:
    made = BatchFolder(tmp_path / "out")
    made.prepare()
    return made


def run(folder: BatchFolder, workers: Workers, jobs: Sequence[Job] = JOBS, **more) -> list[str]:
    notes: list[str] = []
    left = pending(jobs, folder, overwrite=more.pop("overwrite", False))
    words = {"threads": 1, "retries": 2, "on_ended": lambda *_: None, "note": notes.append} | more
    run_batch(jobs, left, folder, workers, **words)
    return notes


def table(folder: BatchFolder) -> list[dict[str, str]]:
    with folder.csv.open(newline="") as file:
        return list(csv.DictReader(file))


def test_killed_job_is_restarted(folder: BatchFolder) -> None:
    workers = Scripted({"a": [killed, killed, done]})
    notes = run(folder, workers)
    assert sorted(workers.started) == ["a", "a", "a", "b", "c"]
    assert [row["state"] for row in table(folder)] == ["done"] * 3
    assert notes == ["a: its process was killed (SIGKILL); restarting it"] * 2
    assert status_of(JOBS, folder) == 0


def test_failed_job_does_not_stop_others(folder: BatchFolder) -> None:
    workers = Scripted({"b": [failed]})
    run(folder, workers)
    assert workers.started.count("b") == 1
    assert [row["state"] for row in table(folder)] == ["done", "failed", "done"]
    assert table(folder)[1]["reason"] == "is broken"
    assert status_of(JOBS, folder) == 3
    assert status_of(JOBS[1:2], folder) == 2
    again = Scripted()
    run(folder, again)
    assert again.started == ["b"]
    assert status_of(JOBS, folder) == 0


def test_degraded_job_sets_exit_status(folder: BatchFolder) -> None:
    run(folder, Scripted({"c": [lambda task: done(task, "degraded", status=3)]}))
    assert [row["state"] for row in table(folder)] == ["done"] * 3
    assert [row["verdict"] for row in table(folder)] == ["good", "good", "degraded"]
    assert status_of(JOBS, folder) == 3
    assert status_of(JOBS[:2], folder) == 0
    assert status_of(JOBS[2:], folder) == 3  # not 2, as there is a result


def test_batch_resumes_after_lost_workers(folder: BatchFolder) -> None:
    workers = Scripted({"b": [cancelled], "c": [cancelled]})
    workers.gone = InputError("the scheduler went away")
    refused("went away", folder, workers, by=run)
    assert [row["name"] for row in table(folder)] == ["a"]
    again = Scripted()
    run(folder, again)
    assert again.started == ["b", "c"]


def test_table_is_updated_after_each_job(folder: BatchFolder) -> None:
    seen: list[int] = []
    run(folder, Scripted(), on_ended=lambda *_: seen.append(len(table(folder))))
    assert seen == [1, 2, 3]
    assert 'http-equiv="refresh"' not in folder.html.read_text()
    (row, *_) = table(folder)
    assert tuple(row) == COLUMNS
    assert (row["recording"], row["verdict"], row["seconds"]) == ("/a", "good", "1.5")


def test_changed_options_need_overwrite(folder: BatchFolder) -> None:
    run(folder, Scripted())
    changed = (replace(JOBS[0], arguments=("--every=2",)), *JOBS[1:])
    with pytest.raises(OutputError, match="of another recording, or of other options"):
        run(folder, Scripted(), changed)
    workers = Scripted()
    run(folder, workers, changed, overwrite=True)
    assert workers.started == ["a"]


def test_foreign_result_is_not_replaced(folder: BatchFolder) -> None:
    strange = folder.result(JOBS[0])
    strange.mkdir()
    (strange / ".tofuse-unfinished").mkdir()  # from a killed run
    assert pending(JOBS, folder, overwrite=False) == list(JOBS)
    (strange / "run.json").write_text("{}")
    refused("pass overwrite", JOBS, folder, by=pending, error=OutputError, overwrite=False)


@pytest.mark.parametrize(
    "damage", ["{", "[]", "null", '{"key": "", "state": "odd"}', '{"key": 1, "state": "done"}']
)
def test_damaged_record_is_named_or_replaced(damage: str, folder: BatchFolder) -> None:
    run(folder, Scripted())
    (folder.jobs / "a.json").write_text(damage)
    assert folder.record(JOBS[0]) is None
    refused(r"a\.json, is damaged", JOBS, folder, by=pending, error=OutputError, overwrite=False)
    assert pending(JOBS, folder, overwrite=True) == [JOBS[0]]


def test_changed_result_is_recomputed(folder: BatchFolder) -> None:
    run(folder, Scripted())
    (folder.result(JOBS[0]) / "run.json").write_text("{}")
    (folder.result(JOBS[1]) / "run.json").unlink()
    assert pending(JOBS, folder, overwrite=False) == list(JOBS[:2])


def test_foreign_folder_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    refused("contains no earlier batch", by=BatchFolder(tmp_path).prepare, error=OutputError)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]
    refused("is a file", by=BatchFolder(tmp_path / "note.txt").prepare, error=OutputError)


def test_page_escapes_html(folder: BatchFolder) -> None:
    job = Job("a", "/<script>alert(1)</script>", ("--topic=<b>",))
    record = Record("", "failed", reason='<img src=x onerror="alert(1)">, "x"\n=1')
    folder.write(job, record)
    write_table([job], folder)
    page = folder.html.read_text()
    assert "<script" not in page
    assert "<img" not in page
    assert "&lt;script&gt;" in page
    (row,) = table(folder)
    assert (row["recording"], row["reason"]) == (job.recording, record.reason)


def test_full_disk_is_reported(folder: BatchFolder, monkeypatch) -> None:
    def full(*_args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tofuse.formats.files.atomic.os.replace", full)
    refused("no space left on device", folder, Scripted(), by=run, error=OutputError)


class Remote:
    """A future of Dask."""

    def __init__(self, status: str, outcome: object = None) -> None:
        self.status, self.outcome = status, outcome

    def result(self) -> object:
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome

    def exception(self) -> object:
        return self.outcome


def test_dask_outcomes_are_translated() -> None:
    scheduler = pytest.importorskip("distributed.scheduler", reason="Dask is not installed")
    workers = object.__new__(DaskWorkers)
    workers._address = "tcp://there"
    workers._client = SimpleNamespace(status="running")

    def handed(status: str, outcome: object = None) -> Future[Record]:
        future: Future[Record] = Future()
        workers._transfer(Remote(status, outcome), future)
        assert future.done()
        return future

    record = Record("key", "done")
    assert handed("finished", record).result() is record
    killed = handed("error", scheduler.KilledWorker("a", None, 3)).result()
    assert (killed.state, killed.reason) == ("killed", "its workers were killed")
    for unknown in (
        ModuleNotFoundError("No module named 'tofuse'"),
        RuntimeError("Error during deserialization of the task graph.\nMore of it"),
    ):
        error = handed("error", unknown).exception()
        assert isinstance(error, InputError)
        assert str(error).startswith("tcp://there: can't load the jobs of this version (")
        assert "\n" not in str(error)
    bug = ZeroDivisionError()
    assert handed("error", bug).exception() is bug
    assert handed("cancelled").cancelled()
    # The scheduler disappeared between two calls.
    assert handed("finished", OSError("gone")).cancelled()
    workers._client.status = "connecting"
    assert handed("error", AttributeError("no attribute 'send'")).cancelled()
    assert "tcp://there: the Dask scheduler no longer answers; start it" in str(workers.lost())


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--workers", "0"], "'0' is not 1 or more"),
        (["--workers", "1", "--scheduler", "x"], "not allowed with"),
        (["--only", "b"], "there is no job b"),
        (["--wrkers=2"], "unknown option --wrkers (did you mean --workers?)"),
    ],
)
def test_invalid_arguments_are_reported(words, text, tmp_path: Path, capsys) -> None:
    (tmp_path / "list.txt").write_text(f"{tmp_path}\n")
    line = ("batch", tmp_path / "list.txt", "--out", tmp_path / "out", *words)
    refuses(capsys, *line, says=text, prefix="tofuse")
    assert not (tmp_path / "out").exists()


def test_table_claims_a_bound_only_where_a_run_states_one(folder: BatchFolder) -> None:
    # None: not finite, or of a single frame, and not assessed.
    for job, bound in zip(JOBS, (0.012, None), strict=False):
        done(Task(job, str(folder.path), 1), position_m=bound)
    write_table(JOBS[:2], folder)
    page = folder.html.read_text(encoding="utf-8")
    assert '<td class="number">±12 mm</td>' in page
    assert '<td class="number">no bound</td>' in page
