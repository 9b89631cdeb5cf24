"""Loops between clouds that overlap, many steps apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import scipy  # loads its parts when they are used

from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import Frame, evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.icp import extent
from tofuse.engine.loops.information_gain import InformationGain
from tofuse.engine.loops.loops import (
    ClosedLoop,
    Confirmation,
    LoopDetector,
    Loops,
    PriorLoop,
    close_prior_loop,
    in_order,
)
from tofuse.engine.parts import part
from tofuse.engine.search import SearchOptions
from tofuse.engine.stored_views import ViewStore
from tofuse.engine.views import PreparedView

# Smallest information gain of a loop, bits per direction: over at least seven steps.
_MIN_GAIN = 2.0
# Views for each candidate that may be rejected, and the least number of those.
_VIEWS_PER_FAILURE, _MIN_FAILURES = 6, 3
# Views that are compared at most, evenly spaced, and points of a view of which the cells are taken.
_MAX_VIEWS, _POINTS = 1000, 20_000


@part("loops", "overlapping")
@dataclass(frozen=True)
class Overlapping(Bounded, LoopDetector):
    """Selects pairs of views that fill the same cells of space, over as many steps as possible.

    Neither cameras nor lengths in metres are needed: clouds may be of any size, and the positions
    of their scanners unknown. One after the other, the pair with the largest information gain is
    registered, each step of the path and each loop counted as equally accurate, until no pair is
    more than a few steps apart.

    Attributes
    ----------
    min_overlap
        Smallest fraction of the cells of the view with fewer cells that the other fills as well.
    cell
        Edge of the cells, a fraction of the median extent of the views: about the drift that still
        lets a loop be found.
    confirmation
        Accepts or rejects candidates.
    """

    min_overlap: Annotated[float, Bounds(0, 1)] = 0.2
    cell: Annotated[float, Bounds(0, 1, exclusive=True)] = 0.05
    confirmation: Confirmation = field(default_factory=Confirmation)

    def start(
        self,
        seed: int,
        prior: Sequence[PriorLoop],
        views: ViewStore[PreparedView],
        search: SearchOptions | None = None,
    ) -> Loops:
        """See `LoopDetector.start`. Given loops are tried in addition to detected ones."""
        return _OverlappingLoops(self, seed, prior)

    def overlaps(self, clouds: Sequence[Float64]) -> Float64:
        """Return the (N, N) fractions of common cells of clouds (n, 3) in the world."""
        size = self.cell * max(float(np.median([extent(points) for points in clouds])), 1e-12)
        cells = [np.unique(np.floor(points / size).astype(np.int64), axis=0) for points in clouds]
        counts = np.array([len(filled) for filled in cells])
        _, column = np.unique(np.concatenate(cells), axis=0, return_inverse=True)
        rows = np.repeat(np.arange(len(cells)), counts)
        filled = scipy.sparse.csr_array((np.ones(len(rows)), (rows, column.ravel())))
        shared = (filled @ filled.T).toarray()
        return np.asarray(shared / np.maximum(np.minimum.outer(counts, counts), 1))


class _OverlappingLoops(Loops):
    def __init__(self, options: Overlapping, seed: int, prior: Sequence[PriorLoop]) -> None:
        self._options = options
        self._prior_loops = prior
        self._seed = seed
        self._views: dict[int, Frame] = {}

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Loops.push`."""
        self._views[view.index] = view

    def detection_job(self) -> Callable[[], list[ClosedLoop]] | None:
        """See `Loops.detection_job`. Loops are detected at the end."""
        return None

    def finish(
        self, poses: Mapping[int, Float64], covariances: Mapping[int, Float64]
    ) -> list[ClosedLoop]:
        """See `Loops.finish`."""
        posed = np.array([index for index in poses if index in self._views], np.intp)
        frames: list[int] = evenly_spaced(posed, _MAX_VIEWS).tolist()

        def confirm(i: int, j: int) -> ClosedLoop:
            guess = se3.inverse(poses[i]) @ poses[j]
            confirmation = self._options.confirmation
            return confirmation.confirm(self._views[j], self._views[i], guess, seed=self._seed)

        closed = {
            (loop.i, loop.j): close_prior_loop(loop, posed, confirm) for loop in self._prior_loops
        }
        position = {index: k for k, index in enumerate(frames)}
        # Whole numbers of steps, so that the rounded gain of seven does not depend on where.
        gain = InformationGain(np.arange(len(frames), dtype=np.float64), 1.0)
        for (i, j), given in closed.items():
            if given.record.accepted and i in position and j in position:
                gain.add(position[i], position[j])
        if len(frames) < 2:
            return in_order(closed)
        overlap = self._options.overlaps([self._sample(k, poses[k]) for k in frames])
        # A pair of `frames` by position in each row, not registered yet.
        earlier, later = np.nonzero(np.triu(overlap >= self._options.min_overlap, 1))
        failures = max(_MIN_FAILURES, len(frames) // _VIEWS_PER_FAILURE)
        while len(earlier) and failures:
            gains = gain.of(earlier, later)
            best = int(np.lexsort((overlap[earlier, later], gains))[-1])
            if gains[best] < _MIN_GAIN:
                break
            i, j = int(earlier[best]), int(later[best])
            earlier, later = np.delete(earlier, best), np.delete(later, best)
            pair = frames[i], frames[j]
            if pair in closed:
                continue
            closed[pair] = confirm(*pair)
            if closed[pair].record.accepted:
                gain.add(i, j)
            else:
                failures -= 1
        return in_order(closed)

    def _sample(self, index: int, T_world_view: Float64) -> Float64:
        """Return points (n, 3) of a view in the world, enough to fill its cells."""
        points = self._views[index].points
        return se3.transform(T_world_view, points[:: max(1, len(points) // _POINTS)])
