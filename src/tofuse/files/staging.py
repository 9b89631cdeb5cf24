"""Moving a set of files into a folder atomically: all of them or none, even after a crash.

The files are in a staging folder inside it. A plan there lists which files are moved and which
earlier ones they replace. It is synced to disk before the first move and removed after the last. So
after a power cut either there is no plan, and nothing has moved; or there is one, and `recover`
completes it. Each move is one rename, of a file or of a folder with all its files.

A plan is not trusted: it may name only files that a result consists of, and each must be unchanged
since the plan was written.
"""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tofuse.errors import OutputError
from tofuse.files.atomic import replacing, sync, sync_tree

_ASIDE, _FORWARD, _BACK = "replaced", "plan.json", "undo.json"  # in the staging folder
_MAX_PLAN_BYTES = 4 << 20
_TIME_RESOLUTION_S = 2.0  # of modification times on FAT file systems
_TEMPORARY_NAME = re.compile(r"\..*\.part(\.\w+)?|\..*\.unfinished")  # temporary files

# Kind, size in bytes and modification time in s of a file; of a folder, the marks of its files.
Mark = tuple[str, int, float] | dict[str, Any]


@dataclass(frozen=True)
class Names:
    """The names that a result consists of: files, and folders with certain files only.

    Attributes
    ----------
    files, file_pattern
        Names of files, and the pattern of further ones.
    folders
        Patterns of names of folders, and the names in them.
    """

    files: frozenset[str]
    folders: tuple[tuple[re.Pattern[str], Names], ...] = ()
    file_pattern: re.Pattern[str] | None = None

    def file(self, name: str) -> bool:
        """Whether `name` is that of a file of a result."""
        return name in self.files or bool(self.file_pattern and self.file_pattern.fullmatch(name))

    def folder(self, name: str) -> Names | None:
        """Return the names in the folder `name`; None if a result has no such folder."""
        return next((inner for pattern, inner in self.folders if pattern.fullmatch(name)), None)

    def is_result_folder(self, folder: Path) -> bool:
        """Whether a path is a folder of a result, without links or other content."""
        inner = self.folder(folder.name)
        return (
            inner is not None
            and _has_type(folder, stat.S_ISDIR)
            and all(
                inner.is_result_folder(p) or (inner.file(p.name) and _has_type(p, stat.S_ISREG))
                for p in folder.iterdir()
            )
        )


class _InvalidPlanError(Exception):
    """A plan that is malformed or no longer matches the files."""


@dataclass(frozen=True)
class _Plan:
    """The files that are moved into place, and those that are moved aside before, in that order.

    The first of the old ones and the last of the new ones is the marker: it exists only while the
    set is complete.
    """

    new: dict[str, Mark]
    old: dict[str, Mark]

    def carry_out(self, staging: Path, folder: Path) -> None:
        """Make the moves, or the remaining ones."""
        for name in self.old:
            if not os.path.lexists(staging / _ASIDE / name):
                os.replace(folder / name, staging / _ASIDE / name)
        for name in self.new:
            if os.path.lexists(staging / name):
                os.replace(staging / name, folder / name)

    def undo(self, staging: Path, folder: Path) -> None:
        """Reverse the moves, or the remaining ones."""
        for name in reversed(self.new):
            if not os.path.lexists(staging / name):
                os.replace(folder / name, staging / name)
        for name in reversed(self.old):
            if os.path.lexists(staging / _ASIDE / name):
                os.replace(staging / _ASIDE / name, folder / name)

    def check(self, names: Names, staging: Path, folder: Path) -> None:
        """Raise _InvalidPlanError if a file is missing from both places, or was changed."""
        for name, mark in self.old.items():
            aside = staging / _ASIDE / name
            _check(aside if os.path.lexists(aside) else folder / name, mark, names)
        for name, mark in self.new.items():
            staged = staging / name
            _check(staged if os.path.lexists(staged) else folder / name, mark, names)


