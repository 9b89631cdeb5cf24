"""Periodic scenes, in which another step between two frames fits as well as the tracked one.

A floor of equal tiles looks the same after a step by one tile. Where the camera may have moved as
far from one frame to the next, no image tells which step is right, and a result with wrong steps
is as consistent as the right one. So pairs of views are aligned again from starts all around.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.search import DISTINCT_M, pair_agreement
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import HANDHELD, FrameTime, reach_m
from tofuse.engine.views import PreparedView

# Number of pairs of views that are examined, spread over those far enough apart in time.
_MAX_PAIRS = 4
# Starts: directions in the image plane and along the axis, and distances as fractions of the reach.
_ANGLES = np.arange(8) * np.pi / 4
_DIRECTIONS = np.array(
    [*np.stack([np.cos(_ANGLES), np.sin(_ANGLES), 0 * _ANGLES], axis=1), (0, 0, -1), (0, 0, 1)]
)
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


class _Moved(NamedTuple):
    """The step to a late frame, and what other step its time allows.

    Attributes
    ----------
    step
        (3,) m, as tracked, in the axes of the world.
    deviation, reach
        How far the true step may lie from it where the steps before are right; and its greatest
        length, m.
    """

    step: Float64
    deviation: float
    reach: float


def ambiguous_frames(
    views: Sequence[PosedView[PreparedView]], poses: Mapping[int, Float64],
    moments: Sequence[FrameTime],
) -> tuple[int, ...]:  # fmt: skip
    """Return the frames to which another step, from the view before, fits as well.

    Some pairs of consecutive views are examined: of those where a frame came so late after the one
    before that the camera may have moved otherwise. A step that differs more from the tracked one
    than a camera accelerates is possible only if all steps differ.

    Parameters
    ----------
    views
        Stored views.
    poses
        (4, 4) T_world_camera of each, and of all frames in `moments`, by frame index.
    moments
        When the frames with a pose were taken, in order. Without timestamps nothing is examined.
    """
    late = {
        now.index: moved
        for before, now in pairwise(moments)
        if (seconds := now.seconds_since(before)) is not None
        and (moved := _moved(poses[before.index], poses[now.index], seconds)).reach > DISTINCT_M
    }
    pairs = []
    for earlier, later in pairwise(sorted(views, key=lambda view: view.index)):
        moves = [late[index] for index in late if earlier.index < index <= later.index]
        if moves and earlier.component == later.component:
            pairs.append((earlier, later, max(moves, key=lambda moved: moved.reach)))
    chosen = np.unique(np.linspace(0, len(pairs) - 1, _MAX_PAIRS).astype(int)) if pairs else ()
    shifts = {}
    for earlier, later, moved in (pairs[k] for k in chosen):
        T_world_earlier = poses[earlier.index]
        T = se3.inverse(T_world_earlier) @ poses[later.index]
        moved = moved._replace(step=T_world_earlier[:3, :3].T @ moved.step)
        shifts[later.index] = nearest_rival(earlier.view, later.view, T, moved), moved.deviation
    everywhere = all(np.isfinite(shift) for shift, _ in shifts.values())
    return tuple(k for k, (shift, deviation) in shifts.items() if everywhere or shift < deviation)


def _moved(T_world_before: Float64, T_world_now: Float64, seconds: float) -> _Moved:
    step, deviation = T_world_now[:3, 3] - T_world_before[:3, 3], reach_m(seconds)
    length = float(np.linalg.norm(step))
    # A camera that is faster than a person walks may be as fast in another direction.
    return _Moved(step, deviation, deviation if length < deviation else HANDHELD[0] * seconds)


def nearest_rival(
    earlier: PreparedView, later: PreparedView, T_earlier_later: Float64, moved: _Moved
) -> float:
    """Return the distance of the nearest other pose that fits as well, m; inf without one.

    It is within the reach, and determined in all directions. The step is in the axes of the
    earlier view.
    """
    targets = [projective.Target(earlier)]

    def aligned(
        starts: Sequence[Float64], options: projective.ProjectiveOptions
    ) -> list[projective.Aligned]:
        return run_all([partial(projective.align, later, targets, T, options) for T in starts])

    def shift(found: projective.Aligned) -> Float64:
        return np.asarray(found.T_world_source[:3, 3] - own.T_world_source[:3, 3], np.float64)

    def is_rival(found: projective.Aligned) -> bool:
        return bool(
            np.linalg.norm(shift(found)) > DISTINCT_M
            and np.linalg.norm(moved.step + shift(found)) < moved.reach
        )

    (own,) = aligned([T_earlier_later], _FINE)
    offsets = [r * axis for r in _DISTANCES for axis in _DIRECTIONS]
    shifts = [moved.deviation * offset for offset in offsets]
    if np.linalg.norm(moved.step) > 0.5 * moved.deviation:  # else about the same
        shifts += [moved.reach * offset - moved.step for offset in offsets]
    starts = [se3.translation(d) @ T_earlier_later for d in shifts]
    best = sorted(filter(is_rival, aligned(starts, _COARSE)), key=_score, reverse=True)[:_MAX_FINE]
    rivals = [
        rival
        for rival in aligned([b.T_world_source for b in best], _FINE)
        if is_rival(rival)
        and not len(rival.unobservable)
        and _score(rival) > (1 - _MAX_LOSS) * _score(own)
    ]
    if not rivals or own.overlap < _MIN_OVERLAP:
        return np.inf
    images = pair_agreement.Comparison.of(later, earlier)
    agreement = _agreement(images.at(own.T_world_source))
    least = agreement - _EQUAL * abs(agreement)  # it is negative where noise hides the pattern
    return min(
        (
            float(np.linalg.norm(shift(rival)))
            for rival in rivals
            if _agreement(images.at(rival.T_world_source)) > least
        ),
        default=np.inf,
    )


def _score(found: projective.Aligned) -> float:
    """Return the score for each point that both views see."""
    return found.score / found.overlap if found.overlap >= _MIN_OVERLAP else -np.inf


def _agreement(found: pair_agreement.Agreement) -> float:
    """Return how well two images agree where both see a surface."""
    return found.score / max(found.overlap, 1e-9)
