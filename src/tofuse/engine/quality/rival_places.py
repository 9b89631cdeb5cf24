"""Symmetric rooms, in which a part of the views fits as well at another place.

If opposite halves of a room look the same, views in no order are joined as if all showed one half,
and those that overlap agree. But views that are joined far apart look alike, too. So do those
before and after a gap, in which a camera that turned by any angle may seem to have gone on.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.geometry import se3
from tofuse.engine.search import DISTINCT_M, pair_agreement, register_pair, verification
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import HANDHELD, FrameTime
from tofuse.engine.views import PreparedView, view_descriptors

# Up to this many views, all pairs of descriptors are compared; largest shift between two.
_MAX_EXHAUSTIVE, _MAX_SHIFT = 512, 0.35
# A gap is longer than this multiple of the usual time between frames.
_MIN_GAP = 2.0
# Number of pairs of parts that are examined, those with the most similar views.
_MAX_PAIRS = 8
# Pairs of views from which the usual fit is learnt, and that are compared at a place.
_MAX_LEARNT, _MAX_COMPARED = 16, 8
# Smallest overlap of compared views.
_MIN_OVERLAP = 0.2
# At a rival place, views agree as well but for this fraction.
_EQUAL = 0.1
_ALIGNMENT = projective.ProjectiveOptions(levels=verification.PATIENT)


def ambiguous_places(
    views: Sequence[PosedView[PreparedView]], poses: Mapping[int, Float64],
    moments: Sequence[FrameTime],
) -> tuple[int, ...]:  # fmt: skip
    """Return the frames of parts that fit as well at another place.

    Parts are components, and what lies before and after a gap. The most similar views of different
    parts are registered, of those that don't overlap at the final poses. If the pose found is
    decisive and at another place, the smaller part is moved there, and compared with all others.

    Parameters
    ----------
    views
        Stored views.
    poses
        (4, 4) T_world_camera of each, by frame index.
    moments
        When the frames with a pose were taken, in order.
    """
    views = sorted(views, key=lambda view: view.index)
    gaps = _gaps(moments)
    parts = _parts(views, gaps)
    return _Places(views, poses, parts, gaps).ambiguous() if parts.any() else ()


class _Gap(NamedTuple):
    """The frames before and after a gap, and the time between them."""

    before: int
    after: int
    seconds: float


def _gaps(moments: Sequence[FrameTime]) -> list[_Gap]:
    """Return the gaps over which no motion can be predicted."""
    steps = [(a, b, b.seconds_since(a) or 0.0) for a, b in pairwise(moments)]
    # Where all frames come as late, odometry follows steps that it can't predict.
    least = _MIN_GAP * float(np.median([seconds for *_, seconds in steps])) if steps else 0.0
    return [
        _Gap(a.index, b.index, seconds)
        for a, b, seconds in steps
        if seconds > least and not b.is_predictable_from(a)
    ]


def _parts(views: Sequence[PosedView[PreparedView]], gaps: Sequence[_Gap]) -> Intp:
    """(N,) number of the part of each view, in order, the first 0."""
    after = [gap.after for gap in gaps]
    keys = [(view.component, bisect_right(after, view.index)) for view in views]
    numbers = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], np.intp)


class _Places:
    """Views at their final poses, and how well they usually fit."""

    def __init__(
        self, views: Sequence[PosedView[PreparedView]], poses: Mapping[int, Float64], parts: Intp,
        gaps: Sequence[_Gap],
    ) -> None:  # fmt: skip
        self._views, self._poses, self._gaps = views, poses, gaps
        self._T = np.stack([poses[view.index] for view in views])
        self._depths = np.array([view.depth for view in views])
        self._parts = parts
        self._usual = verification.FitStatistics()
        for i, j in islice(self._neighbours(), _MAX_LEARNT):
            T = se3.inverse(self._T[i]) @ self._T[j]
            target = [projective.Target(views[i].view)]
            fit = projective.align(views[j].view, target, T, _ALIGNMENT)
            if fit.overlap >= _MIN_OVERLAP:
                self._usual.learn(fit, views[j].depth)
        self._tolerances = verification.usual_tolerances(self._usual)

    def ambiguous(self) -> tuple[int, ...]:
        """Return the frames of parts that fit as well at another place."""
        found: set[int] = set()
        for i, j in islice(self._similar(), _MAX_PAIRS):
            registration = register_pair(
                self._views[j].view, self._views[i].view, fit_statistics=self._usual,
                rival_m=DISTINCT_M,
            )  # fmt: skip
            if registration is None or not registration.is_decisive:
                continue
            T_there = self._T[i] @ registration.T_target_source
            motion = se3.inverse(self._T[j]) @ T_there
            if se3.change_of_view(motion, self._depths[j]) < verification.MAX_OVERLAP_DISTANCE:
                continue  # the same place
            moved = self._parts == self._parts[j]
            T = T_there @ se3.inverse(self._T[j])
            if not self._is_reachable(moved, T):
                continue
            here, there = self._agreement(moved, np.eye(4)), self._agreement(moved, T)
            if there > here - _EQUAL * abs(here):
                found.update(self._views[k].index for k in np.flatnonzero(moved).tolist())
        return tuple(sorted(found))

    def _is_reachable(self, moved: Bool, T: Float64) -> bool:
        """Whether a camera is fast enough over all gaps if some views are moved by T (4, 4)."""
        indices = [view.index for view in self._views]
        for gap in self._gaps:
            k = bisect_left(indices, gap.after)
            sides = moved[k - 1 : k + 1]
            if len(sides) < 2 or self._views[k - 1].component != self._views[k].component:
                continue
            positions = (self._poses[gap.before][:3, 3], self._poses[gap.after][:3, 3])
            a, b = (
                se3.transform(T, p) if is_moved else p
                for p, is_moved in zip(positions, sides, strict=True)
            )
            if np.linalg.norm(b - a) > HANDHELD[0] * gap.seconds:
                return False
        return True

    def _neighbours(self) -> Iterator[tuple[int, int]]:
        """Yield views of different parts, with the nearest one."""
        for i in range(len(self._views)):
            distance = self._distances(i)
            distance[self._parts == self._parts[i]] = np.inf
            yield i, int(distance.argmin())

    def _similar(self) -> Iterator[tuple[int, int]]:
        """Yield pairs that look alike and don't overlap, the most similar first.

        One for each two parts; the part of the second is the smaller one.
        """
        descriptors = np.stack([view_descriptors.view_descriptor(v.view) for v in self._views])
        if len(descriptors) <= _MAX_EXHAUSTIVE:
            i, j = np.triu_indices(len(descriptors), 1)
        else:  # by an index, as all pairs would be too many
            i, j = view_descriptors.similar_views(descriptors, _MAX_SHIFT)
        separate = self._parts[i] != self._parts[j]
        i, j = i[separate], j[separate]
        difference = view_descriptors.pairwise_dissimilarity(descriptors, i, j, _MAX_SHIFT)
        size = np.bincount(self._parts)
        examined: set[frozenset[int]] = set()
        for k in np.lexsort((j, i, difference)):
            pair = int(i[k]), int(j[k])
            parts = frozenset(self._parts[list(pair)].tolist())
            apart = self._distances(pair[0])[pair[1]] > verification.MAX_OVERLAP_DISTANCE
            if apart and parts not in examined:
                examined.add(parts)
                first, second = sorted(pair, key=lambda p: -size[self._parts[p]])
                yield first, second

    def _distances(self, i: int) -> Float64:
        """(N,) how far all views are from view `i`, as a fraction of its depth, plus rad."""
        return se3.change_of_view(se3.inverse(self._T[i]) @ self._T, self._depths[i])

    def _agreement(self, moved: Bool, T: Float64) -> float:
        """Return how well the views, moved by T (4, 4), agree with all others; NaN if apart."""
        fixed = np.flatnonzero(~moved)
        near: list[tuple[float, int, int]] = []
        for j in np.flatnonzero(moved).tolist():
            motion = se3.inverse(T @ self._T[j]) @ self._T[fixed]
            distances = se3.change_of_view(motion, self._depths[j]).tolist()
            near += [
                (distance, i, j)
                for distance, i in zip(distances, fixed.tolist(), strict=True)
                if distance < verification.MAX_OVERLAP_DISTANCE
            ]
        score = overlap = 0.0
        compared = 0
        for _, i, j in sorted(near):
            source, target = self._views[j].view, self._views[i].view
            T_i_j = se3.inverse(self._T[i]) @ T @ self._T[j]
            agreement = pair_agreement.agreement(source, target, T_i_j, self._tolerances)
            if agreement.overlap < _MIN_OVERLAP:
                continue
            score, overlap = score + agreement.score, overlap + agreement.overlap
            compared += 1
            if compared == _MAX_COMPARED:
                break
        return score / overlap if compared else np.nan
