"""Whether all views together say that the camera errs: what is to be checked, and what it does.

A focal length that is wrong, or a depth that is off, bends the path, and no single registration
can tell. But where views overlap, and best where a path comes back, they can't all be satisfied.
So each error is asked for by itself, with all poses free to follow. What would satisfy the views
better is a proposal; an alarm, if it is more than a camera that came calibrated is off by, and a
loop that neighbours alone miss closes with it.

The focal length stands for other errors too: a depth that is off by a constant looks much like it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.geometry import se3
from tofuse.kernels import refinement as kernels
from tofuse.posegraph.refine import (
    Beside,
    Refined,
    RefineOptions,
    Round,
    alone,
    chosen,
    refine,
    response,
)
from tofuse.posegraph.views import KeptView

# Light that comes by other ways, and pixels that see two surfaces, look like a focal length that is
# wrong by up to a percent; cameras come calibrated to better than that. Depths are off by a
# centimetre, where the maker's promises hold.
TOLERANCES = {"focal": 0.02, "offset": 0.02}
# Standard deviations by which an error must stand out, in the end and to have a closer look; and
# what of the tolerance one step, which falls short, must show for that.
_SURE, _LIKELY, _WORTH = 4.0, 2.5, 0.2
# Loops are closed that miss by no more, m and rad.
_CLOSED = (0.01, np.radians(0.5))
# Of the tolerance: an error that is known less well is not told.
_VAGUE = 0.4
# What the support of the views changes by for no other reason than which points are taken.
_CHANCE = 0.003
# How much views differ is not known from fewer.
_LEAST_VIEWS = 8
_NUMBERS = {"focal": kernels.FOCAL, "offset": kernels.OFFSET}
# The way to what fits may be long.
_ROUNDS = (Round(2, 0.02, 0.1), Round(2, 0.005, 0.03), Round(4, 0.0, 0.0))
# Errors that all views share are known from so many pairs; where there are more, about as many and
# every so manieth point take part.
_ENOUGH_PAIRS, _EVERY = 500, 3


@dataclass(frozen=True)
class Gap:
    """A loop of views that overlap one after the other, and its ends too.

    `before` and `after` are by how much (m, rad) the neighbours, each aligned by itself, miss what
    its ends say: without and with the errors that were estimated. `depth` is that of the views, m.
    """

    i: int
    j: int
    before: tuple[float, float]
    after: tuple[float, float]
    depth: float = 0.0

    @property
    def closes(self) -> bool:
        """Whether the errors explain it: one part is less than half, the other not more.

        Or what the views see is put down at less than half the distance. A gap of less than a
        centimetre and half a degree says nothing, as not every error bends every path.
        """
        seen = [m + self.depth * rad for m, rad in (self.after, self.before)]
        least = _CLOSED[0] + self.depth * _CLOSED[1]
        if self.depth and seen[0] < 0.5 * seen[1] and seen[1] > least:
            return True
        parts = list(zip(self.before, self.after, _CLOSED, strict=True))
        if any(b > max(a, least) for a, b, least in parts):
            return False
        return all(a < least for a, _, least in parts) or any(b < 0.5 * a for a, b, _ in parts)

    @property
    def contradicts(self) -> bool:
        """Whether it is wide enough to tell, and the errors do not explain it."""
        wide = any(a >= least for a, least in zip(self.before, _CLOSED, strict=True))
        return wide and not self.closes


@dataclass(frozen=True)
class Suspicion:
    """What the views say of errors of the camera that all of them share.

    Attributes
    ----------
    alarm
        Whether the camera ought to be checked.
    errors, sigmas
        Of each error by itself, as in `Refinement.errors`, and their standard deviations by how
        much views differ: proposals, nothing is changed by them. Those that stand out, and where
        there is an alarm all that the views hold.
    support
        How well the views agree without and with the error that serves best of those that stand
        out, see `refine.Support`.
    gap
        Of the longest loop; None where there is none, or nothing was suspected.
    best
        Name of the error with which the views agree best; empty where nothing was suspected.
    focal_sigma
        Standard deviation with which the views determine the focal length, as a fraction; None
        where there were too few to ask.
    """

    alarm: bool = False
    errors: dict[str, float] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    support: tuple[float, float] | None = None
    gap: Gap | None = None
    best: str = ""
    focal_sigma: float | None = None

    @property
    def undetermined(self) -> bool:
        """Whether a wrong focal length would not show in this recording."""
        return self.focal_sigma is not None and not _determined("focal", self.focal_sigma)

    @property
    def unconfirmed(self) -> dict[str, float]:
        """Errors with which views agree better, that no loop confirms, and none contradicts."""
        if self.alarm or (self.gap is not None and self.gap.contradicts):
            return {}
        sigmas = self.sigmas
        return {n: e for n, e in self.errors.items() if n in sigmas and _large(n, e, sigmas[n])}


def _determined(name: str, sigma: float) -> bool:
    return sigma < _VAGUE * TOLERANCES[name]


def _large(name: str, error: float, sigma: float) -> bool:
    return abs(error) > max(TOLERANCES[name], _SURE * sigma)


def suspicion(
    views: Sequence[KeptView], refined: Refined, options: RefineOptions, beside: Beside
) -> Suspicion:
    """Ask refined views for the errors of their camera."""
    pairs, poses = refined.pairs, refined.poses
    if not len(pairs) or len(views) < _LEAST_VIEWS:
        return Suspicion()
    said = response(views, poses, pairs, options, beside=beside)
    estimate, sigma = said.estimate(), said.sigma(pairs, len(views))
    held = [name for name, k in _NUMBERS.items() if _determined(name, sigma[k])]
    focal_sigma = float(sigma[kernels.FOCAL])
    looked = [
        name
        for name in held
        if abs(estimate[_NUMBERS[name]])
        > max(_LIKELY * sigma[_NUMBERS[name]], _WORTH * TOLERANCES[name])
    ]
    if not looked:
        return Suspicion(focal_sigma=focal_sigma)
    few, some = list(views), pairs
    if len(pairs) > _ENOUGH_PAIRS:
        few = [KeptView(v.surface, np.ascontiguousarray(v.points[::_EVERY])) for v in views]
        some = chosen(pairs, -(-options.neighbours * _ENOUGH_PAIRS // len(pairs)))
    patient = replace(options, rounds=_ROUNDS)

    def asked(name: str) -> Refined:
        # The views overlap as they did: the poses have to follow, not to be found.
        number = [_NUMBERS[name]]
        return refine(few, poses, patient, calibrate=number, beside=beside, pairs=some)

    found = {name: asked(name) for name in looked}
    name_of_best = max(found, key=lambda name: _gain(found[name], views))
    best = found[name_of_best]
    large = any(
        _large(name, one.errors[_NUMBERS[name]], sigma[_NUMBERS[name]])
        for name, one in found.items()
    )
    gap = loop_gap(views, refined, best.poses, best.errors, options) if large else None
    alarm = gap is not None and gap.closes and _gain(best, views) > _CHANCE
    if alarm:  # what it may be as well
        found |= {name: asked(name) for name in held if name not in found}
    support = float(best.before.of_views(len(views)).mean())
    return Suspicion(
        alarm,
        {name: float(found[name].errors[k]) for name, k in _NUMBERS.items() if name in found},
        {name: float(sigma[k]) for name, k in _NUMBERS.items() if name in found},
        (support, support + _gain(best, views)),
        gap,
        name_of_best,
        focal_sigma,
    )


def of_submaps(said: Sequence[Suspicion]) -> Suspicion:
    """What submaps of one recording say together.

    They share the camera: an error of it is in most of them, and in few only if it is none. Of the
    alarms the one counts whose error is in the middle.
    """
    alarms = sorted((s for s in said if s.alarm), key=lambda s: s.errors.get(s.best, 0.0))
    if 2 * len(alarms) > len(said):
        return alarms[len(alarms) // 2]
    quiet = [s for s in said if not s.alarm]
    # One submap that determines the camera speaks for all of them.
    quiet.sort(key=lambda s: (s.gap is None, s.undetermined))
    return quiet[0] if quiet else Suspicion()


def _gain(found: Refined, views: Sequence[KeptView]) -> float:
    n = len(views)
    return float(found.after.of_views(n).mean() - found.before.of_views(n).mean())


def loop_gap(
    views: Sequence[KeptView],
    refined: Refined,
    poses: Float64,
    errors: Float64,
    options: RefineOptions,
) -> Gap | None:
    """By how much the longest loop of neighbours misses, without errors of the camera and with.

    Parameters
    ----------
    refined
        Where no error is assumed.
    poses, errors
        (N, 4, 4) and (ERRORS,) with them.
    """
    ends = longest_loop(refined.pairs)
    if ends is None:
        return None
    i, j = ends
    chain = np.stack([np.arange(i, j), np.arange(i + 1, j + 1)], 1)
    pairs = np.concatenate([chain, [[i, j]]])
    gaps = []
    for at, wrong in ((refined.poses, np.zeros(kernels.ERRORS)), (poses, errors)):
        T = se3.inverse(at[pairs[:, 0]]) @ at[pairs[:, 1]]
        T = alone(views, pairs, T, options, wrong)
        way = np.eye(4)
        for step in T[:-1]:
            way = way @ step
        miss = se3.inverse(T[-1]) @ way
        gaps.append((float(np.linalg.norm(miss[:3, 3])), float(se3.angle(miss))))
    depth = 0.5 * (views[i].surface.depth + views[j].surface.depth)
    return Gap(views[i].surface.index, views[j].surface.index, gaps[0], gaps[1], depth)


def longest_loop(pairs: Intp) -> tuple[int, int] | None:
    """Ends of the pair that are furthest apart in time and joined by neighbours all the way."""
    if not len(pairs):
        return None
    joined = np.zeros(int(pairs.max()) + 1, bool)
    joined[pairs[pairs[:, 1] == pairs[:, 0] + 1, 0]] = True
    broken = np.concatenate([[0], np.cumsum(~joined)])
    i, j = pairs.T
    whole = (broken[j] == broken[i]) & (j > i + 1)
    if not whole.any():
        return None
    k = int(np.argmax(np.where(whole, j - i, -1)))
    return int(i[k]), int(j[k])


def in_words(errors: Mapping[str, float]) -> list[str]:
    """Errors of the camera in words, each by itself, by what would be right; see `Suspicion`."""
    words = []
    if "focal" in errors:
        share = 1 / (1 + errors["focal"]) - 1
        more = "larger" if share > 0 else "smaller"
        words.append(f"a focal length {abs(share):.1%} {more}")
    if "offset" in errors:
        more = "longer" if errors["offset"] > 0 else "shorter"
        words.append(f"ranges {abs(errors['offset']) * 1e3:.0f} mm {more}")
    return words
