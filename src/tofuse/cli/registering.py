"""``tofuse register``: the summary of one pair."""

from __future__ import annotations

from tofuse.report import pair_words as words
from tofuse.results.pair import PairResult

_NAME_WIDTH = 14  # width of the column of names
Lines = list[tuple[str, str]]


def lines(result: PairResult) -> Lines:
    """Return name and value of each line that is printed below the verdict; names may be empty."""
    printed: Lines = [("translation", words.translation(result))]
    if displacement := words.moved_center(result):
        printed.append(("", displacement))
    printed.append(("rotation", words.rotation(result)))
    rows = words.matrix(result)
    printed += [("T_target_source", rows[0]), *(("", row) for row in rows[1:])]
    printed.append(("overlap", words.overlap(result)))
    printed.append(("rms distance", words.rms(result)))
    printed.append(("sigma", f"{words.sigma(result)} ({words.sigma_note(result)})"))
    if unobservable := words.unobservable(result):
        printed.append(("unobservable", f"{unobservable} (axes of the source)"))
    if runner_up := words.runner_up(result):
        printed.append(("runner-up", runner_up))
    return printed


def text(result: PairResult) -> list[str]:
    """Return the lines, names in a column."""
    width = max(_NAME_WIDTH, *(len(name) for name, _ in lines(result)))
    return [f"{name:<{width}}  {value}".rstrip() for name, value in lines(result)]
