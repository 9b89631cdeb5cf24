"""Situations in which the answer is wrong or can't be known: does the verdict say so?

Recordings (`situations.py`) are reconstructed as by `tofuse run`, and the rms error of their
positions after alignment is compared with the stated 95 % bound. Pairs of clouds (`made_clouds.py`)
are registered; a pose is wrong beyond 5 % of the extent or 4 degrees. One that is accepted given
the guess only says so.

The worst outcome is a verdict "good" with an error outside its bound. Where something large moves,
any violated bound is as bad. In families marked *assumed* the scale, or the handedness, of depth is
wrong throughout, or all that is in view moves, which depth alone can't show. In the other families
such an outcome, a crash, or a wrong pose that is accepted, makes the exit status 1.

    python benchmarks/nonsense.py [--only FAMILY] [--limit N] [--seed K] [--journal FILE]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import made_clouds
import tofuse
import variants
from attacks.journal import Lines
from situations import ASSUMED, BOUNDED, Situation, situations
from tofuse.engine.errors import TofuseError
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import displacement

OUTCOMES = ("good within", "good OUTSIDE", "held", "violated", "no bound", "CRASHED")
GIVEN = "given the guess, "
PAIR_OUTCOMES = (
    "right", f"{GIVEN}right", f"{GIVEN}wrong", "rejected", "accepted and WRONG", "CRASHED",
)  # fmt: skip
# Pairs, and the guess: none, the identity, or the truth up to a small error.
PAIR_FAMILIES = {
    "symmetric clouds": (made_clouds.symmetric_pairs, None),
    "symmetric clouds, identity": (made_clouds.symmetric_pairs, lambda pair: np.eye(4)),
    "symmetric clouds, guess": (
        made_clouds.symmetric_pairs,
        lambda pair: pair.T_target_source @ GUESS_ERROR,
    ),
    "stray points, map coordinates": (made_clouds.strayed_pairs, None),
}
GUESS_ERROR = se3.exp([0.02, -0.01, 0.01, 0.03, -0.02, 0.02])


@dataclass(frozen=True)
class Row:
    """One situation: the true error (NaN if nothing has a pose), what the run stated, and the share
    of the frames that have a pose in the main part.
    """

    family: str
    name: str
    verdict: str
    outcome: str
    error_m: float = np.nan
    bound_m: float = np.nan
    said: str = ""
    posed: float = np.nan

    @property
    def failed(self) -> bool:
        """Whether the outcome is one that must not be."""
        if self.outcome == "violated":
            return self.family in BOUNDED
        return self.outcome in ("good OUTSIDE", "accepted and WRONG", "CRASHED")

    @property
    def excused(self) -> bool:
        """Whether it is known that it can't be detected."""
        return self.family in ASSUMED and self.outcome != "CRASHED"

    def line(self) -> str:
        """Return the row of the situation."""
        bound = f"{1e3 * self.bound_m:9.1f}" if np.isfinite(self.bound_m) else "     none"
        posed = f"{self.posed:5.0%}" if np.isfinite(self.posed) else "     "
        return (
            f"{self.family:32} {self.name:48} {self.verdict:9} {bound} {1e3 * self.error_m:9.1f}"
            f" {posed} {self.outcome:18} {self.said}"
        ).rstrip()


def reconstructed(situation: Situation, seed: int, threads: int) -> Row:
    """Run a situation and compare it with the truth."""
    take = situation.make(seed)
    run = variants.run(take.as_recording(), threads)
    error = posed = np.nan
    if run.parts:
        poses = run.parts[0].poses
        known = np.isfinite(poses).all((1, 2))
        posed = float(known.mean())
        if known.sum() > 1:
            error = displacement(take.poses[known], poses[known])[0]
    outcome = _outcome(run.verdict, error, run.bound_m)
    said = " ".join(run.reasons)
    return Row(
        situation.family, situation.name, run.verdict, outcome, error, run.bound_m, said, posed
    )


def _outcome(verdict: str, error: float, bound: float) -> str:
    if verdict == "CRASHED":
        return verdict
    if not np.isfinite([error, bound]).all():
        return "no bound"
    within = error <= bound
    if verdict == "good":
        return "good within" if within else "good OUTSIDE"
    return "held" if within else "violated"


