"""Options of `tofuse run` in the columns of a table, checked as its parser does."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import NoReturn

from tofuse.cli.parser import Parser, make_parser
from tofuse.errors import InputError

# What a batch decides itself, and what is for somebody who watches.
_NOT_HERE = {
    "out",
    "overwrite",
    "into",
    "rig",
    "json",
    "view",
    "port",
    "no-open",
    "threads",
    "scheduler",
    "help",
}
_YES, _NO = {"true", "yes", "1", "x"}, {"false", "no", "0"}


class _Strict(Parser):
    """Raises where it would exit."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


@cache
def _options() -> dict[str, argparse.Action]:
    """Options of `tofuse run` that a table may have, by name."""
    found = make_parser().parse_args(["run", ".", "--out", "."]).parser._option_string_actions
    names = {word.removeprefix("--"): action for word, action in found.items()}
    return {n: a for n, a in names.items() if not n.startswith("-") and n not in _NOT_HERE}


def run_words(cells: Mapping[str, str], base: Path, where: str) -> tuple[str, ...]:
    """Turn options of a table into words of `tofuse run`, with paths from `base` made absolute.

    Raises
    ------
    InputError
        If `tofuse run` would not understand them.
    """
    words = []
    for column, value in cells.items():
        name = column.replace("_", "-")
        action = _options().get(name)
        if action is None:
            near = get_close_matches(name, _options(), 1)
            raise InputError(
                f"{column} is no option of `tofuse run` for a table",
                where=where,
                remedy=f"did you mean {near[0]}?" if near else "see docs/batch.md",
            )
        if action.nargs == 0:
            if value.lower() not in _YES | _NO:
                raise InputError(f"{column} is {value!r}", where=where, remedy="give yes or no")
            words += [f"--{name}"] * (value.lower() in _YES)
        else:
            path = action.type is Path
            words.append(
                f"--{name}={os.path.join(base, os.path.expanduser(value)) if path else value}"
            )
    _check(tuple(words), where)
    return tuple(words)


def _check(words: tuple[str, ...], where: str) -> None:
    problem = _problem(words)
    if problem:
        raise InputError(problem, where=where)


@cache
def _problem(words: tuple[str, ...]) -> str:
    try:
        make_parser(_Strict).parse_args(["run", ".", "--out", ".", *words])
    except InputError as error:
        return str(error)
    return ""
