"""The output folder of a batch: a folder for each result, and in `jobs` the record of each job."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from tofuse.apps.batch.jobs import Job
from tofuse.engine.errors import OutputError
from tofuse.formats.files import atomic

_UNFINISHED = ".tofuse-"  # files of a run that is in progress or was killed; `results.folders`

_TEXT_FIELDS = ("key", "state", "host", "run", "verdict", "reason")

State = Literal["waiting", "running", "done", "failed", "killed"]


@dataclass(frozen=True)
class Record:
    """The outcome of a job.

    Attributes
    ----------
    key
        `Job.key` when it started.
    state
        `done`, with a result; `failed`, for a `reason` that a retry does not change; `killed`, if
        its process was terminated; `running`; or `waiting`.
    starts
        Number of times it was started until it ended.
    host
        The machine on which it ran last.
    status
        Exit status of its run, negative for a signal.
    run
        Digest of its `run.json`.
    verdict, reason
        The verdict and its most severe reason, or the reason for no result.
    position_m, relative
        95 % bound of the pose errors, in m and over the model's diagonal; None if not bounded.
    frames, posed
        Number of readable frames, and of those with a pose.
    seconds
        Time of the run since its last start.
    peak_bytes
        Peak memory of its process.
    """

    key: str
    state: State
    starts: int = 1
    host: str = ""
    status: int | None = None
    run: str = ""
    verdict: str = ""
    reason: str = ""
    position_m: float | None = None
    relative: float | None = None
    frames: int | None = None
    posed: int | None = None
    seconds: float | None = None
    peak_bytes: int | None = None

    @property
    def ended(self) -> bool:
        """Whether the job is done or has failed."""
        return self.state in ("done", "failed")


@dataclass(frozen=True)
class BatchFolder:
    """The files of a batch.

    Attributes
    ----------
    path
        The folder, absolute.
    """

    path: Path

    def prepare(self) -> None:
        """Create the folder.

        Raises
        ------
        OutputError
            If it contains anything but a batch, or can't be created.
        """
        if self.path.exists() and not self.path.is_dir():
            raise OutputError("is a file", where=self.path, remedy="pass a folder as --out")
        atomic.make_folder(self.path)
        # Hidden files may be of another process that prepares it at the same time.
        names = {p.name for p in self.path.iterdir() if not p.name.startswith(".")}
        if names - {self.jobs.name} and not {self.jobs.name, self.csv.name} <= names:
            raise OutputError(
                "is not empty and contains no earlier batch",
                where=self.path,
                remedy="pass a new or empty folder as --out",
            )
        atomic.make_folder(self.jobs)

    @property
    def jobs(self) -> Path:
        """Folder of records, logs and thumbnails."""
        return self.path / "jobs"

    @property
    def csv(self) -> Path:
        """The table for programs."""
        return self.path / "batch.csv"

    @property
    def html(self) -> Path:
        """The table for people."""
        return self.path / "batch.html"

    def result(self, job: Job) -> Path:
        """Output folder of the job's run."""
        return self.path / job.name

    def log(self, job: Job) -> Path:
        """Log of the job's process."""
        return self.jobs / f"{job.name}.log"

    def picture(self, job: Job) -> Path:
        """Thumbnail of the job's model."""
        return self.jobs / f"{job.name}.jpg"

    def lock(self, name: str) -> Path:
        """Lock file of a job, by its name."""
        return self.jobs / f".{name}.lock"

    def record(self, job: Job) -> Record | None:
        """Return the record of a job; None if there is none, or it is damaged."""
        try:
            return _record_of(json.loads(self._record(job).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def write(self, job: Job, record: Record) -> None:
        """Write the record of a job."""
        text = json.dumps(asdict(record), indent=1, allow_nan=False)
        atomic.write_text(self._record(job), text + "\n")

    def finished(self, job: Job) -> bool:
        """Whether there is an up-to-date result of the job."""
        record = self.record(job)
        return (
            record is not None
            and record.state == "done"
            and record.run == self.digest(job)
            and record.key == job.key(self.path)
        )

    def digest(self, job: Job) -> str:
        """Return the digest of the job's `run.json`; empty without one."""
        try:
            return hashlib.sha256((self.result(job) / "run.json").read_bytes()).hexdigest()
        except OSError:
            return ""

    def check(self, job: Job, *, overwrite: bool) -> None:
        """Refuse to replace files that are not of this job.

        Raises
        ------
        OutputError
            If its folder contains another result, and `overwrite` is not set.
        """
        folder, record = self.result(job), self.record(job)
        if overwrite or not folder.is_dir():
            return
        if all(p.name.startswith(_UNFINISHED) for p in folder.iterdir()):
            return
        if record is None or record.key != job.key(self.path):
            damaged = record is None and self._record(job).exists()
            raise OutputError(
                f"contains a result whose record, {self._record(job)}, is damaged"
                if damaged
                else "contains the result of another recording, or of other options",
                where=folder,
                remedy="pass --overwrite to replace it, or another --out",
            )

    def _record(self, job: Job) -> Path:
        return self.jobs / f"{job.name}.json"


def _record_of(data: Any) -> Record:
    if not isinstance(data, dict):
        raise ValueError("it is not a table")
    field_names = {f.name for f in fields(Record)}
    record = Record(**{name: value for name, value in data.items() if name in field_names})
    if record.state not in get_args(State):
        raise ValueError("its state is not known")
    for name, value in vars(record).items():
        types = str if name in _TEXT_FIELDS else int if name == "starts" else int | float | None
        if not isinstance(value, types):
            raise ValueError(f"its {name} is {value!r}")
    return record
