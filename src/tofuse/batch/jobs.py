"""Which jobs a list asks for: paths and globs, one a line, or a table with options."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from glob import escape, glob, has_magic
from pathlib import Path
from typing import Any

from tofuse.errors import InputError
from tofuse.files.reading import name_order, parsed, read_text
from tofuse.files.stamps import Stamp, stamp, stamps_in

RESERVED = ("batch.csv", "batch.html", "jobs")  # names in the output folder that are no job's
_LONGEST = 100  # characters of a name
# What readers look for beside a single file, whatever its name.
_BESIDE = ("camera.json", "rays.npy", "correction.npz")
_UNITS = {"": 1, "k": 1000, "m": 1000**2, "g": 1000**3, "t": 1000**4}
_BINARY = {"ki": 1 << 10, "mi": 1 << 20, "gi": 1 << 30, "ti": 1 << 40}

RunArguments = Callable[[Mapping[str, str], Path, str], tuple[str, ...]]


@dataclass(frozen=True)
class Job:
    """One recording, and the options of its run.

    Attributes
    ----------
    name
        Of its folder: unique, and safe in paths of every system.
    recording
        Absolute path.
    words
        Options as `tofuse run` takes them, each ``--name`` or ``--name=value``.
    memory
        Bytes that it is said to need; None where nothing was said.
    """

    name: str
    recording: str
    words: tuple[str, ...] = ()
    memory: int | None = None

    def key(self, out: Path) -> str:
        """Digest of what decides the result: the recording's files and the options.

        Files count by path, size and time of change. What is in `out` does not.
        """
        values = [word.partition("=")[2] for word in self.words]
        paths = [Path(v) for v in (self.recording, *values) if v and Path(v).is_absolute()]
        files = [s for path in paths for s in _stamps(path, out)]
        facts = {"recording": self.recording, "words": self.words, "files": files}
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def _stamps(path: Path, out: Path) -> list[Stamp]:
    """Of a folder, all in it; of a file, itself and what belongs to it, but no other recording."""
    if os.path.isdir(path):
        return stamps_in(path, out)
    if not os.path.isfile(path):
        return []
    own = path.name.split(".")[0]
    beside = sorted(p for p in path.parent.iterdir() if p.name.split(".")[0] == own)
    beside += [path.parent / name for name in _BESIDE]
    return [stamp(p) for p in beside if p.is_file()]


@dataclass(frozen=True)
class _Row:
    """A line or row of a list: its pattern, and everything else that it says."""

    where: str
    pattern: str
    options: Mapping[str, str] = field(default_factory=dict)


def read_jobs(path: Path, run_arguments: RunArguments) -> tuple[Job, ...]:
    """Read a list of jobs: by its suffix a table (.csv, .toml), else text of one path a line.

    Relative paths count from the list's folder. A recording that comes twice with the same options
    is taken once.

    Parameters
    ----------
    run_arguments
        Turns the options of a row into words of `tofuse run`; given also what relative paths count
        from, and the place to name in errors.

    Raises
    ------
    InputError
        If the list can't be read, names no recording, or a row can't be a job.
    """
    text = read_text(path)
    readers = {".csv": _csv_rows, ".toml": _toml_rows}
    rows = readers.get(path.suffix.lower(), _text_rows)(text, path)
    base = path.absolute().parent
    jobs: dict[str, Job] = {}  # by the name in small letters, as some systems compare them
    seen: dict[tuple[object, ...], str] = {}
    for row in rows:
        options = dict(row.options)
        name, memory = options.pop("name", ""), options.pop("memory", "")
        wanted = _bytes_of(memory, row.where) if memory else None
        words = run_arguments(options, base, row.where)
        found = _matches(row, base)
        if name and len(found) > 1:
            raise InputError(
                f"{row.pattern} gives {len(found)} recordings the one name {name}",
                where=row.where,
                remedy="leave the name out, or name each of them",
            )
        for recording in found:
            if (recording, words, name) in seen:
                continue
            called = _given_name(name, jobs, row.where) if name else _made_name(recording, jobs)
            seen[recording, words, name] = called
            jobs[called.lower()] = Job(called, recording, words, wanted)
    if not jobs:
        raise InputError("names no recording", where=path, remedy="give one path or glob a line")
    return tuple(jobs.values())


def _text_rows(text: str, path: Path) -> Iterator[_Row]:
    for k, line in enumerate(text.splitlines()):
        # Only where a line begins or after a blank: names may hold a #.
        pattern = re.sub(r"(^|\s)#.*", "", line).strip()
        if pattern:
            yield _Row(f"{path}: line {k + 1}", pattern)


def _csv_rows(text: str, path: Path) -> Iterator[_Row]:
    try:
        lines = [line for line in csv.reader(io.StringIO(text), strict=True) if any(line)]
    except csv.Error as error:
        raise InputError(f"is no table ({error})", where=path, remedy="check the file") from error
    head = [cell.strip() for cell in lines[0]] if lines else []
    if len(set(head)) != len(head) or "" in head:
        raise InputError(f"has the column names {head}", where=path, remedy="name each once")
    for k, cells in enumerate(lines[1:]):
        where = f"{path}: row {k + 1}"
        if len(cells) != len(head):
            raise InputError(
                f"has {len(cells)} cells, and there are {len(head)} columns",
                where=where,
                remedy="give each row a cell for each column; quote what holds a comma",
            )
        yield _row(dict(zip(head, (cell.strip() for cell in cells), strict=True)), where)


def _toml_rows(text: str, path: Path) -> Iterator[_Row]:
    data = parsed(tomllib.loads, text, where=path, what="TOML")
    shared, tables = data.pop("all", {}), data.pop("job", [])
    if data or not isinstance(shared, dict) or not isinstance(tables, list):
        raise InputError(
            f"has {', '.join(data) or 'something else'} where only [all] and [[job]] may be",
            where=path,
            remedy="give each recording a [[job]] table, and what all share an [all] table",
        )
    for k, table in enumerate(tables):
        where = f"{path}: job {k + 1}"
        if not isinstance(table, dict):
            raise InputError("is no table", where=where, remedy="write it below [[job]]")
        yield _row({n: _plain(v, n, where) for n, v in {**shared, **table}.items()}, where)


def _plain(value: Any, name: str, where: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str | int | float):
        return str(value)
    raise InputError(f"{name} is {value!r}", where=where, remedy="give a text, number or boolean")


def _row(cells: Mapping[str, str], where: str) -> _Row:
    pattern = cells.get("recording", "")
    if not pattern:
        raise InputError("names no recording", where=where, remedy="give it as `recording`")
    return _Row(where, pattern, {n: v for n, v in cells.items() if n != "recording" and v})


def _matches(row: _Row, base: Path) -> list[str]:
    """The path itself, be it there or not, or all that a glob finds, in the order of names."""
    if "\0" in row.pattern:
        raise InputError("holds a NUL", where=row.where, remedy="check the file")
    pattern = os.path.expanduser(row.pattern)
    path = os.path.join(base, pattern)
    if not has_magic(pattern) or os.path.exists(path):
        return [str(Path(path))]
    every = glob(os.path.join(escape(str(base)), pattern), recursive=True)
    found = sorted(map(Path, every), key=_path_order)
    if not found:
        raise InputError(
            f"nothing matches {row.pattern}",
            where=row.where,
            remedy=f"check the pattern; relative ones count from {base}",
        )
    return [str(p) for p in found]


def _path_order(path: Path) -> list[list[tuple[int, int, str]]]:
    return [name_order(Path(part)) for part in path.parts]


def _given_name(name: str, taken: Iterable[str], where: str) -> str:
    if name != _safe(name) or name.lower() in RESERVED:
        raise InputError(
            f"{name!r} can't be the name of a folder here",
            where=where,
            remedy="use letters, digits, '-', '_' and '.', at most 100, and none of "
            + ", ".join(RESERVED),
        )
    if name.lower() in taken:
        raise InputError(f"the name {name} comes twice", where=where, remedy="name each once")
    return name


def _made_name(recording: str, taken: Iterable[str]) -> str:
    """By the recording's own name; where another has it, with the folders above it, or a number.

    Recordings that are added at the end of a list leave the earlier names as they are.
    """
    path = Path(recording)
    parts = [_safe(part) for part in path.parts[1:]] or ["recording"]
    first = len(parts) - 1
    if parts[first] == "recording" and first:  # as `tofuse demo` calls it: says nothing
        parts[first - 1 :] = [parts[first - 1]]
        first -= 1
    for start in range(first, max(first - 3, -1), -1):
        name = "-".join(parts[start:])[-_LONGEST:]
        if name.lower() not in (*taken, *RESERVED):
            return name
    number = 2
    while f"{parts[-1]}-{number}".lower() in taken:
        number += 1
    return f"{parts[-1]}-{number}"


def _safe(name: str) -> str:
    """The name with what may be trouble in a path, a page or a shell replaced."""
    name = re.sub(r"[^\w.-]+", "_", name)[-_LONGEST:]
    return re.sub(r"^[.-]+|[.]+$", "_", name) or "_"


def parse_bytes(text: str) -> int:
    """Bytes of a text such as 4GB, 500 MB or 2GiB.

    Raises
    ------
    ValueError
        If it is none, or not above 0.
    """
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([kmgt]?i?)b?", text.strip().lower())
    unit = {**_UNITS, **_BINARY}.get(match[2]) if match else None
    size = 0.0 if match is None or unit is None else float(match[1]) * unit
    if not 1 <= size < 1 << 60:
        raise ValueError(f"{text!r} is no amount of memory, such as 4GB")
    return int(size)


def _bytes_of(text: str, where: str) -> int:
    try:
        return parse_bytes(text)
    except ValueError as error:
        raise InputError(f"memory: {error}", where=where) from error
