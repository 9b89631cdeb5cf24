"""The output folder of a batch: a folder for each result, and in `jobs` what became of each job."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from tofuse.batch.jobs import Job
from tofuse.errors import OutputError
from tofuse.files.atomic import make_folder, write_text

_UNFINISHED = ".tofuse-"  # what a run that goes on or was killed leaves; see `results.output`

_TEXTS = ("key", "state", "host", "run", "verdict", "reason")

State = Literal["waiting", "running", "done", "failed", "killed"]


@dataclass(frozen=True)
class Record:
    """What became of a job.

    Attributes
    ----------
    key
        Of the job, as it was when it began: `Job.key`.
    state
        `done`, with a result; `failed`, for a `reason` that trying again does not change;
        `killed`, as its process ended in the middle; `running`; or `waiting`, to be done anew.
    starts
        How often it was begun, until it ended.
    host
        Where it ran last.
    status
        Exit status of its run, negative for a signal.
    run
        Digest of its `run.json`.
    verdict, reason
        The verdict, and the gravest reason of it, or why there is no result.
    position_m, relative
        The 95 % bound of the poses, in m and over the model's diagonal; None if not bounded.
    frames, posed
        Readable frames, and those with a pose.
    seconds
        What the run took, with what it went on from after a kill.
    peak_bytes
        Most memory that its process held.
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
        """Whether nothing more will become of it."""
        return self.state in ("done", "failed")


@dataclass(frozen=True)
class BatchFolder:
    """Where everything of a batch is; `path` is absolute."""

    path: Path

    def prepare(self) -> None:
        """Create it.

        Raises
        ------
        OutputError
            If it holds something other than a batch, or can't be made.
        """
        if self.path.exists() and not self.path.is_dir():
            raise OutputError("is a file", where=self.path, remedy="give --out a folder")
        make_folder(self.path)
        # Hidden files may be of another that prepares it just now.
        there = {p.name for p in self.path.iterdir() if not p.name.startswith(".")}
        if there - {self.jobs.name} and not {self.jobs.name, self.csv.name} <= there:
            raise OutputError(
                "is not empty and holds no earlier batch",
                where=self.path,
                remedy="give --out a new or empty folder",
            )
        make_folder(self.jobs)

    @property
    def jobs(self) -> Path:
        """Folder of records, logs and pictures."""
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
        """Where its run writes."""
        return self.path / job.name

    def log(self, job: Job) -> Path:
        """What its process said."""
        return self.jobs / f"{job.name}.log"

    def picture(self, job: Job) -> Path:
        """Its model, small."""
        return self.jobs / f"{job.name}.jpg"

    def lock(self, name: str) -> Path:
        """A file for `locked`, by the name of a job."""
        return self.jobs / f".{name}.lock"

    def record(self, job: Job) -> Record | None:
        """What became of a job; None where nothing is known, or what is there is damaged."""
        try:
            data = json.loads(self._record(job).read_text(encoding="utf-8"))
            return _record_of(data)
        except (OSError, ValueError, TypeError):
            return None

    def write(self, job: Job, record: Record) -> None:
        """Write what became of a job."""
        text = json.dumps(asdict(record), indent=1, allow_nan=False)
        write_text(self._record(job), text + "\n")

    def finished(self, job: Job) -> bool:
        """Whether the result of just this recording, with these options, is there."""
        record = self.record(job)
        return (
            record is not None
            and record.state == "done"
            and record.run == self.digest(job)
            and record.key == job.key(self.path)
        )

    def digest(self, job: Job) -> str:
        """Of its `run.json`; empty where there is none."""
        try:
            return hashlib.sha256((self.result(job) / "run.json").read_bytes()).hexdigest()
        except OSError:
            return ""

    def check(self, job: Job, *, overwrite: bool) -> None:
        """Refuse to replace what is of another job, or of nobody's.

        Raises
        ------
        OutputError
            If its folder holds another result and `overwrite` is not given.
        """
        folder, record = self.result(job), self.record(job)
        if overwrite or not folder.is_dir():
            return
        if all(p.name.startswith(_UNFINISHED) for p in folder.iterdir()):
            return
        if record is None or record.key != job.key(self.path):
            raise OutputError(
                "holds the result of another recording, or of other options",
                where=folder,
                remedy="give --overwrite to replace it, or another --out",
            )

    def _record(self, job: Job) -> Path:
        return self.jobs / f"{job.name}.json"


def _record_of(data: Any) -> Record:
    if not isinstance(data, dict):
        raise ValueError("it is no table")
    known = {f.name for f in fields(Record)}
    record = Record(**{name: value for name, value in data.items() if name in known})
    if record.state not in get_args(State):
        raise ValueError("its state is not known")
    for name, value in vars(record).items():
        kinds = str if name in _TEXTS else int if name == "starts" else int | float | None
        if not isinstance(value, kinds):
            raise ValueError(f"its {name} is {value!r}")
    return record
