"""``tofuse register``: the summary of one pair."""

from __future__ import annotations

from tofuse.apps.pairs import PairResult, lines

_NAME_WIDTH = 14  # width of the column of names


def text(result: PairResult) -> list[str]:
    """Return the lines that are printed below the verdict, names in a column."""
    found = lines(result)
    width = max(_NAME_WIDTH, *(len(name) for name, _ in found))
    return [
        f"{name if k == 0 else '':<{width}}  {row}".rstrip()
        for name, value in found
        for k, row in enumerate(value.split("\n"))
    ]
