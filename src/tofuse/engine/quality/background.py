"""Whether views from other times confirm the poses of frames in which a large part moves.

Where something that moves covers much of the view, consecutive views can't tell it from the room.
Views from other times, in which nothing moves, can: at the right poses they have the same
background around it, and neither sees through a surface of the other. So a frame is confirmed if
more of it lies on surfaces of such views than moves, and if no more contradicts them than may move
in a view without leaving the choice open. A confirmed frame helps to confirm others. All must
be connected by pairs that agree: of two parts that aren't, either may have followed what moves.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.connections import parts_of
from tofuse.engine.quality import cross_view_agreement
from tofuse.engine.views import PreparedView


class Movement(NamedTuple):
    """What may move in a frame, as shares of the view.

    Attributes
    ----------
    excluded
        Segmented as moving, and excluded.
    rival
        Follows a rival of the tracked motion; it was not excluded.
    """

    excluded: float = 0.0
    rival: float = 0.0


@dataclass(frozen=True)
class Limits:
    """Which views count as still.

    Attributes
    ----------
    max_share
        Largest share of a rival.
    delay
        Number of frames by which a rival is noticed late, and forgotten late.
    """

    max_share: float
    delay: int


def confirmed(
    views: Sequence[PreparedView],
    poses: Float64,
    frames: Sequence[int],
    open_frames: Collection[int],
    movements: Mapping[int, Movement],
    limits: Limits,
) -> frozenset[int]:
    """Return the open frames that views from other times confirm.

    None are, unless more frames are still than open. A frame without a view is confirmed if the
    next ones that are open, before and after it, are.

    Parameters
    ----------
    views, poses
        Views of some frames, without what was excluded, and their (V, 4, 4) T_world_camera.
    frames, open_frames
        Ascending indices of all frames, and those of the frames to be confirmed.
    movements
        By frame index; nothing moves in other frames.
    limits
        Which of the other frames are still.
    """
    still = _still(frames, open_frames, movements, limits)
    used = [k for k, v in enumerate(views) if v.index in still or v.index in open_frames]
    indices = np.array([views[k].index for k in used], np.intp)
    is_still = np.isin(indices, list(still))
    if len(still) <= len(open_frames) or is_still.all() or not is_still.any():
        return frozenset()
    shares = np.array([movements.get(k, Movement()) for k in indices.tolist()])
    pairs = _Pairs.of([views[k] for k in used], poses[used], limits.max_share)
    found = pairs.confirmed(is_still, shares)
    return _extended(open_frames, indices[~is_still], found[~is_still])


def _still(
    frames: Sequence[int],
    open_frames: Collection[int],
    movements: Mapping[int, Movement],
    limits: Limits,
) -> set[int]:
    """Return the frames in which nothing moves."""
    indices = np.asarray(frames)
    still = ~np.isin(indices, list(open_frames))
    for k, index in enumerate(frames):
        movement = movements.get(index, Movement())
        still[k] &= movement.excluded == 0
        if movement.rival > limits.max_share:
            still &= np.abs(indices - index) > limits.delay
    return set(indices[still].tolist())


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Agreement of all pairs of views at their poses; zero where they hardly overlap.

    Attributes
    ----------
    support, contradiction
        (V, V) shares of the points of both that support and contradict the poses.
    supported
        Points of each view, (n,) by number, on surfaces of another, by (view, other).
    max_share
        Share of what contradicts, up to which two views agree.
    """

    support: Float64
    contradiction: Float64
    supported: dict[tuple[int, int], Bool]
    max_share: float

    @classmethod
    def of(cls, views: Sequence[PreparedView], poses: Float64, max_share: float) -> _Pairs:
        n = len(views)
        support, contradiction, supported = np.zeros((n, n)), np.zeros((n, n)), {}
        for i, j, both, of_i, of_j in cross_view_agreement.overlapping_pairs(views, poses):
            support[i, j] = support[j, i] = both.support
            contradiction[i, j] = contradiction[j, i] = both.violation + both.clash
            supported[i, j], supported[j, i] = of_i, of_j
        return cls(support, contradiction, supported, max_share)

    def confirmed(self, still: Bool, shares: Float64) -> Bool:
        """Return the connected views (V,): still ones, and those that they confirm.

        Parameters
        ----------
        still
            (V,) still views.
        shares
            (V, 2) shares as in `Movement`.
        """
        known, before = still, np.zeros_like(still)
        while (known != before).any():
            before = known
            known = known | [self._shows(k, before, *shares[k]) for k in range(len(still))]
        groups = parts_of(len(known), np.argwhere(self._agrees & np.outer(known, known)))
        largest = np.argmax(np.bincount(groups[known]))
        return np.asarray(known & (groups == largest))

    @cached_property
    def _agrees(self) -> Bool:
        total = self.support + self.contradiction
        return np.asarray((total > 0) & (self.contradiction <= self.max_share * total))

    def _shows(self, k: int, known: Bool, excluded: float, rival: float) -> bool:
        """Whether known views show more of a view than moves, and don't contradict it."""
        for_it, against = self.support[k, known].sum(), self.contradiction[k, known].sum()
        agreeing = np.flatnonzero(self._agrees[k] & known).tolist()
        if not agreeing or against > self.max_share * (for_it + against):
            return False
        shown = np.mean(np.any([self.supported[k, j] for j in agreeing], axis=0))
        return bool(shown * (1 - excluded) > max(excluded, rival))


def _extended(open_frames: Collection[int], indices: Intp, found: Bool) -> frozenset[int]:
    """Return the open frames whose next views before and after, at ascending indices, are found."""
    frames = np.array(sorted(open_frames), np.intp)
    before = np.searchsorted(indices, frames, "right") - 1
    after = np.searchsorted(indices, frames)
    last = len(indices) - 1
    both = found[np.clip(before, 0, last)] & found[np.clip(after, 0, last)]
    return frozenset(frames[both].tolist())