def registered(family: str, name: str, pair: made_clouds.Pair, seed: int) -> Row:
    """Register a pair of clouds."""
    guessed = PAIR_FAMILIES[family][1]
    guess = None if guessed is None else guessed(pair)
    try:
        found = tofuse.register(pair.source, pair.target, guess=guess, seed=seed)
    except TofuseError as error:
        return Row(family, name, "refused", "rejected", said=str(error))
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        return Row(family, name, "", "CRASHED", said=message)
    right = pair.is_right(found.T_target_source)
    wrong = "right" if right else "accepted and WRONG"
    outcome = wrong if found.believed else "rejected"
    if found.believed and found.given_guess:
        outcome = GIVEN + ("right" if right else "wrong")
    probability = "" if found.probability is None else f"{found.probability:.2%}"
    return Row(family, name, probability, outcome, said=found.reason)


def rows(families: Sequence[str], limit: int | None, seed: int, threads: int,
         done: set[tuple[str, str]]) -> Iterator[Row]:  # fmt: skip
    """Run all situations that are not done, at most `limit` of each family."""
    count: Counter[str] = Counter()
    for situation in situations():
        count[situation.family] += 1
        if _chosen(situation.family, situation.name, families, count, limit, done):
            yield reconstructed(situation, seed, threads)
    for family, (pairs, _) in PAIR_FAMILIES.items():
        for name, make in pairs():
            count[family] += 1
            if _chosen(family, name, families, count, limit, done):
                yield registered(family, name, make(seed), seed)


def _chosen(family: str, name: str, families: Sequence[str], count: Counter[str],
            limit: int | None, done: set[tuple[str, str]]) -> bool:  # fmt: skip
    beyond = limit is not None and count[family] > limit
    return family in families and not beyond and (family, name) not in done


def table(found: Sequence[Row], outcomes: Sequence[str]) -> Iterator[str]:
    """Yield the counts by family."""
    yield f"| family | situations | {' | '.join(outcomes)} |"
    yield f"|---|---|{'---|' * len(outcomes)}"
    for family in dict.fromkeys(row.family for row in found):
        own = [row.outcome for row in found if row.family == family]
        mark = ", assumed" if family in ASSUMED else ""
        counts = " | ".join(str(own.count(outcome) or "") for outcome in outcomes)
        yield f"| {family}{mark} | {len(own)} | {counts} |"
    others = [row.outcome for row in found if not row.excused]
    counts = " | ".join(str(others.count(outcome) or "") for outcome in outcomes)
    yield f"| without assumed | {len(others)} | {counts} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the situations, and print a line for each, the tables and the violations."""
    families = [*dict.fromkeys(s.family for s in situations()), *PAIR_FAMILIES]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="FAMILY", choices=families, default=families)
    parser.add_argument("--limit", type=int, help="at most this number of each family")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--journal", type=Path, help="file of completed runs, to continue from")
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="start no run after that time"
    )
    options = parser.parse_args(arguments)
    begun = time.monotonic()
    journal = Lines(options.journal, {"seed": options.seed})
    found = [Row(**record) for record in journal.records]
    done = {(row.family, row.name) for row in found}
    for row in rows(options.only, options.limit, options.seed, options.threads, done):
        found.append(row)
        journal.add(asdict(row))
        print(row.line(), flush=True)
        if time.monotonic() - begun > 60 * options.minutes:
            print("incomplete")
            break
    found = [row for row in found if row.family in options.only]
    recordings = [row for row in found if row.family not in PAIR_FAMILIES]
    pairs = [row for row in found if row.family in PAIR_FAMILIES]
    for rows_of, outcomes in ((recordings, OUTCOMES), (pairs, PAIR_OUTCOMES)):
        if rows_of:
            print("", *table(rows_of, outcomes), sep="\n")
    print("\nviolations:")
    for row in found:
        if row.failed or row.outcome == "violated":
            print(row.line())
    return int(any(row.failed and not row.excused for row in found))


if __name__ == "__main__":
    sys.exit(main())
