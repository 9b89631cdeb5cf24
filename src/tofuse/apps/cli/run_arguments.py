"""Options of `tofuse run` in the columns of a table, checked by its parser."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import NoReturn

from tofuse.apps.cli import values
from tofuse.apps.cli.parser import Parser, make_parser
from tofuse.engine.errors import InputError

# Options that the batch sets itself, and interactive ones.
_EXCLUDED = {*("out", "overwrite", "rig", "json", "view", "port", "no-open", "threads", "help")}
_YES, _NO = {"true", "yes", "1", "x"}, {"false", "no", "0"}


class _Strict(Parser):
    """Raises an error instead of exiting."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


@cache
def _options() -> dict[str, argparse.Action]:
    """Options of `tofuse run` that a table may have, by name."""
    actions = make_parser().parse_args(["run", ".", "--out", "."]).parser._option_string_actions
    names = {word.removeprefix("--"): action for word, action in actions.items()}
    return {n: a for n, a in names.items() if not n.startswith("-") and n not in _EXCLUDED}


def run_arguments(cells: Mapping[str, str], base: Path, where: str) -> tuple[str, ...]:
    """Convert the options of a row into command-line arguments of `tofuse run`.

    Parameters
    ----------
    cells
        Values of options, by their names.
    base
        Folder that relative paths refer to.
    where
        The row, for error messages.

    Raises
    ------
    InputError
        If `tofuse run` would not accept them.
    """
    arguments = []
    for column, value in cells.items():
        name = column.replace("_", "-")
        action = _options().get(name)
        if action is None:
            suggestions = get_close_matches(name, _options(), 1)
            raise InputError(
                f"{column} is not an option of `tofuse run` for a table",
                where=where,
                remedy=f"did you mean {suggestions[0]}?" if suggestions else "see docs/batch.md",
            )
        if action.nargs == 0:
            if value.lower() not in _YES | _NO:
                raise InputError(f"{column} is {value!r}", where=where, remedy="use yes or no")
            arguments += [f"--{name}"] * (value.lower() in _YES)
        else:
            is_path = action.type is values.path
            arguments.append(
                f"--{name}={os.path.join(base, os.path.expanduser(value)) if is_path else value}"
            )
    if problem := _problem(tuple(arguments)):
        raise InputError(problem, where=where)
    return tuple(arguments)


@cache
def _problem(arguments: tuple[str, ...]) -> str:
    """The problem with arguments of `tofuse run`; empty if there is none."""
    try:
        make_parser(_Strict).parse_args(["run", ".", "--out", ".", *arguments])
    except InputError as error:
        return str(error)
    return ""
