"""Boards of the leaderboard: what methods are compared on. Each file is one board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from tofuse import parts
from tofuse.pipeline.config import PACKAGES

Score = Mapping[str, float]


class Board(Protocol):
    """Methods, cases, and what a method makes of a case.

    Attributes
    ----------
    name, title
        Short, for files; and for people.
    columns
        Titles of the table by the names of groups of cases.
    """

    name: str
    title: str
    columns: Mapping[str, str]

    def methods(self) -> Sequence[str]:
        """Labels of all methods that can run here; new parts are among them by themselves."""
        ...

    def cases(self, seeds: int) -> Sequence[str]:
        """Names of all cases, ``group/scene/...``."""
        ...

    def run(self, method: str, case: str, data: Path) -> Score | None:
        """Return numbers; None where the method doesn't take such views, or the data is absent."""
        ...

    def cell(self, scores: Sequence[Score]) -> str:
        """Say in a few characters how a method did in a group of cases."""
        ...

    def merit(self, scores: Sequence[Score]) -> float:
        """Return how good that is, more is better: the order of the rows."""
        ...


@cache
def _discover() -> None:
    for package in PACKAGES:
        parts.discover(package)


def default_made(kind: str) -> dict[str, Any]:
    """All parts of a kind that need no options, made with their defaults, by name."""
    _discover()
    out = {}
    for name, cls in parts.known(kind).items():
        try:
            out[name] = cls()
        except TypeError:
            continue  # it is put together from others
    return out
