"""Attacks on the boundary of the program: damaged files, cut-off writes, poor surroundings.

    python benchmarks/attack.py [--quick] [--files N] [--kills N] [--only files|kills|surroundings]

Prints for each how many were tried and how many held; ends with 1 if any did not. What is promised,
and so what it is to hold, is in docs/reliability.md.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np

from attacks import mutation
from attacks.environments import ENVIRONMENTS, attempt
from attacks.power import Power, PowerCut

FILES, KILLS = 20_000, 500
QUICK_FILES, QUICK_KILLS, QUICK_ENVIRONMENTS = 300, 60, 12


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="some hundreds in all")
    parser.add_argument("--files", type=int)
    parser.add_argument("--kills", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=("files", "kills", "surroundings"))
    arguments = parser.parse_args()
    quick, only = arguments.quick, arguments.only
    files = arguments.files or (QUICK_FILES if quick else FILES)
    kills = arguments.kills or (QUICK_KILLS if quick else KILLS)
    rows: list[tuple[str, int, int]] = []
    if only in (None, "kills"):
        rows.append(cut_writes(kills, arguments.seed))
    if only in (None, "surroundings"):
        rows.append(surroundings(QUICK_ENVIRONMENTS if quick else len(ENVIRONMENTS)))
    if only in (None, "files"):
        rows += damaged_files(files, arguments.seed)
    print(f"\n{'attack':40} {'tried':>7} {'held':>7}")
    for name, tried, held in rows:
        print(f"{name:40} {tried:7} {held:7}")
    tried, held = (sum(row[k] for row in rows) for k in (1, 2))
    print(f"{'all':40} {tried:7} {held:7}")
    return 0 if tried == held else 1


def damaged_files(total: int, seed: int) -> list[tuple[str, int, int]]:
    """Damaged files of each format, as many of each."""
    names = list(mutation.subjects())
    each = -(-total // len(names))
    rows = []
    for name in names:
        outcomes = Counter()
        for k, outcome in mutation.run(name, each, 1_000_000 * seed):
            outcomes[outcome] += 1
            if outcome not in ("read", "refused"):
                print(f"{name}, seed {k}: {outcome}", flush=True)
        rows.append((f"damaged: {name}", each, outcomes["read"] + outcomes["refused"]))
    return rows


def cut_writes(total: int, seed: int) -> tuple[str, int, int]:
    """Power cuts at random calls to the system: writing, and then going on, again and again."""
    mutation.subjects()  # which finds the tests
    import made_results
    from tofuse.results.folder import OutputFolder, is_result, settle
    from tofuse.results.output import write_result

    def write(folder: Path, number: int) -> None:
        write_result(made_results.torn(seed=number), OutputFolder(folder, overwrite=True))

    def shown(folder: Path) -> dict[str, bytes]:
        found = made_results.contents(folder)
        return {n: data for n, data in found.items() if not n.startswith(".tofuse-")}

    rng = np.random.default_rng(seed)
    held = 0
    with tempfile.TemporaryDirectory() as base:
        results = {}
        for number in (1, 2):
            write(Path(base) / f"whole-{number}", number)
            results[number] = shown(Path(base) / f"whole-{number}")
        for k in range(total):
            folder = Path(base) / f"cut-{k:06}"
            write(folder, 1)
            (folder / "mine.txt").write_bytes(b"mine")
            for job in itertools.chain([lambda f: write(f, 2)], [settle] * int(rng.integers(4))):
                power = Power(int(rng.integers(60)))
                with power.connected(), suppress(PowerCut):
                    job(folder)
                if power.off:
                    power.lose(folder)
            try:
                settle(folder)
                OutputFolder(folder, overwrite=True).discard()
                found = made_results.contents(folder)
                mine = found.pop("mine.txt", None)
                good = mine == b"mine" and found in results.values() and is_result(folder)
            except Exception as error:
                print(f"kill {k}: {type(error).__name__}: {error}", flush=True)
                good = False
            held += good
            if not good:
                print(f"kill {k} with seed {seed}: neither the old result nor the new one")
    return "power cuts while a result is written", total, held


def surroundings(most: int) -> tuple[str, int, int]:
    """Runs that lack something."""
    from tofuse.simulation.record import simulate

    chosen = ENVIRONMENTS[:: max(1, len(ENVIRONMENTS) // most)][:most]
    held = 0
    with tempfile.TemporaryDirectory() as base:
        recording = simulate("peaks", Path(base) / "rec", frames=2)
        for k, environment in enumerate(chosen):
            where = Path(base) / f"{k}"
            where.mkdir()
            outcome = attempt(environment, recording, where, "--method", "thesis")
            held += not outcome.faults
            if outcome.faults:
                print(f"{environment.name}: {', '.join(outcome.faults)}", flush=True)
    return "surroundings that lack something", len(chosen), held


if __name__ == "__main__":
    sys.exit(main())
