"""``tofuse register``: the summary of one pair."""

from __future__ import annotations

from tofuse.report import pair_words as words
from tofuse.results.pair import PairResult

_NAMES = 14  # width of the column of names
Lines = list[tuple[str, str]]


def lines(result: PairResult) -> Lines:
    """Return name and value of each line that is printed below the verdict; names may be empty."""
    found: Lines = [("translation", words.translation(result))]
    if moved := words.moved_center(result):
        found.append(("", moved))
    found.append(("rotation", words.rotation(result)))
    rows = words.matrix(result)
    found += [("T_target_source", rows[0]), *(("", row) for row in rows[1:])]
    found.append(("overlap", words.overlap(result)))
    found.append(("rms distance", words.rms(result)))
    found.append(("sigma", f"{words.sigma(result)} ({words.sigma_note(result)})"))
    if free := words.unobservable(result):
        found.append(("unobservable", f"{free} (axes of the source)"))
    if other := words.runner_up(result):
        found.append(("runner-up", other))
    return found


def text(result: PairResult) -> list[str]:
    """Return the lines, names in a column."""
    width = max(_NAMES, *(len(name) for name, _ in lines(result)))
    return [f"{name:<{width}}  {value}".rstrip() for name, value in lines(result)]
