"""Attacks on the boundary of the program, of the kinds in `attacks/`.

Fuzzed files, power cuts, hostile environments, damaged caches of kernels, edited results, changed
pairs of clouds, and forked processes.

    python benchmarks/attack.py [--quick] [--files N] [--cuts N] [--limit N] [--only KIND]
                                [--journal FILE] [--minutes M]

Prints how many of each kind were tried and how many passed; exits with 1 if any failed. The
guarantees that are tested are in docs/reliability.md. All of it takes hours. With a journal, a
stopped run continues where it, or `--minutes`, ended; the table then covers all runs.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np

from attacks import caches, contradictions, forks, metamorphic, mutation
from attacks.environments import ENVIRONMENTS, Environment, attempt
from attacks.journal import Journal
from attacks.power import Power, PowerCut

FILES, CUTS = 20_000, 500
QUICK_FILES, QUICK_CUTS = 300, 60
FILES_IN_PIECE, CUTS_IN_PIECE = 200, 25
CACHES, METAMORPHIC = 100, 200
QUICK_LIMIT = 12
PAIRS = 5  # of unchanged clouds
KINDS = ("files", "cuts", "environments", "caches", "contradictions", "metamorphic", "forks")

T = TypeVar("T")
Work = Callable[[], tuple[int, list[str]]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="some hundreds of attacks")
    parser.add_argument("--files", type=int, help=f"total of fuzzed files; default {FILES}")
    parser.add_argument("--cuts", type=int, help=f"power cuts; default {CUTS}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=int, help="at most this number of each other kind")
    parser.add_argument("--only", choices=KINDS)
    parser.add_argument("--journal", type=Path, help="file of completed attacks, to continue from")
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="start no attack after that time"
    )
    arguments = parser.parse_args()
    quick, only = arguments.quick, arguments.only
    files = arguments.files or (QUICK_FILES if quick else FILES)
    cuts = arguments.cuts or (QUICK_CUTS if quick else CUTS)
    limit = arguments.limit or (QUICK_LIMIT if quick else sys.maxsize)
    begun = time.monotonic()
    journal = Journal(arguments.journal, {"seed": arguments.seed, "files": files, "cuts": cuts})
    with tempfile.TemporaryDirectory() as base:
        plan = {
            "cuts": lambda: power_cuts(cuts, arguments.seed),
            "environments": lambda: environments(limit, Path(base)),
            "caches": lambda: damaged_caches(limit, arguments.seed, Path(base)),
            "contradictions": lambda: edited_results(limit, Path(base)),
            "metamorphic": lambda: changed_pairs(limit, arguments.seed),
            "forks": lambda: forked(limit),
            "files": lambda: fuzzed_files(files, arguments.seed),
        }
        work = [part() for name, part in plan.items() if only in (None, name)]
        left = False
        for name, number, attack in itertools.chain(*work):
            left = time.monotonic() - begun > 60 * arguments.minutes
            if left:
                break
            journal.do(name, number, attack)
    rows = journal.table()
    print(f"\n{'attack':40} {'tried':>7} {'passed':>7}")
    for name, tried, passed in rows:
        print(f"{name:40} {tried:7} {passed:7}")
    tried, passed = (sum(row[k] for row in rows) for k in (1, 2))
    print(f"{'all':40} {tried:7} {passed:7}{'  (incomplete)' if left else ''}")
    return 0 if tried == passed else 1


def pieces(total: int, size: int) -> Iterator[tuple[int, int, int]]:
    """Split `total` attacks into pieces: number, first and count of each."""
    for number, first in enumerate(range(0, total, size)):
        yield number, first, min(size, total - first)


def fuzzed_files(total: int, seed: int) -> Iterator[tuple[str, int, Work]]:
    """Fuzzed files, the same number of each format."""
    subjects = mutation.subjects()
    each = -(-total // len(subjects))

    def work(name: str, first: int, count: int) -> tuple[int, list[str]]:
        outcomes = mutation.run(name, count, 1_000_000 * seed + first)
        return count, [f"seed {k}: {result}" for k, result in outcomes if result not in PASSED]

    for number, first, count in pieces(each, FILES_IN_PIECE):
        for name in reversed(subjects):  # the small ones first
            yield f"fuzzed: {name}", number, lambda n=name, f=first, c=count: work(n, f, c)


PASSED = ("read", "rejected")


def power_cuts(total: int, seed: int) -> Iterator[tuple[str, int, Work]]:
    """Power cuts at random system calls, in writing a result and in up to three recoveries."""
    for number, first, count in pieces(total, CUTS_IN_PIECE):
        yield (
            "power cuts while a result is written",
            number,
            lambda f=first, c=count: cuts(f, c, seed),
        )


def cuts(first: int, count: int, seed: int) -> tuple[int, list[str]]:
    """Power cuts with the seeds from `first`."""
    mutation.subjects()  # adds tests/helpers to the import path
    import made_results
    from tofuse.apps.results.folders import OutputFolder, finish_interrupted, is_result
    from tofuse.apps.results.output import write_result

    def write(folder: Path, number: int) -> None:
        write_result(made_results.torn(seed=number), OutputFolder(folder, overwrite=True))

    def shown(folder: Path) -> dict[str, bytes]:
        found = made_results.contents(folder)
        return {n: data for n, data in found.items() if not n.startswith(".tofuse-")}

    faults = []
    with tempfile.TemporaryDirectory() as base:
        results = {}
        for number in (1, 2):
            write(Path(base) / f"whole-{number}", number)
            results[number] = shown(Path(base) / f"whole-{number}")
        for k in range(first, first + count):
            rng = np.random.default_rng([seed, k])
            folder = Path(base) / f"cut-{k:06}" / "out"
            write(folder, 1)
            (folder / "recording").mkdir()
            (folder / "recording" / "mine.txt").write_bytes(b"mine")
            for job in itertools.chain(
                [lambda f: write(f, 2)], [finish_interrupted] * int(rng.integers(4))
            ):
                power = Power(int(rng.integers(60)))
                with power.connected(), suppress(PowerCut):
                    job(folder)
                if power.off:
                    power.lose(folder.parent)
            try:
                finish_interrupted(folder)
                OutputFolder(folder, overwrite=True).discard()
                found = made_results.contents(folder)
                mine = found.pop("recording/mine.txt", None)
                if mine != b"mine" or found not in results.values() or not is_result(folder):
                    faults.append(f"cut {k}: neither the old result nor the new one")
            except Exception as error:
                faults.append(f"cut {k}: {type(error).__name__}: {error}")
    return count, faults


def environments(limit: int, base: Path) -> Iterator[tuple[str, int, Work]]:
    """Runs in hostile environments."""
    from tofuse.lab.simulation.record import simulate

    chosen = spread(ENVIRONMENTS, limit)
    recording = base / "rec"

    def work(environment: Environment) -> tuple[int, list[str]]:
        if not recording.exists():
            simulate("peaks", recording, frames=2)
        with tempfile.TemporaryDirectory(dir=base) as where:
            outcome = attempt(environment, recording, Path(where), "--method", "thesis")
        faults = "; ".join(outcome.faults)
        return 1, [f"{environment.name}: {faults}"] if faults else []

    for number, environment in enumerate(chosen):
        yield "hostile environments", number, lambda e=environment: work(e)


def spread(items: Sequence[T], limit: int) -> Sequence[T]:
    """Return at most `limit` of the items, from all parts."""
    return items[:: max(1, len(items) // limit)][:limit]


def one(fault: str, name: str) -> tuple[int, list[str]]:
    """Return the outcome of one attack, whose `fault` is empty if it passed."""
    return 1, [f"{name}: {fault}"] if fault else []


def damaged_caches(limit: int, seed: int, base: Path) -> Iterator[tuple[str, int, Work]]:
    """Damaged files of compiled kernels, of all kinds in turn."""
    for number in range(min(limit, CACHES)):
        kind = caches.KINDS[number % len(caches.KINDS)]
        yield (
            "damaged caches of kernels",
            number,
            lambda k=kind, n=number: one(caches.attack(k, 1_000_000 * seed + n, base), f"{k}, {n}"),
        )


def edited_results(limit: int, base: Path) -> Iterator[tuple[str, int, Work]]:
    """Edited or contradictory results, each with the commands that read it."""
    original = base / "results"

    def work(edit: contradictions.Edit) -> tuple[int, list[str]]:
        if not original.exists():
            original.mkdir()
            contradictions.made(original)
        return len(edit.commands), contradictions.attack(edit, original, base / "edited")

    for number, edit in enumerate(spread(list(contradictions.edits()), limit)):
        yield "contradictory results", number, lambda e=edit: work(e)


def changed_pairs(limit: int, seed: int) -> Iterator[tuple[str, int, Work]]:
    """Pairs of clouds, changed in ways that must not change their pose."""
    for number in range(min(limit, METAMORPHIC)):
        name = list(metamorphic.CHANGES)[number % len(metamorphic.CHANGES)]
        pair = PAIRS * seed + number // len(metamorphic.CHANGES) % PAIRS
        yield (
            "changed pairs of clouds",
            number,
            lambda n=number, k=name, p=pair: one(metamorphic.attack(k, n, p), f"{k}, {n}"),
        )


def forked(limit: int) -> Iterator[tuple[str, int, Work]]:
    """Calls in a process and then in its forked children."""
    for number, calls in enumerate(forks.SCENARIOS[:limit]):
        yield (
            "forked children",
            number,
            lambda c=calls: one(forks.attack(*c), " then ".join(c)),
        )


if __name__ == "__main__":
    sys.exit(main())
