"""Place recognition by appearance: poses are not used to select candidates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.geometry import se3
from tofuse.engine.views import view_descriptors

# Pairs whose views differ by at most this many positions are similar, and at most this many of them
# are chosen: two can confirm each other, more would displace other loops.
_SIMILAR, _MAX_SIMILAR = 3, 2
# Maximum number of views that are compared exhaustively; with more, number of views in between that
# are compared to check whether the camera left.
_MAX_EXHAUSTIVE, _MAX_BETWEEN = 512, 64
# Maximum distance of similar views: rad, and fraction of the depth.
MAX_VIEW_DISTANCE = 0.35
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
        are considered different places that look similar (perceptual aliasing).
    """

    pairs: int = 6
    max_difference: float = 0.3
    min_difference: float = 0.4
    shift: float = 0.25
    drift: float = 0.2

    def candidates(
        self,
        descriptors: Sequence[Float32],
        plausible: Callable[[int, int], bool],
        closed: Collection[tuple[int, int]] = (),
        gain: Callable[[int, int], float] = lambda i, j: 0.0,
    ) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Return pairs of similar views between which the camera left the place.

        Parameters
        ----------
        descriptors
            Descriptors of all views in the order of time, see `view_descriptor`.
        plausible
            Whether the drift that a loop between views i and j implies is plausible.
        closed
            Pairs that are loops already: none similar to them is returned.
        gain
            Information gain of a loop between views i and j.

        Returns
        -------
        Positions (i, j), i < j, of the plausible pairs and of the others, at most `pairs` of each:
        those with the largest gain first, and of these the most similar.
        """
        chosen: list[tuple[int, int]] = []
        implausible: list[tuple[int, int]] = []
        if self.pairs == 0 or len(descriptors) < 3:
            return chosen, implausible
        similar = self._most_similar(descriptors)
        for _, i, j in sorted(similar, key=lambda pair: -gain(*pair[1:])):
            group = chosen if plausible(i, j) else implausible
            full = len(group) >= self.pairs or _similar(i, j, group) >= _MAX_SIMILAR
            if not full and not _similar(i, j, closed):
                group.append((i, j))
        return chosen, implausible

    def _most_similar(self, descriptors: Sequence[Float32]) -> list[tuple[float, int, int]]:
        """Return (difference, i, j) of similar views i < j between which the camera left."""
        if len(descriptors) > _MAX_EXHAUSTIVE:
            return self._most_similar_by_index(np.stack(descriptors))
        difference = view_descriptors.mutual_dissimilarity(descriptors, self.shift)
        distinct = difference >= self.min_difference
        pairs = [
            (float(difference[i, j]), int(i), int(j))
            for j in range(2, len(descriptors))
            for i in np.flatnonzero(difference[: j - 1, j] <= self.max_difference)
            if (distinct[i, i + 1 : j] & distinct[i + 1 : j, j]).any()
        ]
        return sorted(pairs)

    def _most_similar_by_index(self, descriptors: Float32) -> list[tuple[float, int, int]]:
        """As `_most_similar`, with candidates from an index instead of all pairs."""
        i, j = view_descriptors.similar_views(descriptors, self.shift)
        difference = view_descriptors.pairwise_dissimilarity(descriptors, i, j, self.shift)
        pairs = []
        for k in np.lexsort((j, i, difference)):
            if difference[k] > self.max_difference:
                break
            a, b = int(i[k]), int(j[k])
            between = np.unique(np.linspace(a + 1, b - 1, min(b - a - 1, _MAX_BETWEEN)).round())
            sampled = descriptors[between.astype(np.intp)]
            from_a = view_descriptors.dissimilarity(descriptors[a], sampled, self.shift)
            from_b = view_descriptors.dissimilarity(descriptors[b], sampled, self.shift)
            if (np.minimum(from_a, from_b) >= self.min_difference).any():
                pairs.append((float(difference[k]), a, b))
        return pairs

    def plausible(
        self,
        correction: Float64,
        length: float,
        rotation: float,
        depth: float,
        covariance: Float64 | None = None,
        tolerance: float = 0.0,
    ) -> bool:
        """Whether a correction of the trajectory is within its drift.

        Parameters
        ----------
        correction
            (4, 4) correction: from the later view's pose in the trajectory to its registered pose.
        length, rotation
            Length of the path between the views, m, and sum of the rotations along it, rad.
        depth
            Depth of the scene, m: the lever arm by which rotation errors displace views.
        covariance
            (6, 6) of `correction` as a right perturbation. Degenerate directions, as along a bare
            wall, allow for more drift.
        tolerance
            Added tolerance, in rad and as a fraction of the depth.
        """
        max_translation = self.drift * (length + depth * rotation) + tolerance * depth
        max_rotation = self.drift * (rotation + length / depth) + tolerance
        C = np.zeros((6, 6)) if covariance is None else _SIGMAS**2 * covariance
        error = np.concatenate([correction[:3, 3], se3.log(correction)[3:]])
        return all(
            error[k] @ np.linalg.solve(C[k, k] + limit**2 * np.eye(3), error[k]) <= 1
            for k, limit in ((slice(0, 3), max_translation), (slice(3, 6), max_rotation))
        )


def _similar(i: int, j: int, pairs: Collection[tuple[int, int]]) -> int:
    """Return the number of pairs of nearly the same views as i and j."""
    return sum(abs(i - k) <= _SIMILAR and abs(j - m) <= _SIMILAR for k, m in pairs)
