"""Pairs of clouds changed in ways that must change their pose as computed, or not at all.

Each pair of a furnished room is registered unchanged and changed: both clouds or one translated,
stray points added, axes permuted, points reordered or repeated. The poses must agree on the points
that are not stray.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

import made_clouds
import tofuse
from made_clouds import Pair
from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import TofuseError
from tofuse.engine.geometry import se3

MAX_M = 0.003
_LARGEST_SHIFT_M = 1e6


@cache
def _plain(number: int) -> tuple[Pair, Registration]:
    """A pair, and its registration."""
    pair = made_clouds.room_pair(number)
    return pair, tofuse.register(pair.source, pair.target)


@dataclass(frozen=True, eq=False)
class Changed:
    """A changed pair, and the motions (4, 4) of the coordinates of its clouds."""

    pair: Pair
    T_new_source: Float64 = field(default_factory=lambda: np.eye(4))
    T_new_target: Float64 = field(default_factory=lambda: np.eye(4))


def _both_moved(pair: Pair, rng: np.random.Generator) -> Changed:
    shift = _vector(rng)
    return _moved(pair, shift, shift)


def _one_moved(pair: Pair, rng: np.random.Generator) -> Changed:
    shifts = [_vector(rng), np.zeros(3)]
    return _moved(pair, *(shifts if rng.integers(2) else shifts[::-1]))


def _moved(pair: Pair, source: Float64, target: Float64) -> Changed:
    motions = [np.eye(4), np.eye(4)]
    for T, shift in zip(motions, (source, target), strict=True):
        T[:3, 3] = shift
    return Changed(made_clouds.moved(pair, source, target), *motions)


def _vector(rng: np.random.Generator) -> Float64:
    """A direction with a length from 1 m to that of map coordinates."""
    direction = rng.normal(size=3)
    length = _LARGEST_SHIFT_M ** rng.random()
    return np.round(length * direction / np.linalg.norm(direction), 3)


def _strayed(pair: Pair, rng: np.random.Generator) -> Changed:
    point = 10 ** rng.uniform(2, 8) * rng.normal(size=(1, 3))
    where = ("source", "target", "both")[rng.integers(3)]
    return Changed(made_clouds.with_points(pair, point, where))


def _sprinkled(pair: Pair, rng: np.random.Generator) -> Changed:
    count = int(rng.uniform(0.002, 0.02) * len(pair.source))
    points = 10 ** rng.uniform(2, 4) * rng.normal(size=(count, 3))
    where = ("source", "target")[rng.integers(2)]
    return Changed(made_clouds.with_points(pair, points, where))


def _permuted(pair: Pair, rng: np.random.Generator) -> Changed:
    """Rotate the axes of both clouds into each other."""
    axes = [(1, 2, 0), (2, 0, 1)][rng.integers(2)]
    P = np.eye(4)[[*axes, 3]]
    T = P @ pair.T_target_source @ P.T
    return Changed(Pair(pair.source[:, axes], pair.target[:, axes], T), P, P)


def _reordered(pair: Pair, rng: np.random.Generator) -> Changed:
    source, target = rng.permutation(pair.source), rng.permutation(pair.target)
    return Changed(replace(pair, source=source, target=target))


def _repeated(pair: Pair, rng: np.random.Generator) -> Changed:
    times = int(rng.integers(2, 5))
    if rng.integers(2):
        return Changed(replace(pair, source=np.tile(pair.source, (times, 1))))
    return Changed(replace(pair, target=np.repeat(pair.target, times, axis=0)))


def _with_nan(pair: Pair, rng: np.random.Generator) -> Changed:
    """Add points that are not finite."""
    points = rng.choice([np.nan, np.inf, -np.inf], (int(rng.integers(1, 300)), 3))
    where = ("source", "target", "both")[rng.integers(3)]
    return Changed(made_clouds.with_points(pair, points, where))


CHANGES: dict[str, Callable[[Pair, np.random.Generator], Changed]] = {
    "both translated": _both_moved,
    "one translated": _one_moved,
    "a stray point": _strayed,
    "many stray points": _sprinkled,
    "axes permuted": _permuted,
    "points reordered": _reordered,
    "points repeated": _repeated,
    "points that are not finite": _with_nan,
}


def attack(name: str, number: int, seed: int) -> str:
    """Register a changed pair; return how it differs from the unchanged one, or nothing."""
    pair, plain = _plain(seed)
    changed = CHANGES[name](pair, np.random.default_rng([seed, number, *name.encode()]))
    try:
        found = tofuse.register(changed.pair.source, changed.pair.target)
    except TofuseError as error:
        return f"refused: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    if found.believed != plain.believed:
        return f"believed: {found.believed}, not {plain.believed}: {found.reason}"
    expected = changed.T_new_target @ plain.T_target_source
    points = se3.transform(changed.T_new_source, pair.source)
    apart = se3.transform(found.T_target_source, points) - se3.transform(expected, pair.source)
    worst = float(np.linalg.norm(apart, axis=1).max())
    return "" if worst <= MAX_M else f"differs by {worst:.4g} m"
