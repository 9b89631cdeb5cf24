"""Places known again by how they look, wherever the trajectory has them: no pose takes part."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.geometry import se3
from tofuse.registration.likeness import (
    alike,
    mutual_unlikeness,
    unlikeness,
    unlikeness_of_pairs,
)

# Of pairs of nearly the same views (this many positions off either way) so many are taken: two can
# confirm each other, and more would take the place of other loops.
_BESIDE, _TOGETHER = 3, 2
# Of up to so many views every two are compared. Of more, so many in between are asked whether the
# camera left.
_ALL, _BETWEEN = 512, 64
# How far apart views that look alike may stand: rad, and share of the depth.
ALIKE = 0.35
# The trajectory may be off by so many of its standard deviations.
_SIGMAS = 3.0


@dataclass(frozen=True)
class Appearance:
    """Which views look alike, and how far the trajectory may be off.

    Attributes
    ----------
    most
        Pairs of a recording at most, those most alike; 0 takes no notice of how views look.
    unlike, left
        How much the two views of a pair may differ at most, and a view in between from either at
        least: 0 for the same image, 1 for nothing in common.
    shift
        How far the images may be moved against each other, as a share of their width.
    drift
        Share of the path, and of the turns on it, by which the trajectory may be off at most. What
        would need more drift is taken for another place that looks the same.
    """

    most: int = 6
    unlike: float = 0.3
    left: float = 0.4
    shift: float = 0.25
    drift: float = 0.2

    def __post_init__(self) -> None:
        if self.most < 0:
            raise ValueError(f"most is {self.most}, not 0 or more")
        for name in ("unlike", "left", "drift"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not above 0 and up to 1")
        if not 0 <= self.shift <= 0.5:
            raise ValueError(f"shift is {self.shift}, not 0 to 0.5")

    def candidates(
        self,
        looks: Sequence[Float32],
        possible: Callable[[int, int], bool],
        known: Collection[tuple[int, int]] = (),
    ) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Views that look alike though the camera left in between.

        Parameters
        ----------
        looks
            Of all views in the order of time, see `likeness.look_of`.
        possible
            Whether the trajectory allows that two views show the same place.
        known
            Pairs that are loops for certain: near them nothing is looked for.

        Returns
        -------
        Positions (i, j), i < j, of those that are possible and of those that are not, at most
        `most` of each, the most alike first.
        """
        chosen: list[tuple[int, int]] = []
        refused: list[tuple[int, int]] = []
        if self.most == 0 or len(looks) < 3:
            return chosen, refused
        for _, i, j in self._most_alike(looks):
            mine = chosen if possible(i, j) else refused
            full = len(mine) >= self.most or _beside(i, j, mine) >= _TOGETHER
            if not full and not _beside(i, j, known):
                mine.append((i, j))
        return chosen, refused

    def _most_alike(self, looks: Sequence[Float32]) -> list[tuple[float, int, int]]:
        """How much views i < j differ that look alike, though the camera left in between."""
        if len(looks) > _ALL:
            return self._most_alike_of_many(np.stack(looks))
        far = mutual_unlikeness(looks, self.shift)
        away = far >= self.left
        found = [
            (float(far[i, j]), int(i), int(j))
            for j in range(2, len(looks))
            for i in np.flatnonzero(far[: j - 1, j] <= self.unlike)
            if (away[i, i + 1 : j] & away[i + 1 : j, j]).any()
        ]
        return sorted(found)

    def _most_alike_of_many(self, looks: Float32) -> list[tuple[float, int, int]]:
        """The same by an index: each view is compared with those that are likely to be like it."""
        i, j = alike(looks, self.shift)
        far = unlikeness_of_pairs(looks, i, j, self.shift)
        found = []
        for k in np.lexsort((j, i, far)):
            if far[k] > self.unlike:
                break
            a, b = int(i[k]), int(j[k])
            between = np.unique(np.linspace(a + 1, b - 1, min(b - a - 1, _BETWEEN)).round())
            some = looks[between.astype(np.intp)]
            left = unlikeness(looks[a], some, self.shift) >= self.left
            if (left & (unlikeness(looks[b], some, self.shift) >= self.left)).any():
                found.append((float(far[k]), a, b))
        return found

    def plausible(
        self,
        between: Float64,
        length: float,
        turned: float,
        depth: float,
        covariance: Float64 | None = None,
        unsure: float = 0.0,
    ) -> bool:
        """Whether the trajectory may be off by so much.

        Parameters
        ----------
        between
            (4, 4) from where it has the later view to where it was found.
        length, turned
            Of the path from the earlier view to the later one, m, and of the turns on it, rad.
        depth
            Of what they see, m: a view that turns is off to the side as well, by about that.
        covariance
            (6, 6) of the motion between the views, of `between` as a right perturbation. Where it
            is wide, as along a bare wall, drift may be larger in that direction.
        unsure
            Added to what it may be off, in rad and as a share of the depth.
        """
        far = self.drift * (length + depth * turned) + unsure * depth
        wide = self.drift * (turned + length / depth) + unsure
        C = np.zeros((6, 6)) if covariance is None else _SIGMAS**2 * covariance
        off = np.concatenate([between[:3, 3], se3.log(between)[3:]])
        return all(
            off[k] @ np.linalg.solve(C[k, k] + limit**2 * np.eye(3), off[k]) <= 1
            for k, limit in ((slice(0, 3), far), (slice(3, 6), wide))
        )


def _beside(i: int, j: int, pairs: Collection[tuple[int, int]]) -> int:
    """Number of the pairs that are of nearly the same views."""
    return sum(abs(i - k) <= _BESIDE and abs(j - m) <= _BESIDE for k, m in pairs)
