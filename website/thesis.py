"""Where the methods of the thesis and of its references are implemented: tables of docs/thesis.md.

    python website/thesis.py          write them into the page
    python website/thesis.py --check  end with status 1 if the page says otherwise

The rows are in thesis.toml: places of the thesis, and works that it cites. `where` names files
below `src/tofuse/` or of the repository, `part` the kind and name of a part, `shown` the test or
page that shows what the work claims. All of them are checked: what is not there is an error.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

from tofuse.engine import parts
from tofuse.engine.mapping.config import PACKAGES

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "thesis.md"
ROWS = Path(__file__).with_name("thesis.toml")
PLACES = {
    "theory": "Theory (chapter 2)",
    "implementation": "Implementation (chapter 3)",
    "results": "Test cases and results (chapters 4 to 8)",
}


def tables() -> dict[str, str]:
    """Return the tables by the headings that they follow; ValueError for what is not there."""
    for package in PACKAGES:
        parts.discover(package)
    rows = tomllib.loads(ROWS.read_text("utf-8"))
    out = {}
    for key, heading in PLACES.items():
        lines = ["| In the thesis | What | Where |", "|---|---|---|"]
        for row in rows[key]:
            check_files(row["where"])
            lines.append(f"| {row['place']} | {row['what']} | {row['where']} |")
        out[heading] = "\n".join(lines)
    lines = ["| Work | What | Part | Where | Shown by |", "|---|---|---|---|---|"]
    for row in rows["works"]:
        check_files(f"{row['where']} {row['shown']}")
        part = named_part(row["part"]) if row["part"] else ""
        lines.append(
            f"| {row['work']} | {row['what']} | {part} | {row['where']} | {row['shown']} |"
        )
    out["Works that it cites"] = "\n".join(lines)
    return out


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


def written(page: str) -> str:
    """Return the page with its tables as they should be."""
    for heading, table in tables().items():
        pattern = rf"(## {re.escape(heading)}\n(?:(?!## )(?:[^|\n][^\n]*)?\n)*)(?:\|[^\n]*\n)+"
        page, count = re.subn(pattern, lambda m, t=table: f"{m[1]}{t}\n", page, count=1)
        if count != 1:
            raise ValueError(f"{PAGE.name} has no table below {heading!r}")
    return page


def main() -> int:
    """Write the page, or compare it."""
    before = PAGE.read_text("utf-8")
    after = written(before)
    if "--check" in sys.argv[1:]:
        return int(before != after)
    PAGE.write_text(after, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
