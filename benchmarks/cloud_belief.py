"""The probability of a pose of bare clouds: decisions are collected, and models fitted to them.

The decisions of each pair are kept in benchmarks/out/cloud_belief, in a folder for the code that
they depend on, so that a second fit takes seconds. The coefficients in use have no influence.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
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
# Numbers of pairs of different places begin here.
_DECOYS = 1000
_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
# Of each pair, its probability and whether it is right (n, 2).
Outcomes = Float64


@dataclass(frozen=True)
class Decision:
    """Evidence for a pose of a pair of a kind, and whether the pose is right."""

    kind: str
    pair: int
    evidence: CloudEvidence
    right: bool

    @property
    def family(self) -> str:
        return KINDS[self.kind].family

    @property
    def searched(self) -> bool:
        """Whether the pose was compared with rivals, not only aligned from a guess."""
        return self.evidence.margin is not None


def collected(names: Sequence[str], data: Path, max_pairs: int) -> list[Decision]:
    """Decisions on the pairs of some kinds, and on pairs of different places."""
    journal = Lines(_file(max_pairs), {})
    done = {(row["kind"], row["pair"]) for row in journal.records}
    for name, number, pair in _numbered(names, data, max_pairs):
        if (name, number) not in done:
            made = [
                {"right": right, **_as_record(found)} for found, right in _decided(pair, number)
            ]
            journal.add({"kind": name, "pair": number, "decisions": made})
            print(f"{name} {number}", flush=True)
    return [
        Decision(row["kind"], row["pair"], CloudEvidence(**made), right)
        for row in journal.records
        if row["kind"] in names
        for right, made in ((made.pop("right"), made) for made in map(dict, row["decisions"]))
    ]


def _file(max_pairs: int) -> Path:
    code = hashlib.sha256(b"".join(file.read_bytes() for file in _CODE)).hexdigest()
    return OUT / "cloud_belief" / f"{max_pairs}-{code[:12]}.jsonl"


def _as_record(evidence: CloudEvidence) -> dict[str, Any]:
    record = asdict(evidence)
    del record["model"]
    return record


def _numbered(names: Sequence[str], data: Path, max_pairs: int) -> Iterator[tuple[str, int, Pair]]:
    for name in names:
        for k, pair in enumerate(cloud_kinds.made(name, data, max_pairs)):
            yield name, k, pair
    for k, (pair, name) in enumerate(cloud_kinds.decoys(names, data, max_pairs)):
        yield name, _DECOYS + k, pair


def _decided(pair: Pair, number: int) -> list[tuple[CloudEvidence, bool]]:
    """Decisions of the search, and of the alignment from a guess that is off."""
    source, target = CloudFrame.of(pair.source, index=1), CloudFrame.of(pair.target)
    guess = np.eye(4) if pair.true is None else pair.true
    guess = guess @ _off(pair.extent, number)
    found = []
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
        found += [(evidence, pair.is_right(T)) for evidence, T in made]
    return found


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
        if not searched:
            some = [d for d in some if not d.evidence.degenerate]
        x = [
            d.evidence.search_regressors if searched else d.evidence.local_regressors for d in some
        ]
        right = np.array([d.right for d in some])
        return cls(some, np.array(x, float), right, np.array([d.family for d in some]))

    def fitted(self, without: str = "") -> Float64:
        """Coefficients, from all families but one; each counts by the root of its number."""
        used = self.family != without
        _, which, count = np.unique(self.family[used], return_inverse=True, return_counts=True)
        weight = 1 / np.sqrt(count[which])
        return pairs.fitted(self.x[used], self.right[used], weight / weight.mean())

    def probabilities(self, w: Float64, family: str) -> Float64:
        """Probabilities of the decisions of a family by coefficients `w`."""
        return np.array([logistic(v) for v in self.x[self.family == family] @ w])


def print_fit(data: Path, max_pairs: int) -> None:
    """Print the coefficients of both models, and how kinds fare that were left out of the fit."""
    fitted = [kind.name for kind in KINDS.values() if kind.fitted]
    found = collected(fitted, data, max_pairs)
    for title, searched in (("searched", True), ("followed", False)):
        samples = _Samples.of(found, searched=searched)
        w = samples.fitted()
        print(f"\n{title}: {len(samples.right)} decisions, {samples.right.sum()} right")
        print(f"coefficients ({', '.join(f'{v:.2f}' for v in w)})")
        in_use = CLOUDS.search if searched else CLOUDS.local
        print(f"in use       ({', '.join(f'{v:.2f}' for v in in_use)})")
        print("\nleft out of the fit:")
        rows = {
            family: _outcomes(samples, samples.fitted(family), family)
            for family in dict.fromkeys(samples.family)
        }
        print_outcomes(rows)


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
        area = f"{pairs.roc_area(p, right):.3f}" if right.any() and not right.all() else ""
        print(f"| {family} | {' | '.join(map(str, cells))} | {area} | {' | '.join(counts)} |")
