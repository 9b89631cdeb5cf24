"""Boards of the leaderboard: tasks on which methods are compared. Each file is one board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from tofuse.engine import parts
from tofuse.engine.mapping.config import PACKAGES

Score = Mapping[str, float]


class Board(Protocol):
    """Methods, cases, and the evaluation of a method on a case.

    Attributes
    ----------
    name, title
        Short name for files, and title of the section.
    columns
        Column titles by the names of groups of cases.
    """

    name: str
    title: str
    columns: Mapping[str, str]

    def methods(self) -> Sequence[str]:
        """Labels of all methods that can run here, including newly registered parts."""
        ...

    def cases(self, seeds: int) -> Sequence[str]:
        """Names of all cases, ``group/scene/...``."""
        ...

    def prepare(self, data: Path) -> None:
        """Simulate recordings that are missing, before several processes read them."""

    def run(self, method: str, case: str, data: Path) -> Score | None:
        """Return scores; None if the method does not support the case, or data is missing."""
        ...

    def cell(self, scores: Sequence[Score]) -> str:
        """Summarise the scores of a method in a group of cases."""
        ...

    def merit(self, scores: Sequence[Score]) -> float:
        """Return the figure of merit by which rows are sorted; more is better."""
        ...


@cache
def _discover() -> None:
    for package in PACKAGES:
        parts.discover(package)


def default_made(kind: str) -> dict[str, Any]:
    """All parts of a kind that need no options, with their defaults, by name."""
    _discover()
    out = {}
    for name, cls in parts.registered(kind).items():
        try:
            out[name] = cls()
        except TypeError:
            continue  # it is composed of other parts
    return out
