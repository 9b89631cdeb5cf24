"""Periodic scenes, in which another step between two frames fits as well as the tracked one.

A floor of equal tiles looks the same after a step by one tile. Where the camera may have moved as
far from one frame to the next, no image tells which step is right, and a result with wrong steps
is as consistent as the right one. So pairs of views are aligned again from starts all around.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.search import DISTINCT_M, pair_agreement
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import FrameTime, reach_m
from tofuse.engine.views import PreparedView

# Number of pairs of views that are examined, spread over those far enough apart in time.
_MAX_PAIRS = 4
# Starts: directions in the image plane, and distances as fractions of the reach.
_DIRECTIONS = np.exp(0.25j * np.pi * np.arange(8))
_DISTANCES = (0.3, 0.6, 0.9)
_COARSE = projective.ProjectiveOptions(
    levels=(projective.Level(4, 12, 0.03, 0.1),), common_tilt=0.0, common_slope=0.0
)
_FINE = projective.ProjectiveOptions(
    levels=(projective.Level(4, 6, 0.005, 0.02), projective.Level(2, 6, 0.0, 0.0)),
    common_tilt=0.0,
    common_slope=0.0,
)
# Number of starts that are aligned finely: those that fit best.
_MAX_FINE = 4
# A rival sees this fraction of the view at least. Its alignment scores this fraction lower at most
# for each point that it sees; an alignment gives the pattern of a surface little weight, so the
# images must also agree as well but for a tenth: by a period they do, in bare rooms half as well.
_MIN_OVERLAP, _MAX_LOSS, _EQUAL = 0.5, 0.25, 0.1


def ambiguous_frames(
    views: Sequence[PosedView[PreparedView]], poses: Mapping[int, Float64],
    moments: Sequence[FrameTime],
) -> tuple[int, ...]:  # fmt: skip
    """Return the frames to which another step, from the view before, fits as well.

    Some pairs of consecutive views are examined: of those where a frame came so late after the one
    before that the camera may have moved otherwise.

    Parameters
    ----------
    views
        Stored views.
    poses
        (4, 4) T_world_camera of each, by frame index.
    moments
        When the frames with a pose were taken, in order. Without timestamps nothing is examined.
    """
    late = [
        (now.index, reach)
        for before, now in pairwise(moments)
        if (seconds := now.seconds_since(before)) is not None
        and (reach := reach_m(seconds)) > DISTINCT_M
    ]
    pairs = []
    for earlier, later in pairwise(sorted(views, key=lambda view: view.index)):
        reaches = [reach for index, reach in late if earlier.index < index <= later.index]
        if reaches and earlier.component == later.component:
            pairs.append((earlier, later, max(reaches)))
    chosen = np.unique(np.linspace(0, len(pairs) - 1, _MAX_PAIRS).astype(int)) if pairs else ()
    found = []
    for earlier, later, reach in (pairs[k] for k in chosen):
        T = se3.inverse(poses[earlier.index]) @ poses[later.index]
        if has_rival(earlier.view, later.view, T, reach):
            found.append(later.index)
    return tuple(found)


def has_rival(
    earlier: PreparedView, later: PreparedView, T_earlier_later: Float64, reach: float
) -> bool:
    """Whether a pose within the reach, m, is determined in all directions and fits as well."""
    targets = [projective.Target(earlier)]

    def aligned(
        starts: Sequence[Float64], options: projective.ProjectiveOptions
    ) -> list[projective.Aligned]:
        return run_all([partial(projective.align, later, targets, T, options) for T in starts])

    def is_rival(found: projective.Aligned) -> bool:
        shift = found.T_world_source[:3, 3] - own.T_world_source[:3, 3]
        return bool(DISTINCT_M < np.linalg.norm(shift) < reach)

    (own,) = aligned([T_earlier_later], _FINE)
    offsets = reach * np.outer(_DISTANCES, _DIRECTIONS).ravel()
    starts = [T_earlier_later @ se3.translation((d.real, d.imag, 0.0)) for d in offsets]
    best = sorted(filter(is_rival, aligned(starts, _COARSE)), key=_score, reverse=True)[:_MAX_FINE]
    rivals = [
        rival.T_world_source
        for rival in aligned([b.T_world_source for b in best], _FINE)
        if is_rival(rival)
        and not len(rival.unobservable)
        and _score(rival) > (1 - _MAX_LOSS) * _score(own)
    ]
    if not rivals or own.overlap < _MIN_OVERLAP:
        return False
    images = pair_agreement.Comparison.of(later, earlier)
    agreement = _agreement(images.at(own.T_world_source))
    least = agreement - _EQUAL * abs(agreement)  # it is negative where noise hides the pattern
    return any(_agreement(images.at(T)) > least for T in rivals)


def _score(found: projective.Aligned) -> float:
    """Return the score for each point that both views see."""
    return found.score / found.overlap if found.overlap >= _MIN_OVERLAP else -np.inf


def _agreement(found: pair_agreement.Agreement) -> float:
    """Return how well two images agree where both see a surface."""
    return found.score / max(found.overlap, 1e-9)
