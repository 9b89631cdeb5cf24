"""Moving a set of files into a folder: all of them or none, whatever stops the program.

The files lie in a staging folder inside. A plan there says which go where, and which earlier ones
they take the place of. It is written, and on the disk, before the first move, and removed after the
last. So after a power cut either there is no plan, and nothing has moved; or the plan is there, and
`recover` finishes what it says. Each move is one rename, of a file or of a whole folder of them.

A plan is believed only as far as it can be checked: it may name what a result is made of, and
nothing else, and each thing must be what it was when the plan was made.
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
_SAME_TIME_S = 2.0  # what file systems round times of change to
_PART = re.compile(r"\..*\.part(\.\w+)?|\..*\.unfinished")  # what was being written

# What a file was: its kind, size in bytes and time of change in s; of a folder, what its files
# were.
Mark = tuple[str, int, float] | dict[str, Any]


@dataclass(frozen=True)
class Names:
    """What a result is made of: files, and folders that hold certain ones and nothing else.

    Attributes
    ----------
    files, more
        Names of files, and what further ones are like.
    folders
        What names of folders are like, and what is in them.
    """

    files: frozenset[str]
    folders: tuple[tuple[re.Pattern[str], Names], ...] = ()
    more: re.Pattern[str] | None = None

    def file(self, name: str) -> bool:
        """Whether it is the name of a file."""
        return name in self.files or bool(self.more and self.more.fullmatch(name))

    def folder(self, name: str) -> Names | None:
        """Return what a folder of this name holds; None if it is no name of a folder."""
        return next((inner for like, inner in self.folders if like.fullmatch(name)), None)

    def is_whole(self, folder: Path) -> bool:
        """Whether something is such a folder: no links, and nothing else inside."""
        inner = self.folder(folder.name)
        return (
            inner is not None
            and _is(folder, stat.S_ISDIR)
            and all(
                inner.is_whole(p) or (inner.file(p.name) and _is(p, stat.S_ISREG))
                for p in folder.iterdir()
            )
        )


class _UntrueError(Exception):
    """Says what is wrong with a plan."""


@dataclass(frozen=True)
class _Plan:
    """What is moved into place, and what is moved aside before, in that order.

    The first of the old is the last of the new: the file that says that all others are there.
    """

    new: dict[str, Mark]
    old: dict[str, Mark]

    def carry_out(self, staging: Path, folder: Path) -> None:
        """Move, or go on with it."""
        for name in self.old:
            if not os.path.lexists(staging / _ASIDE / name):
                os.replace(folder / name, staging / _ASIDE / name)
        for name in self.new:
            if os.path.lexists(staging / name):
                os.replace(staging / name, folder / name)

    def undo(self, staging: Path, folder: Path) -> None:
        """Move back, or go on with it."""
        for name in reversed(self.new):
            if not os.path.lexists(staging / name):
                os.replace(folder / name, staging / name)
        for name in reversed(self.old):
            if os.path.lexists(staging / _ASIDE / name):
                os.replace(staging / _ASIDE / name, folder / name)

    def check(self, names: Names, staging: Path, folder: Path) -> None:
        """Refuse what is not where the plan says, or is not what it was."""
        for name, mark in self.old.items():
            aside = staging / _ASIDE / name
            _check(aside if os.path.lexists(aside) else folder / name, mark, names)
        for name, mark in self.new.items():
            staged = staging / name
            _check(staged if os.path.lexists(staged) else folder / name, mark, names)


def move_all(staging: Path, folder: Path, names: Names, marker: str) -> None:
    """Move all that is staged into a folder, in place of what has the names of a result there.

    All is moved, or, if that fails, nothing.

    Parameters
    ----------
    marker
        The file that goes away first and comes last: where it is, everything is of one result.

    Raises
    ------
    OutputError
        If something is in the way that is no part of a result.
    OSError
        If it fails; what was there before is there again.
    """
    new = sorted((p.name for p in staging.iterdir()), key=lambda n: (n == marker, n))
    there = sorted((p.name for p in folder.iterdir()), key=lambda n: (n != marker, n))
    old = [n for n in there if n in new or names.file(n) or names.is_whole(folder / n)]
    for name in old:
        check_replaceable(folder / name, names)
    plan = _Plan(
        {name: _mark(staging / name, names) for name in new},
        {name: _mark(folder / name, names) for name in old},
    )
    (staging / _ASIDE).mkdir()
    sync_tree(staging)
    with replacing(staging / _FORWARD, durable=True) as beside:
        beside.write_text(json.dumps(asdict(plan)), encoding="utf-8")
    try:
        plan.carry_out(staging, folder)
    except BaseException:
        os.replace(staging / _FORWARD, staging / _BACK)
        plan.undo(staging, folder)
        _end(staging, folder, _BACK)
        raise
    _end(staging, folder, _FORWARD)


def _end(staging: Path, folder: Path, name: str) -> None:
    """Let go of a plan that is carried out."""
    sync(folder)
    sync(staging)
    (staging / name).unlink()


def is_stopped(staging: Path) -> bool:
    """Whether moves were begun and not ended: nobody may read the folder before `recover`."""
    return any(os.path.lexists(staging / name) for name in (_FORWARD, _BACK))


def places(staging: Path, folder: Path) -> tuple[Path, ...]:
    """Where the files of the old and the new result are while moves go on."""
    return (folder, staging / _ASIDE, staging)


def recover(staging: Path, folder: Path, names: Names, marker: str) -> None:
    """Finish the moves of a program that was stopped at them; nothing where there were none.

    Raises
    ------
    OutputError
        If what it left can't be trusted; then nothing is touched.
    OSError
        If a move fails; it can be tried again.
    """
    for name, way in ((_BACK, _Plan.undo), (_FORWARD, _Plan.carry_out)):
        if not os.path.lexists(staging / name):
            continue
        plan = checked_plan(staging, names, marker, name)
        try:
            plan.check(names, staging, folder)
        except _UntrueError as untrue:
            raise _untrusted(staging / name, untrue) from None
        way(plan, staging, folder)
        _end(staging, folder, name)


def check_stopped(staging: Path, names: Names, marker: str) -> None:
    """Refuse a plan that says what no program of ours says, without looking at what it names.

    Raises
    ------
    OutputError
        If there is such a plan.
    """
    for name in (_BACK, _FORWARD):
        if os.path.lexists(staging / name):
            checked_plan(staging, names, marker, name)


def checked_plan(staging: Path, names: Names, marker: str, name: str) -> _Plan:
    """Return a plan of which all names and kinds are those of a result."""
    path = staging / name
    try:
        for part in (staging, staging / _ASIDE):
            if not _is(part, stat.S_ISDIR):
                raise _UntrueError(f"{part.name} is no folder")
        if not _is(path, stat.S_ISREG) or path.stat().st_size > _MAX_PLAN_BYTES:
            raise _UntrueError("it is no small file")
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError):
            raise _UntrueError("it is not JSON") from None
        if not isinstance(data, dict) or set(data) != {"new", "old"}:
            raise _UntrueError("it is no plan")
        plan = _Plan(*(_marks(data[key], names, key) for key in ("new", "old")))
        if plan.old and next(iter(plan.old)) != marker:
            raise _UntrueError("it replaces what is no result")
        if plan.new and list(plan.new)[-1] != marker:
            raise _UntrueError("it makes no result")
        return plan
    except _UntrueError as untrue:
        raise _untrusted(path, untrue) from None
    except OSError as error:
        raise _untrusted(path, error.strerror or error) from error


def _untrusted(path: Path, why: object) -> OutputError:
    return OutputError(
        f"was not left by this program, or has changed since ({why}); nothing was touched",
        where=path,
        remedy=f"move {path.parent.name} away if it is not yours, or give another --out",
    )


def _marks(data: object, names: Names, key: str) -> dict[str, Mark]:
    if not isinstance(data, dict):
        raise _UntrueError("it is no plan")
    found: dict[str, Mark] = {}
    for name, mark in data.items():
        inner = names.folder(name)
        if names.file(name) and _is_mark(mark, ("file", "link") if key == "old" else ("file",)):
            found[name] = tuple(mark)
        elif inner is not None and isinstance(mark, dict):
            found[name] = _marks(mark, inner, "within")
        else:
            raise _UntrueError(f"it names {name!r:.80}")
    return found


def _is_mark(mark: object, kinds: tuple[str, ...] = ("file",)) -> bool:
    return (
        isinstance(mark, list)
        and len(mark) == 3
        and mark[0] in kinds
        and type(mark[1]) is int
        and type(mark[2]) in (int, float)
    )


def _mark(path: Path, names: Names) -> Mark:
    """What something of a result is."""
    status = path.lstat()
    inner = names.folder(path.name)
    if inner is not None and stat.S_ISDIR(status.st_mode) and names.is_whole(path):
        return {p.name: _mark(p, inner) for p in sorted(path.iterdir())}
    for kind, test in (("file", stat.S_ISREG), ("link", stat.S_ISLNK)):
        if test(status.st_mode) and names.file(path.name):
            return (kind, status.st_size, status.st_mtime)
    raise check_error(path)


def _check(path: Path, mark: Mark, names: Names) -> None:
    """Refuse what is not what it was."""
    try:
        now = _mark(path, names)
    except (OSError, OutputError):
        raise _UntrueError(f"{path.name} is not what it was") from None
    if not _same(now, mark):
        raise _UntrueError(f"{path.name} is not what it was")


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return set(a) == set(b) and all(_same(a[name], b[name]) for name in a)
    if isinstance(a, dict) or isinstance(b, dict):
        return False
    return bool(a[:2] == b[:2] and abs(a[2] - b[2]) <= _SAME_TIME_S)


def check_replaceable(path: Path, names: Names) -> None:
    """Refuse to replace what only has the name of something of a result.

    Raises
    ------
    OutputError
        If it is a folder in place of a file, or a folder that somebody has put something into.
    """
    if names.folder(path.name):
        good = names.is_whole(path)
    else:
        good = _is(path, stat.S_ISREG) or _is(path, stat.S_ISLNK)
    if not good:
        raise check_error(path)


def check_error(path: Path) -> OutputError:
    """Say that something is no part of a result."""
    return OutputError(
        "holds something other than the files of an earlier result",
        where=path,
        remedy="move it away, or give another --out",
    )


def clear(staging: Path, names: Names) -> bool:
    """Remove a staging folder, as far as it holds what is staged; whether all of it is gone.

    Links are never followed, and what has no name of ours stays.
    """
    if not os.path.lexists(staging):
        return True
    if not _is(staging, stat.S_ISDIR):
        return False
    _clear_folder(staging / _ASIDE, names)
    _clear_folder(staging, names)
    return not os.path.lexists(staging)


def _clear_folder(folder: Path, names: Names) -> None:
    if not _is(folder, stat.S_ISDIR):
        return
    for path in list(folder.iterdir()):
        inner = names.folder(path.name)
        if inner is not None:
            _clear_folder(path, inner)
        elif names.file(path.name) or _PART.fullmatch(path.name):
            with suppress(OSError):
                path.unlink()
    with suppress(OSError):
        folder.rmdir()


def _is(path: Path, test: Callable[[int], bool]) -> bool:
    try:
        return test(path.lstat().st_mode)
    except OSError:
        return False
