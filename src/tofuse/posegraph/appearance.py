"""Place recognition by appearance alone: poses are not used to find candidates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.geometry import se3
from tofuse.registration.view_descriptor import (
    dissimilarity,
    mutual_dissimilarity,
    pairwise_dissimilarity,
    similar_views,
)

# Pairs whose views differ by at most this many positions are similar, and at most this many of them
# are chosen: two can confirm each other, more would displace other loops.
_SIMILAR, _MAX_SIMILAR = 3, 2
# Maximum number of views that are compared exhaustively; with more, number of views in between that
# are compared to check whether the camera left.
_ALL, _BETWEEN = 512, 64
# Maximum distance of views that look alike: rad, and fraction of the depth.
ALIKE = 0.35
# Maximum error of the trajectory, in standard deviations.
_SIGMAS = 3.0


@dataclass(frozen=True)
class Appearance:
    """Thresholds of similar views and of the drift of the trajectory.

    Attributes
    ----------
    pairs
        Maximum number of pairs of a recording; 0 disables appearance.
    max_difference, min_difference
        Maximum difference of the two views of a pair, and minimum difference of a view in between
        from both: 0 for equal images, 1 for nothing in common.
    shift
        Maximum shift between the images, as a fraction of their width.
    drift
        Maximum drift, as a fraction of the path and of the rotation along it. Pairs that imply more
        are taken for different places that look the same (perceptual aliasing).
    """

    pairs: int = 6
    max_difference: float = 0.3
    min_difference: float = 0.4
    shift: float = 0.25
    drift: float = 0.2

    def candidates(
        self,
        descriptors: Sequence[Float32],
        possible: Callable[[int, int], bool],
        known: Collection[tuple[int, int]] = (),
        gain: Callable[[int, int], float] = lambda i, j: 0.0,
    ) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Return pairs of views that look alike although the camera left in between.

        Parameters
        ----------
        descriptors
            Descriptors of all views in the order of time, see `view_descriptor`.
        possible
            Whether the trajectory allows that views i and j show the same place.
        known
            Pairs that are certain loops: none similar to them is returned.
        gain
            Information gain of a loop between views i and j.

        Returns
        -------
        Positions (i, j), i < j, of the possible pairs and of the others, at most `pairs` of each:
        those with the largest gain first, and of these the most similar.
        """
        chosen: list[tuple[int, int]] = []
        refused: list[tuple[int, int]] = []
        if self.pairs == 0 or len(descriptors) < 3:
            return chosen, refused
        alike = self._most_alike(descriptors)
        for _, i, j in sorted(alike, key=lambda pair: -gain(*pair[1:])):
            mine = chosen if possible(i, j) else refused
            full = len(mine) >= self.pairs or _similar(i, j, mine) >= _MAX_SIMILAR
            if not full and not _similar(i, j, known):
                mine.append((i, j))
        return chosen, refused

    def _most_alike(self, descriptors: Sequence[Float32]) -> list[tuple[float, int, int]]:
        """Return (difference, i, j) of similar views i < j that the camera left in between."""
        if len(descriptors) > _ALL:
            return self._most_alike_of_many(np.stack(descriptors))
        far = mutual_dissimilarity(descriptors, self.shift)
        away = far >= self.min_difference
        found = [
            (float(far[i, j]), int(i), int(j))
            for j in range(2, len(descriptors))
            for i in np.flatnonzero(far[: j - 1, j] <= self.max_difference)
            if (away[i, i + 1 : j] & away[i + 1 : j, j]).any()
        ]
        return sorted(found)

    def _most_alike_of_many(self, descriptors: Float32) -> list[tuple[float, int, int]]:
        """As `_most_alike`, with candidates from an index instead of all pairs."""
        i, j = similar_views(descriptors, self.shift)
        far = pairwise_dissimilarity(descriptors, i, j, self.shift)
        found = []
        for k in np.lexsort((j, i, far)):
            if far[k] > self.max_difference:
                break
            a, b = int(i[k]), int(j[k])
            between = np.unique(np.linspace(a + 1, b - 1, min(b - a - 1, _BETWEEN)).round())
            some = descriptors[between.astype(np.intp)]
            from_a = dissimilarity(descriptors[a], some, self.shift)
            from_b = dissimilarity(descriptors[b], some, self.shift)
            if (np.minimum(from_a, from_b) >= self.min_difference).any():
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
        """Whether a correction of the trajectory is within its drift.

        Parameters
        ----------
        between
            (4, 4) correction: from the later view's pose in the trajectory to its registered pose.
        length, turned
            Length of the path between the views, m, and sum of the rotations along it, rad.
        depth
            Depth of the scene, m: the lever arm by which rotation errors displace views.
        covariance
            (6, 6) of `between` as a right perturbation. Degenerate directions, as along a bare
            wall, allow for more drift.
        unsure
            Added tolerance, in rad and as a fraction of the depth.
        """
        far = self.drift * (length + depth * turned) + unsure * depth
        wide = self.drift * (turned + length / depth) + unsure
        C = np.zeros((6, 6)) if covariance is None else _SIGMAS**2 * covariance
        off = np.concatenate([between[:3, 3], se3.log(between)[3:]])
        return all(
            off[k] @ np.linalg.solve(C[k, k] + limit**2 * np.eye(3), off[k]) <= 1
            for k, limit in ((slice(0, 3), far), (slice(3, 6), wide))
        )


def _similar(i: int, j: int, pairs: Collection[tuple[int, int]]) -> int:
    """Return the number of pairs of nearly the same views as i and j."""
    return sum(abs(i - k) <= _SIMILAR and abs(j - m) <= _SIMILAR for k, m in pairs)