def move_all(staging: Path, folder: Path, names: Names, marker: str) -> None:
    """Move all staged files into a folder, replacing the files of an earlier result there.

    If a move fails, all are reversed.

    Parameters
    ----------
    marker
        The file that is removed first and added last: it marks a complete result.

    Raises
    ------
    OutputError
        If a name is taken by something that is not part of a result.
    OSError
        If a move fails; the previous state is restored.
    """
    new = sorted((p.name for p in staging.iterdir()), key=lambda n: (n == marker, n))
    existing = sorted((p.name for p in folder.iterdir()), key=lambda n: (n != marker, n))
    old = [n for n in existing if n in new or names.file(n) or names.is_result_folder(folder / n)]
    for name in old:
        check_replaceable(folder / name, names)
    plan = _Plan(
        {name: _mark(staging / name, names) for name in new},
        {name: _mark(folder / name, names) for name in old},
    )
    (staging / _ASIDE).mkdir()
    sync_tree(staging)
    with replacing(staging / _FORWARD, durable=True) as temporary:
        temporary.write_text(json.dumps(asdict(plan)), encoding="utf-8")
    try:
        plan.carry_out(staging, folder)
    except BaseException:
        os.replace(staging / _FORWARD, staging / _BACK)
        plan.undo(staging, folder)
        _remove_plan(staging, folder, _BACK)
        raise
    _remove_plan(staging, folder, _FORWARD)


def _remove_plan(staging: Path, folder: Path, name: str) -> None:
    """Remove a completed plan."""
    sync(folder)
    sync(staging)
    (staging / name).unlink()


def is_interrupted(staging: Path) -> bool:
    """Whether moves were interrupted: the folder must not be read before `recover`."""
    return any(os.path.lexists(staging / name) for name in (_FORWARD, _BACK))


def result_locations(staging: Path, folder: Path) -> tuple[Path, ...]:
    """Return the folders in which files of the old and the new result can be during the moves."""
    return (folder, staging / _ASIDE, staging)


def recover(staging: Path, folder: Path, names: Names, marker: str) -> None:
    """Complete the moves of an interrupted program, if any.

    Raises
    ------
    OutputError
        If the plan is invalid; then nothing is touched.
    OSError
        If a move fails; calling again is safe.
    """
    for name, move in ((_BACK, _Plan.undo), (_FORWARD, _Plan.carry_out)):
        if not os.path.lexists(staging / name):
            continue
        plan = checked_plan(staging, names, marker, name)
        try:
            plan.check(names, staging, folder)
        except _InvalidPlanError as error:
            raise _invalid_plan(staging / name, error) from None
        move(plan, staging, folder)
        _remove_plan(staging, folder, name)


def check_interrupted(staging: Path, names: Names, marker: str) -> None:
    """Check a plan of interrupted moves, if any, without accessing the files that it names.

    Raises
    ------
    OutputError
        If it is invalid.
    """
    for name in (_BACK, _FORWARD):
        if os.path.lexists(staging / name):
            checked_plan(staging, names, marker, name)


def checked_plan(staging: Path, names: Names, marker: str, name: str) -> _Plan:
    """Read a plan; OutputError unless all its names and kinds are those of a result."""
    path = staging / name
    try:
        for part in (staging, staging / _ASIDE):
            if not _has_type(part, stat.S_ISDIR):
                raise _InvalidPlanError(f"{part.name} is not a folder")
        if not _has_type(path, stat.S_ISREG) or path.stat().st_size > _MAX_PLAN_BYTES:
            raise _InvalidPlanError("it is not a small file")
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError):
            raise _InvalidPlanError("it is not JSON") from None
        if not isinstance(data, dict) or set(data) != {"new", "old"}:
            raise _InvalidPlanError("it is not a plan")
        plan = _Plan(*(_marks(data[key], names, key) for key in ("new", "old")))
        if plan.old and next(iter(plan.old)) != marker:
            raise _InvalidPlanError("it replaces something other than a result")
        if plan.new and list(plan.new)[-1] != marker:
            raise _InvalidPlanError("it does not produce a result")
        return plan
    except _InvalidPlanError as error:
        raise _invalid_plan(path, error) from None
    except OSError as error:
        raise _invalid_plan(path, error.strerror or error) from error


