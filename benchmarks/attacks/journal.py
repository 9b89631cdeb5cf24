"""A journal of completed attacks, so that a long benchmark can be continued."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Piece:
    """Some attacks of one kind: how many were tried, how many passed, and the faults found."""

    name: str
    number: int
    tried: int
    passed: int
    faults: tuple[str, ...] = ()


class Journal:
    """The completed pieces, in a file of JSON lines, or only in memory if none is given."""

    def __init__(self, path: Path | None, settings: dict[str, object]) -> None:
        """Read the file if it exists.

        Raises
        ------
        SystemExit
            If it was written with other settings.
        """
        self._path = path
        self.pieces: dict[tuple[str, int], Piece] = {}
        if path is None:
            return
        if path.exists():
            first, *rest = path.read_text().splitlines()
            if json.loads(first) != settings:
                raise SystemExit(f"{path}: was written with other settings: {first}")
            for line in rest:
                piece = Piece(**json.loads(line))
                self.pieces[piece.name, piece.number] = piece
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(settings) + "\n")

    def do(self, name: str, number: int, work: Callable[[], tuple[int, list[str]]]) -> None:
        """Run a piece unless it is completed; `work` returns the number of attacks, and faults."""
        if (name, number) in self.pieces:
            return
        tried, faults = work()
        for fault in faults:
            print(f"{name}, {fault}", flush=True)
        piece = Piece(name, number, tried, tried - len(faults), tuple(faults))
        self.pieces[name, number] = piece
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(json.dumps(asdict(piece)) + "\n")

    def table(self) -> list[tuple[str, int, int]]:
        """Return name, tried and passed of each kind."""
        rows: dict[str, tuple[int, int]] = {}
        for piece in self.pieces.values():
            tried, passed = rows.get(piece.name, (0, 0))
            rows[piece.name] = tried + piece.tried, passed + piece.passed
        return [(name, *counts) for name, counts in rows.items()]
