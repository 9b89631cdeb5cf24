"""Selection of the pairs of views that may form a loop, from views, poses and covariances."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.compute import Spill
from tofuse.engine.geometry import se3
from tofuse.engine.graph import graph_covariances
from tofuse.engine.loops.appearance import MAX_VIEW_DISTANCE, Appearance
from tofuse.engine.loops.information_gain import InformationGain
from tofuse.engine.stored_views import (
    CoarseView,
    HasCoarseView,
    PosedView,
    Spilled,
    SpilledCoarseView,
    overlaps,
    sampled_points,
)
from tofuse.engine.views import PreparedView, view_descriptors

Pair = tuple[int, int]  # frames (i, j), i < j
LoopView = PosedView[PreparedView]

_POINTS = 600
# A candidate is a revisit if some view in between overlaps either view by less than this.
MAX_OVERLAP_BETWEEN = 0.1
# Number of views that the limits on searches refer to.
_VIEWS_PER_BUDGET = 200


@dataclass(frozen=True, eq=False)
class CandidateView(SpilledCoarseView):
    """What the selection needs of a view: little memory. `descriptor`: see `view_descriptor`."""

    descriptor: Float32


class CandidateSelector:
    """Ranks the pairs of views that may form a loop.

    `overlapping` are to be registered from the trajectory; `similar` ones, and the
    `most_informative` of those that were rejected, to be searched.

    Parameters
    ----------
    overlap, per_view
        As in `Revisits`.
    appearance
        Selects similar views.
    spill
        Storage of coarse views.
    """

    def __init__(
        self, overlap: float, per_view: int, appearance: Appearance, spill: Spill[CoarseView]
    ) -> None:
        self._min_overlap, self._per_view, self._appearance = overlap, per_view, appearance
        self._spill = spill
        self._views: dict[int, CandidateView] = {}
        self._position: dict[int, int] = {}
        self._poses = np.zeros((0, 4, 4))
        self._covariances = np.zeros((0, 6, 6))
        self._path_lengths, self._depth = np.zeros((0, 2)), np.zeros(0)
        self._variance: dict[int, float] = {}  # of the positions by odometry, m^2
        self._gain = InformationGain(np.zeros(0))
        self._overlap: dict[Pair, float] = {}

    @property
    def budgets(self) -> int:
        """Number by which limits on searches are multiplied."""
        return max(1, -(-len(self._position) // _VIEWS_PER_BUDGET))

    def revisits_of_newest(self, posed: Sequence[LoopView]) -> list[Pair]:
        """Return overlapping pairs of the newest view with others of its component, (i, j)."""
        poses = np.stack([p.T_component_camera for p in posed])
        no_gain, first = InformationGain(np.zeros(len(posed))), len(posed) - 1
        found = revisited(
            self._views_of(posed), poses, self._min_overlap, self._per_view, no_gain, first
        )
        return [(posed[i].index, posed[j].index) for i, j in found]

    def set_trajectory(
        self,
        posed: Sequence[LoopView],
        poses: Mapping[int, Float64],
        covariances: Mapping[int, Float64],
    ) -> None:
        """Set the views to choose from, and the poses (4, 4) and covariances (6, 6) of all frames.

        The first covariances are those of odometry.
        """
        self._position = {p.index: k for k, p in enumerate(posed)}
        self._views_of(posed)
        self._depth = np.array([p.depth for p in posed])
        self._poses = np.array([poses[p.index] for p in posed]).reshape(-1, 4, 4)
        self._covariances = np.array([covariances[p.index] for p in posed]).reshape(-1, 6, 6)
        path_lengths = _path_lengths(poses)
        self._path_lengths = np.array([path_lengths[p.index] for p in posed]).reshape(-1, 2)
        for p, C in zip(posed, self._covariances, strict=True):  # NaN where not constrained
            self._variance.setdefault(p.index, float(np.nan_to_num(np.trace(C[:3, :3]))))

    def condition(self, accepted: Iterable[Pair]) -> None:
        """Assume these loops for the information gain of others."""
        self._gain = InformationGain(np.array([self._variance[index] for index in self._position]))
        for pair in self._positions(accepted):
            self._gain.add(*pair)

    def overlapping(self) -> list[Pair]:
        """Return pairs that overlap after the camera left the place."""
        views, frames = list(self._views.values()), list(self._position)
        found = revisited(views, self._poses, self._min_overlap, self._per_view, self._gain)
        self._overlap = {(frames[i], frames[j]): overlap for (i, j), overlap in found.items()}
        return list(self._overlap)

    def similar(self, accepted: Iterable[Pair]) -> tuple[list[Pair], list[Pair]]:
        """Return pairs that look similar: plausible and implausible ones.

        None of them is similar to an accepted pair.
        """
        appearance = replace(self._appearance, pairs=self._appearance.pairs * self.budgets)
        frames = list(self._position)
        plausible, implausible = appearance.candidates(
            [view.descriptor for view in self._views.values()],
            lambda i, j: self.is_plausible(frames[i], frames[j], np.eye(4), MAX_VIEW_DISTANCE),
            self._positions(accepted),
            lambda i, j: float(self._gain.of(i, j)),
        )
        return (
            [(frames[i], frames[j]) for i, j in plausible],
            [(frames[i], frames[j]) for i, j in implausible],
        )

    def most_informative(
        self, pairs: Collection[Pair], count: int, *, min_gain: float = 0.0
    ) -> list[Pair]:
        """Choose overlapping pairs greedily: the largest gain given those before, then overlap.

        `pairs` are some of `overlapping`, which has been called, as has `condition`.
        """
        remaining = list(pairs)
        chosen: list[Pair] = []
        while remaining and len(chosen) < count:
            positions = self._positions(remaining)
            gains = self._gain.of(*np.transpose(positions))
            best = max(range(len(remaining)), key=lambda k: (gains[k], self._overlap[remaining[k]]))
            if gains[best] < min_gain:
                break
            self._gain.add(*positions[best])
            chosen.append(remaining.pop(best))
        return chosen

    def is_plausible(self, i: int, j: int, T_i_j: Float64, tolerance: float = 0.0) -> bool:
        """Whether the trajectory can have drifted so far that views have a relative pose (4, 4).

        `tolerance` is added to the drift: rad, and fraction of the depth.
        """
        a, b = self._position[i], self._position[j]
        T_tracked = se3.inverse(self._poses[a]) @ self._poses[b]
        C = graph_covariances.relative_covariance(
            T_tracked, self._covariances[a], self._covariances[b]
        )
        length, rotation = (self._path_lengths[b] - self._path_lengths[a]).tolist()
        depth = 0.5 * float(self._depth[a] + self._depth[b])
        correction = se3.inverse(T_tracked) @ T_i_j
        return self._appearance.plausible(correction, length, rotation, depth, C, tolerance)

    def _positions(self, pairs: Iterable[Pair]) -> list[Pair]:
        """Return the positions of the views of pairs, as far as they are known."""
        position = self._position
        return [(position[i], position[j]) for i, j in pairs if i in position and j in position]

    def _views_of(self, posed: Sequence[LoopView]) -> list[CandidateView]:
        """Return the data of views, each computed once."""
        previous = self._views
        self._views = {p.index: previous.get(p.index) or self._view_of(p) for p in posed}
        return list(self._views.values())

    def _view_of(self, posed: LoopView) -> CandidateView:
        surface = posed.view.without_caches()
        coarse = CoarseView.of(surface, sampled_points(surface, _POINTS))
        return CandidateView(
            coarse.centroid, Spilled(coarse, self._spill), view_descriptors.view_descriptor(surface)
        )


def revisited(
    views: Sequence[HasCoarseView],
    poses: Float64,
    min_overlap: float,
    per_view: int,
    gain: InformationGain,
    first: int = 0,
) -> dict[Pair, float]:
    """Return the overlaps of views between which the camera left, by positions (i, j), i < j.

    Parameters
    ----------
    views, poses
        N views, and their (N, 4, 4) T_world_camera.
    min_overlap, per_view
        Smallest overlap; number of pairs of each view with the largest overlap, and unless it is 0
        the one with the largest gain.
    gain
        Information gain of loops between the views.
    first
        Smallest j.
    """
    pairs, overlap_of = overlaps(views, poses, MAX_OVERLAP_BETWEEN, first=first)
    loops: dict[Pair, float] = {}
    ends = np.searchsorted(pairs[:, 1], np.arange(len(views) + 1))
    for j in range(first, len(views)):
        rows = slice(ends[j], ends[j + 1])
        partners, overlap = pairs[rows, 0], overlap_of[rows]
        # The camera never left the unbroken run of partners up to this view.
        overlapping = np.zeros(j + 1, bool)
        overlapping[partners], overlapping[j] = True, True
        last_gap = int(np.flatnonzero(~overlapping)[-1]) if not overlapping.all() else -1
        is_revisit = (partners < last_gap) & (overlap >= min_overlap)
        if not is_revisit.any():
            continue
        partners, overlap = partners[is_revisit], overlap[is_revisit]
        largest_overlap = np.argsort(-overlap, kind="stable")[:per_view]
        largest_gain = np.lexsort((-overlap, -gain.of(partners, j)))[: min(1, per_view)]
        selected = np.union1d(largest_overlap, largest_gain)
        loops |= {(int(partners[k]), j): float(overlap[k]) for k in selected}
    return loops


def _path_lengths(poses: Mapping[int, Float64]) -> dict[int, Float64]:
    """(2,) path length, m, and accumulated rotation, rad, from the first frame to each."""
    indices = sorted(poses)
    trajectory = np.stack([poses[k] for k in indices])
    steps = se3.inverse(trajectory[:-1]) @ trajectory[1:]
    lengths = np.concatenate([np.zeros((1, 2)), np.cumsum(se3.lengths(steps), axis=0)])
    return dict(zip(indices, lengths, strict=True))
