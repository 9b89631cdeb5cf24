"""The jobs of a batch: recordings, and lists of them with options."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from glob import escape, glob, has_magic
from pathlib import Path

from tofuse.engine import quantities
from tofuse.engine.errors import InputError
from tofuse.formats.files import reading, stamps

RESERVED = ("batch.csv", "batch.html", "jobs")  # names in the output folder not for jobs
# Other files are recordings if they are binary, or a reader recognises them.
_LISTS = (".csv", ".txt")
_HEAD_BYTES = 4096
_MAX_NAME_LENGTH = 100  # characters of a name

RunArguments = Callable[[Mapping[str, str], Path, str], tuple[str, ...]]


@dataclass(frozen=True)
class Job:
    """One recording, and the options of its run.

    Attributes
    ----------
    name
        Name of its folder: unique, and valid on every system.
    recording
        Absolute path.
    arguments
        Options of `tofuse run`, each ``--name`` or ``--name=value``.
    """

    name: str
    recording: str
    arguments: tuple[str, ...] = ()

    def key(self, out: Path) -> str:
        """Return a digest of the inputs of the result: the recording's files and the options.

        Files are identified by path, size and modification time; those in `out` are ignored.
        """
        values = [word.partition("=")[2] for word in self.arguments]
        paths = [Path(v) for v in (self.recording, *values) if v and Path(v).is_absolute()]
        files = [s for path in paths for s in stamps.stamps_of(path, out)]
        facts = {"recording": self.recording, "words": self.arguments, "files": files}
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


@dataclass(frozen=True)
class _Row:
    """A line or row of a list, or an argument: its pattern, and its options."""

    where: str
    pattern: str
    options: Mapping[str, str] = field(default_factory=dict)


def read_jobs(paths: Sequence[Path], run_arguments: RunArguments) -> tuple[Job, ...]:
    """Return the jobs of recordings, globs of recordings, and lists.

    A list is a table (.csv), or text with one path or glob per line; relative ones refer to
    its folder. Folders, binary files and files that a reader recognises are recordings. Duplicates
    of a recording with the same options are ignored.

    Parameters
    ----------
    paths
        Paths of lists and of recordings, and globs of recordings.
    run_arguments
        Converts the options of a row to arguments of `tofuse run`; it also gets the folder that
        relative paths refer to, and the row for error messages.

    Raises
    ------
    InputError
        If a list can't be read, there is no recording, or a row can't be a job.
    """
    jobs: dict[str, Job] = {}  # by the name in lower case, as some systems ignore case
    seen: set[tuple[object, ...]] = set()
    for base, row in (each for path in paths for each in _rows(path)):
        options = dict(row.options)
        name = options.pop("name", "")
        arguments = run_arguments(options, base, row.where)
        matches = _matches(row, base)
        if name and len(matches) > 1:
            raise InputError(
                f"{row.pattern} matches {len(matches)} recordings, but there is one name, {name}",
                where=row.where,
                remedy="leave out the name, or list the recordings one by one",
            )
        for recording in matches:
            identity = os.path.realpath(recording), arguments, name
            if identity in seen:
                continue
            job_name = _check_name(name, jobs, row.where) if name else _unique_name(recording, jobs)
            seen.add(identity)
            jobs[job_name.lower()] = Job(job_name, recording, arguments)
    if not jobs:
        names = ", ".join(map(str, paths))
        raise InputError("lists no recording", where=names, remedy="add a path or glob per line")
    return tuple(jobs.values())


def _rows(path: Path) -> Iterator[tuple[Path, _Row]]:
    """Yield the rows of a list, or one for a recording or glob, and the base of relative paths."""
    if not _is_list(path):
        yield Path.cwd(), _Row(str(path), str(path))
        return
    rows = _csv_rows if path.suffix.lower() == ".csv" else _text_rows
    for row in rows(reading.read_text(path), path):
        yield path.absolute().parent, row


def _is_list(path: Path) -> bool:
    if os.path.isdir(path) or (has_magic(str(path)) and not os.path.exists(path)):
        return False
    if path.suffix.lower() in _LISTS:
        return True
    if b"\0" in reading.read_head(path, _HEAD_BYTES):
        return False
    from tofuse.formats.recordings import is_recording

    return not is_recording(path)


def _text_rows(text: str, path: Path) -> Iterator[_Row]:
    rows = []
    for k, line in enumerate(text.splitlines()):
        # Only at the beginning of a line or after a blank: names may contain a #.
        pattern = re.sub(r"(^|\s)#.*", "", line).strip()
        if pattern:
            rows.append(_Row(f"{path}: line {k + 1}", pattern))
    if rows and not any(_may_exist(row.pattern, path.absolute().parent) for row in rows):
        raise InputError(
            f"is read as a list of recordings, but none exists, such as {rows[0].pattern!r:.80}",
            where=path,
            remedy="correct the paths, which are relative to the folder of the list, or leave "
            "this file out",
        )
    yield from rows


def _may_exist(pattern: str, base: Path) -> bool:
    """Whether a path exists; globs and what can't be a path are judged later."""
    path = os.path.join(base, os.path.expanduser(pattern))
    return has_magic(pattern) or "\0" in pattern or os.path.lexists(path)