def _invalid_plan(path: Path, reason: object) -> OutputError:
    return OutputError(
        f"was not left by this program, or has changed since ({reason}); nothing was touched",
        where=path,
        remedy=f"move {path.parent.name} away if it is not yours, or choose another --out",
    )


def _marks(data: object, names: Names, key: str) -> dict[str, Mark]:
    if not isinstance(data, dict):
        raise _InvalidPlanError("it is not a plan")
    marks: dict[str, Mark] = {}
    for name, mark in data.items():
        inner = names.folder(name)
        if names.file(name) and _is_mark(mark, ("file", "link") if key == "old" else ("file",)):
            marks[name] = tuple(mark)
        elif inner is not None and isinstance(mark, dict):
            marks[name] = _marks(mark, inner, "within")
        else:
            raise _InvalidPlanError(f"it names {name!r:.80}")
    return marks


def _is_mark(mark: object, kinds: tuple[str, ...] = ("file",)) -> bool:
    return (
        isinstance(mark, list)
        and len(mark) == 3
        and mark[0] in kinds
        and type(mark[1]) is int
        and type(mark[2]) in (int, float)
    )


def _mark(path: Path, names: Names) -> Mark:
    """The kind, size and time of a file of a result, or the marks of a folder's files."""
    status = path.lstat()
    inner = names.folder(path.name)
    if inner is not None and stat.S_ISDIR(status.st_mode) and names.is_result_folder(path):
        return {p.name: _mark(p, inner) for p in sorted(path.iterdir())}
    for kind, test in (("file", stat.S_ISREG), ("link", stat.S_ISLNK)):
        if test(status.st_mode) and names.file(path.name):
            return (kind, status.st_size, status.st_mtime)
    raise not_a_result_error(path)


def _check(path: Path, mark: Mark, names: Names) -> None:
    """Raise _InvalidPlanError if a file was changed since it was marked."""
    try:
        current = _mark(path, names)
    except (OSError, OutputError):
        raise _InvalidPlanError(f"{path.name} was changed") from None
    if not _same(current, mark):
        raise _InvalidPlanError(f"{path.name} was changed")


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return set(a) == set(b) and all(_same(a[name], b[name]) for name in a)
    if isinstance(a, dict) or isinstance(b, dict):
        return False
    return bool(a[:2] == b[:2] and abs(a[2] - b[2]) <= _TIME_RESOLUTION_S)


def check_replaceable(path: Path, names: Names) -> None:
    """Check that something with a name of a result may be replaced.

    Raises
    ------
    OutputError
        If it is of another kind than in a result, or a folder with additional content.
    """
    if names.folder(path.name):
        replaceable = names.is_result_folder(path)
    else:
        replaceable = _has_type(path, stat.S_ISREG) or _has_type(path, stat.S_ISLNK)
    if not replaceable:
        raise not_a_result_error(path)


def not_a_result_error(path: Path) -> OutputError:
    """Return the error that something is not part of a result."""
    return OutputError(
        "is not a file of an earlier result",
        where=path,
        remedy="move it away, or choose another --out",
    )


def clear(staging: Path, names: Names) -> bool:
    """Remove a staging folder with the files of a result in it, and return whether it is removed.

    Links are never followed, and other files stay.
    """
    if not os.path.lexists(staging):
        return True
    if not _has_type(staging, stat.S_ISDIR):
        return False
    _clear_folder(staging / _ASIDE, names)
    _clear_folder(staging, names)
    return not os.path.lexists(staging)


def _clear_folder(folder: Path, names: Names) -> None:
    if not _has_type(folder, stat.S_ISDIR):
        return
    for path in list(folder.iterdir()):
        inner = names.folder(path.name)
        if inner is not None:
            _clear_folder(path, inner)
        elif names.file(path.name) or _TEMPORARY_NAME.fullmatch(path.name):
            with suppress(OSError):
                path.unlink()
    with suppress(OSError):
        folder.rmdir()


def _has_type(path: Path, test: Callable[[int], bool]) -> bool:
    try:
        return test(path.lstat().st_mode)
    except OSError:
        return False
