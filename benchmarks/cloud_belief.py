"""The probability of a pose of bare clouds: decisions are collected, and models fitted to them.

The decisions of each pair are kept in benchmarks/out/cloud_belief, in a folder for the code that
they depend on, so that a second fit takes seconds. The coefficients in use have no influence.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

import cloud_kinds
import made_clouds
import pairs
import tofuse.engine
from attacks.journal import Lines
from cloud_kinds import KINDS, Pair
from scoring import roc_area
from sequences import OUT
from tofuse.engine.alignment.base import Registration
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.clouds import cloud_pair
from tofuse.engine.compute import one_blas_thread
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.search import pose_probability
from tofuse.engine.search.pose_probability import ACCEPTED, CLOUDS, CloudEvidence, logistic

# Extent of the places that the errors of guesses are meant for, m.
_GUESS_EXTENT_M = 5.0
_ENGINE = Path(tofuse.engine.__file__).parent
# The code that decisions depend on.
_CODE = (
    *(f for room in ("clouds", "icp") for f in sorted((_ENGINE / room).glob("*.py"))),
    Path(cloud_kinds.__file__),
    Path(made_clouds.__file__),
)
# Number of the pair that stands for the last one of a kind.
_ALL = -1
# A pose with an error below that of right poses times this is none of another place.
_NEAR_MISS = 3.0
# Numbers of surfaces that are compared, and least probability that counts in a likelihood.
_FEW, _LEAST = (0.1, 10.0, 20.0, 50.0), 1e-3
_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
# Of each pair, its probability and whether it is right (n, 2).
Outcomes = Float64


@dataclass(frozen=True)
class Decision:
    """Evidence for a pose of a pair of a kind, and its error relative to that of right poses."""

    kind: str
    pair: int
    evidence: CloudEvidence
    error: float

    @property
    def right(self) -> bool:
        return self.error < 1

    @property
    def is_near_miss(self) -> bool:
        """Whether the pose is inaccurate, but not that of another place."""
        return 1 <= self.error < _NEAR_MISS

    @property
    def family(self) -> str:
        return KINDS[self.kind].family

    @property
    def searched(self) -> bool:
        """Whether the pose was compared with rivals, not only aligned from a guess."""
        return self.evidence.margin is not None


def collected(names: Sequence[str], data: Path, max_pairs: int) -> list[Decision]:
    """Decisions on the pairs of some kinds."""
    journal = Lines(_file(max_pairs), {})
    done = {(row["kind"], row["pair"]) for row in journal.records}
    for name in (name for name in names if (name, _ALL) not in done):
        for number, pair in enumerate(cloud_kinds.made(name, data, max_pairs)):
            if (name, number) not in done:
                found = _decided(pair, number)
                made = [{"error": error, **_as_record(evidence)} for evidence, error in found]
                journal.add({"kind": name, "pair": number, "decisions": made})
                print(f"{name} {number}", flush=True)
        journal.add({"kind": name, "pair": _ALL, "decisions": []})
    return [
        Decision(row["kind"], row["pair"], CloudEvidence(**made), error)
        for row in journal.records
        if row["kind"] in names
        for error, made in ((made.pop("error"), made) for made in map(dict, row["decisions"]))
    ]


def _file(max_pairs: int) -> Path:
    code = hashlib.sha256(b"".join(file.read_bytes() for file in _CODE)).hexdigest()
    return OUT / "cloud_belief" / f"{max_pairs}-{code[:12]}.jsonl"


def _as_record(evidence: CloudEvidence) -> dict[str, Any]:
    record = asdict(evidence)
    del record["model"]
    return record


def _decided(pair: Pair, number: int) -> list[tuple[CloudEvidence, float]]:
    """Distinct decisions of the search, and of the alignment from a guess that is off."""
    source, target = CloudFrame.of(pair.source, index=1), CloudFrame.of(pair.target)
    guess = np.eye(4) if pair.true is None else pair.true
    guess = guess @ _off(pair.extent, number)
    found: dict[CloudEvidence, float] = {}
    for is_search in (True, False):
        rng = np.random.default_rng(0)
        try:
            with _recorded() as made, one_blas_thread():
                if is_search:
                    cloud_pair.register_clouds(source, target, None, rng, always_search=True)
                else:
                    cloud_pair.follow_clouds(source, target, guess, rng)
        except RegistrationError:
            continue
        found |= {evidence: pair.relative_error(T) for evidence, T in made}
    return list(found.items())


def _off(extent: float, number: int) -> Float64:
    metres, degrees = pairs.GUESSES[number % len(pairs.GUESSES)]
    way = np.random.default_rng([number, 9]).standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return se3.exp(np.r_[metres * extent / _GUESS_EXTENT_M * way[0], np.radians(degrees) * way[1]])


@contextmanager
def _recorded() -> Iterator[list[tuple[CloudEvidence, Float64]]]:
    """Record the evidence and the pose of each decision; none is likely, so that all are made."""
    made: list[tuple[CloudEvidence, Float64]] = []
    decide = CloudEvidence.applied

    def recorded(evidence: CloudEvidence, *given: Any) -> Registration:
        decided = decide(evidence, *given)
        made.append((evidence, decided.T_target_source))
        return decided

    with (
        mock.patch.object(CloudEvidence, "applied", recorded),
        mock.patch.object(cloud_pair, "_LIKELY", 2.0),
        mock.patch.object(pose_probability, "ACCEPTED", 2.0),
    ):
        yield made


# ---- Fit -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Samples:
    """Regressors (n, k) of decisions, which poses are right, and families."""

    decisions: list[Decision]
    x: Float64
    right: Bool
    family: NDArray[np.str_]

    @classmethod
    def of(cls, decisions: list[Decision], *, searched: bool) -> _Samples:
        some = [d for d in decisions if d.searched == searched]
        if not searched:  # with degenerate directions the guess is kept, as with a symmetric body
            some = [d for d in some if not d.evidence.degenerate and d.kind != "symmetric"]
        x = [
            d.evidence.search_regressors if searched else d.evidence.local_regressors for d in some
        ]
        right = np.array([d.right for d in some])
        return cls(some, np.array(x, float), right, np.array([d.family for d in some]))

    def fitted(self, without: str = "") -> Float64:
        """Coefficients, from all families but one; each counts by the root of its number.

        Near misses are neither right nor wrong here.
        """
        used = self.family != without
        used &= ~np.array([decision.is_near_miss for decision in self.decisions])
        _, which, count = np.unique(self.family[used], return_inverse=True, return_counts=True)
        weight = 1 / np.sqrt(count[which])
        return pairs.fitted(self.x[used], self.right[used], weight / weight.mean())

    def probabilities(self, w: Float64, family: str) -> Float64:
        """Probabilities of the decisions of a family by coefficients `w`."""
        return np.array([logistic(v) for v in self.x[self.family == family] @ w])


def print_fit(data: Path, max_pairs: int) -> None:
    """Print fitted coefficients, how kinds fare that were left out, and how those in use fare."""
    found = collected([kind.name for kind in KINDS.values() if kind.fitted], data, max_pairs)
    for title, searched, in_use in (
        ("searched", True, CLOUDS.search),
        ("aligned from a guess", False, CLOUDS.local),
    ):
        samples = _Samples.of(found, searched=searched)
        print(f"\n{title}: {len(samples.right)} decisions, {samples.right.sum()} right")
        print(f"fitted coefficients {np.round(samples.fitted(), 2).tolist()}; kinds left out:")
        print_outcomes(_left_out(samples))
        print(f"\ncoefficients in use {list(in_use)}:")
        families = dict.fromkeys(samples.family)
        print_outcomes({f: _outcomes(samples, np.array(in_use), f) for f in families})
        log_odds = samples.x @ in_use
        scaled = replace(samples, x=np.column_stack([np.ones_like(log_odds), log_odds]))
        factors = np.round([scaled.fitted(f) for f in ("", *families)], 2).tolist()
        print(f"\nconstant and factor that fit their log odds better: {factors[0]}; without")
        print("; ".join(f"{f} {k}" for f, k in zip(families, factors[1:], strict=True)))
    print("\nnumber of surfaces that leads are reduced for, and log-likelihood of the left out")
    for few in _FEW:
        with mock.patch.object(pose_probability, "FEW_SURFACES", few):
            rows = _left_out(_Samples.of(found, searched=True)).values()
        p, right = np.concatenate(list(rows)).T
        likelihood = np.log(np.where(right > 0, p, 1 - p).clip(_LEAST)).mean()
        print(f"{few:g}: {likelihood:.3f}")


def _left_out(samples: _Samples) -> dict[str, Outcomes]:
    """Outcomes of each family by the coefficients from all others."""
    return {
        family: _outcomes(samples, samples.fitted(family), family)
        for family in dict.fromkeys(samples.family)
    }


def _outcomes(samples: _Samples, w: Float64, family: str) -> Outcomes:
    """Probability and rightness of each pair of a family: of its likely pose, or of the best."""
    mine = [d for d in samples.decisions if d.family == family]
    rows: dict[tuple[str, int], tuple[float, bool]] = {}
    for decision, p in zip(mine, samples.probabilities(w, family), strict=True):
        key = decision.kind, decision.pair
        before = rows.get(key)
        if before is None or (before[0] <= cloud_pair._LIKELY and p > before[0]):
            rows[key] = float(p), decision.right
    return np.array(list(rows.values()), float)


def print_outcomes(rows: dict[str, Outcomes]) -> None:
    """Print a row for each family, and how many poses are right by stated probability."""
    bins = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(_BINS)]
    print(
        "| clouds | pairs | right | of these accepted | accepted and wrong"
        f" | ROC area | right at {' | '.join(bins)} |\n|{'---|' * (6 + len(bins))}"
    )
    for family, found in {**rows, "all": np.concatenate(list(rows.values()))}.items():
        p, right = found[:, 0], found[:, 1] > 0
        accepted = p >= ACCEPTED
        which = np.clip(np.searchsorted(_BINS, p, side="right") - 1, 0, len(bins) - 1)
        counts = [f"{right[which == k].sum()} of {(which == k).sum()}" for k in range(len(bins))]
        cells = [len(p), right.sum(), (accepted & right).sum(), (accepted & ~right).sum()]
        area = f"{roc_area(p, right):.3f}" if right.any() and not right.all() else ""
        print(f"| {family} | {' | '.join(map(str, cells))} | {area} | {' | '.join(counts)} |")