def _csv_rows(text: str, path: Path) -> Iterator[_Row]:
    try:
        lines = [line for line in csv.reader(io.StringIO(text), strict=True) if any(line)]
    except csv.Error as error:
        raise InputError(
            f"is not a table ({error})", where=path, remedy="check the file"
        ) from error
    header = [cell.strip() for cell in lines[0]] if lines else []
    if len(set(header)) != len(header) or "" in header:
        names = ", ".join(header)
        raise InputError(
            f"has the column names {names}", where=path, remedy="name each column once"
        )
    for k, cells in enumerate(lines[1:]):
        where = f"{path}: row {k + 1}"
        if len(cells) != len(header):
            raise InputError(
                f"has {quantities.count(len(cells), 'cell')}, but there are {len(header)} columns",
                where=where,
                remedy="use one cell per column, and quote cells that contain a comma",
            )
        yield _row(dict(zip(header, (cell.strip() for cell in cells), strict=True)), where)


def _row(cells: Mapping[str, str], where: str) -> _Row:
    pattern = cells.get("recording", "")
    if not pattern:
        raise InputError("names no recording", where=where, remedy="state it as `recording`")
    return _Row(where, pattern, {n: v for n, v in cells.items() if n != "recording" and v})


def _matches(row: _Row, base: Path) -> list[str]:
    """The path itself, whether it exists or not, or all matches of a glob, ordered by name."""
    if "\0" in row.pattern:
        raise InputError("contains a NUL", where=row.where, remedy="check the file")
    pattern = os.path.expanduser(row.pattern)
    path = os.path.join(base, pattern)
    if not has_magic(pattern) or os.path.exists(path):
        return [str(Path(path))]
    matches = glob(os.path.join(escape(str(base)), pattern), recursive=True)
    paths = sorted(
        map(Path, matches), key=lambda path: [reading.name_order(Path(part)) for part in path.parts]
    )
    if not paths:
        raise InputError(
            f"nothing matches {row.pattern}",
            where=row.where,
            remedy=f"check the pattern; relative ones refer to {base}",
        )
    return [str(p) for p in paths]


def _check_name(name: str, taken: Iterable[str], where: str) -> str:
    if name != _safe(name) or name.lower() in RESERVED:
        raise InputError(
            f"{name!r} can't be used as the name of a folder",
            where=where,
            remedy="use letters, digits, '-', '_' and '.', at most 100, and none of "
            + ", ".join(RESERVED),
        )
    if name.lower() in taken:
        raise InputError(f"the name {name} is used twice", where=where, remedy="use each name once")
    return name


def _unique_name(recording: str, taken: Iterable[str]) -> str:
    """The recording's name, made unique by the folders above it, or a number.

    Recordings that are appended to a list don't change earlier names.
    """
    parts = [_safe(part) for part in Path(recording).parts[1:]] or ["recording"]
    first = len(parts) - 1
    if parts[first] == "recording" and first:  # the name that `tofuse demo` uses
        parts[first - 1 :] = [parts[first - 1]]
        first -= 1
    for start in range(first, max(first - 3, -1), -1):
        name = "-".join(parts[start:])[-_MAX_NAME_LENGTH:]
        if name.lower() not in (*taken, *RESERVED):
            return name
    number = 2
    while f"{parts[-1]}-{number}".lower() in taken:
        number += 1
    return f"{parts[-1]}-{number}"


def _safe(name: str) -> str:
    """The name with characters replaced that are special in a path, in HTML or in a shell."""
    name = re.sub(r"[^\w.-]+", "_", name)[-_MAX_NAME_LENGTH:]
    return re.sub(r"^[.-]+|[.]+$", "_", name) or "_"
