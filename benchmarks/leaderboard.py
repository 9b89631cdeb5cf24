"""Ranking of all methods on the same views, graphs and recordings, as a page of tables.

Every part registered in the package is a row. The result of each method for each case is a file in
benchmarks/out/leaderboard, so that the command continues where it was stopped; `--fresh` starts
over. Cases are distributed over processes of this machine, or over the workers of a Dask cluster
(with a shared file system). Peers take part if they are installed.

    python benchmarks/leaderboard.py [--boards pairs graphs sequences] [--seeds 4] [--workers 2]
    python benchmarks/leaderboard.py --scheduler tcp://host:8786
    python benchmarks/leaderboard.py --page leaderboard.md
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from boards import Board, Score
from boards.graphs import Graphs
from boards.sequences_board import Sequences
from boards.statements import statements
from boards.two_views import TwoViews
from sequences import DATA, OUT
from tofuse.engine.compute.thread_pool import threads
from tofuse.formats.files.atomic import write_text

BOARDS: dict[str, Board] = {board.name: board for board in (TwoViews(), Graphs(), Sequences())}
KEPT = OUT / "leaderboard"


def kept(board: str, method: str, case: str) -> Path:
    """Return the file with the result of a method for a case."""
    plain = re.sub(r"[^\w.-]+", "_", f"{method} {case}")
    mark = hashlib.sha256(f"{method}\0{case}".encode()).hexdigest()[:8]
    return KEPT / board / f"{plain}-{mark}.json"


def done(board: str, method: str, case: str, data: Path) -> None:
    """Run a method on a case, on one thread, and store the result."""
    with threads(1):
        score = BOARDS[board].run(method, case, data)
    file = kept(board, method, case)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_text(file, json.dumps(None if score is None else dict(score)))


def run_missing(
    names: Sequence[str], seeds: int, data: Path, executor: Executor, methods: Sequence[str]
) -> None:
    """Run the cases without a result."""
    todo = [
        (board, method, case)
        for board in names
        for case in BOARDS[board].cases(seeds)
        for method in BOARDS[board].methods()
        if (not methods or method in methods) and not kept(board, method, case).exists()
    ]
    for board in names if todo else ():
        BOARDS[board].prepare(data)
    futures = {executor.submit(done, *task, data): task for task in todo}
    for count, future in enumerate(as_completed(futures), 1):
        board, method, case = futures[future]
        error = future.exception()
        if error is not None:
            print(f"{board}, {method}, {case}: {error!r}", file=sys.stderr)
        if count % 50 == 0 or count == len(todo):
            print(f"{count} of {len(todo)}", file=sys.stderr, flush=True)


def scores_of(board: Board, seeds: int) -> dict[str, dict[str, list[Score]]]:
    """Stored scores by method and group of cases."""
    out: dict[str, dict[str, list[Score]]] = {}
    for method in board.methods():
        for case in board.cases(seeds):
            file = kept(board.name, method, case)
            score = json.loads(file.read_text("utf-8")) if file.exists() else None
            if score is not None:
                out.setdefault(method, {}).setdefault(case.split("/")[0], []).append(score)
    return out


def table(board: Board, scores: Mapping[str, Mapping[str, Sequence[Score]]]) -> str:
    """The rows of a board, the best first."""
    lines = [
        f"| Method | {' | '.join(board.columns.values())} | CPU ms |",
        "|" + "---|" * (len(board.columns) + 2),
    ]

    def every(method: str) -> list[Score]:
        return [s for some in scores[method].values() for s in some]

    # Mean over groups; groups that a method does not support count as zero.
    order = sorted(
        scores,
        key=lambda m: (
            -np.mean([board.merit(scores[m][g]) if g in scores[m] else 0 for g in board.columns]),
            m,
        ),
    )
    for method in order:
        cells = [
            board.cell(scores[method][g]) if g in scores[method] else "" for g in board.columns
        ]
        ms = 1000 * np.median([s["seconds"] for s in every(method)])
        lines.append(f"| {method} | {' | '.join(cells)} | {ms:.0f} |")
    return "\n".join(lines)


def page(names: Sequence[str], seeds: int) -> str:
    """All tables and statements, as Markdown."""
    found = {name: scores_of(BOARDS[name], seeds) for name in names}
    out = []
    for name in names:
        out += [f"## {BOARDS[name].title}", "", table(BOARDS[name], found[name]), ""]
    out += ["## Claims of the papers", "", "| Paper | Claim | Result |", "|---|---|---|"]
    out += [f"| {paper} | {claim} | {here} |" for paper, claim, here in statements(found)]
    return "\n".join(out) + "\n"


def executor_of(scheduler: str | None, workers: int) -> Executor:
    """Processes of this machine, or workers of a cluster."""
    if scheduler is None:
        return ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    from distributed import Client

    executor: Any = Client(scheduler).get_executor()
    return executor  # type: ignore[no-any-return]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--boards", nargs="+", choices=[*BOARDS], default=[*BOARDS])
    parser.add_argument("--methods", nargs="+", default=[], help="run only these methods")
    parser.add_argument("--seeds", type=int, default=4, help="seeds per case")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--scheduler")
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("--page", type=Path, help="file to write the tables to")
    parser.add_argument("--data", type=Path, default=DATA)
    options = parser.parse_args(arguments)
    if options.fresh:
        shutil.rmtree(KEPT, ignore_errors=True)
    with executor_of(options.scheduler, options.workers) as executor:
        run_missing(options.boards, options.seeds, options.data, executor, options.methods)
    text = page(options.boards, options.seeds)
    if options.page is None:
        print(text)
        return
    write_text(options.page, text)


if __name__ == "__main__":
    main()
