"""What was tried so far, one line for each piece, so that a long benchmark can be done in parts."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Piece:
    """Some attempts of one kind: how many, how many held, and what was wrong with the others."""

    name: str
    number: int
    tried: int
    held: int
    faults: tuple[str, ...] = ()


class Journal:
    """Pieces that are done, in a file of JSON lines; in memory alone where none is given."""

    def __init__(self, path: Path | None, settings: dict[str, object]) -> None:
        """Read what there is.

        Raises
        ------
        SystemExit
            If it is the journal of other settings.
        """
        self._path = path
        self.pieces: dict[tuple[str, int], Piece] = {}
        if path is None:
            return
        if path.exists():
            first, *rest = path.read_text().splitlines()
            if json.loads(first) != settings:
                raise SystemExit(f"{path} is of other settings: {first}")
            for line in rest:
                piece = Piece(**json.loads(line))
                self.pieces[piece.name, piece.number] = piece
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(settings) + "\n")

    def do(self, name: str, number: int, work: Callable[[], tuple[int, list[str]]]) -> None:
        """Do a piece unless it is done; `work` gives how many were tried, and a line per fault."""
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
        """Name, tried and held of each kind."""
        rows: dict[str, tuple[int, int]] = {}
        for piece in self.pieces.values():
            tried, held = rows.get(piece.name, (0, 0))
            rows[piece.name] = tried + piece.tried, held + piece.held
        return [(name, *counts) for name, counts in rows.items()]
