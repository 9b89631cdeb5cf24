"""Where the methods of the thesis and of its references are implemented: tables of docs/thesis.md.

The rows are in thesis.toml: places of the thesis, and works that it cites. `where` names files
below `src/tofuse/` or of the repository, `part` the kind and name of a part, `shown` the test or
page that shows what the work claims. All of them are checked: what is not there is an error.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from tofuse.engine import parts
from tofuse.engine.mapping.config import PACKAGES

ROOT = Path(__file__).resolve().parents[1]
ROWS = Path(__file__).with_name("thesis.toml")
PLACES = ("theory", "implementation", "results")  # of the thesis: chapters 2, 3, and 4 to 8
NAMES = (*PLACES, "works")


def table(name: str) -> str:
    """Return a table of places in the thesis, or of the works that it cites.

    Raises
    ------
    ValueError
        If a row names a file or part that does not exist.
    """
    for package in PACKAGES:
        parts.discover(package)
    found = tomllib.loads(ROWS.read_text("utf-8"))[name]
    lines = ["| In the thesis | What | Where |", "|---|---|---|"]
    if name == "works":
        lines = ["| Work | What | Part | Where | Shown by |", "|---|---|---|---|---|"]
    for row in found:
        check_files(f"{row['where']} {row.get('shown', '')}")
        first = row["work"] if name == "works" else row["place"]
        cells = [first, row["what"], row["where"]]
        if name == "works":
            cells[2:2] = [named_part(row["part"]) if row["part"] else ""]
            cells.append(row["shown"])
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def named_part(text: str) -> str:
    """Kind, name and label of a part, for the table."""
    kind, name = text.split()
    if name not in parts.registered(kind):
        raise ValueError(f"there is no {kind} {name!r}")
    return f"{kind} `{name}`, {parts.registered(kind)[name].part_label}"  # type: ignore[attr-defined]


def check_files(text: str) -> None:
    """Raise ValueError if a file or folder that the text names is not there."""
    for name in re.findall(r"`([\w/]+(?:\.py|/))`", text):
        if not any((ROOT / base / name).exists() for base in ("src/tofuse", ".")):
            raise ValueError(f"{name} is not there")
