"""A journal of completed attacks, so that a long benchmark can be continued."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


class Lines:
    """Records in a file of JSON lines, or only in memory if none is given.

    Attributes
    ----------
    records
        Those of the file, and those that were added.
    """

    def __init__(self, path: Path | None, settings: dict[str, object]) -> None:
        """Read the file if it exists.

        Raises
        ------
        SystemExit
            If it was written with other settings.
        """
        self._path = path
        self.records: list[dict[str, Any]] = []
        if path is None:
            return
        if path.exists():
            first, *rest = path.read_text().splitlines()
            if json.loads(first) != settings:
                raise SystemExit(f"{path}: was written with other settings: {first}")
            self.records = [json.loads(line) for line in rest]
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(settings) + "\n")

    def add(self, record: dict[str, Any]) -> None:
        """Add a record, to the file as well."""
        self.records.append(record)
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(json.dumps(record) + "\n")


@dataclass(frozen=True)
class Piece:
    """Some attacks of one kind: how many were tried, how many passed, and the faults found."""

    name: str
    number: int
    tried: int
    passed: int
    faults: tuple[str, ...] = ()


class Journal:
    """The completed pieces, in a file of `Lines`."""

    def __init__(self, path: Path | None, settings: dict[str, object]) -> None:
        """Read the file if it exists; SystemExit if it was written with other settings."""
        self._lines = Lines(path, settings)
        pieces = [Piece(**record) for record in self._lines.records]
        self.pieces = {(piece.name, piece.number): piece for piece in pieces}

    def do(self, name: str, number: int, work: Callable[[], tuple[int, list[str]]]) -> None:
        """Run a piece unless it is completed; `work` returns the number of attacks, and faults."""
        if (name, number) in self.pieces:
            return
        tried, faults = work()
        for fault in faults:
            print(f"{name}, {fault}", flush=True)
        piece = Piece(name, number, tried, tried - len(faults), tuple(faults))
        self.pieces[name, number] = piece
        self._lines.add(asdict(piece))

    def table(self) -> list[tuple[str, int, int]]:
        """Return name, tried and passed of each kind."""
        rows: dict[str, tuple[int, int]] = {}
        for piece in self.pieces.values():
            tried, passed = rows.get(piece.name, (0, 0))
            rows[piece.name] = tried + piece.tried, passed + piece.passed
        return [(name, *counts) for name, counts in rows.items()]
