"""Whether a correction may stay: a trial on some views of a recording, which knows no truth.

A correction that takes off an error which is not there bends what was straight. How well two views
fit each other does not tell, as both are bent alike. But then each alignment is dragged, so that
three of them no longer add up: from the first view to the second, on to the third, and straight
from the first to the third. The trial compares that gap with and without the correction, on triples
of neighbouring views all over the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from tofuse.errors import UnreadableFrameError
from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceMap, SurfaceOptions, surface_map
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.registration.projective import (
    UNITS,
    Aligned,
    Level,
    ProjectiveOptions,
    Target,
    align,
)

Float64 = NDArray[np.float64]

# Runs of so many views each, each of them one piece of evidence; where in the recording they begin,
# in such an order that the first ones are all over it already.
_VIEWS = 4
_PLACES = tuple(k / 11 for k in (0, 6, 3, 9, 1, 7, 4, 10, 2, 8, 5, 11))
# Motion between the views of a run: rad, or as a share of the depth; the least of it that tells
# anything, and by which factor a guess is mended at once.
_ANGLE, _DISTANCE = 0.17, 0.085
_LEAST, _TOO_FAR = 0.4, 3.0
# Largest number of frames from one view of a run to the next.
_FARTHEST = 64
# Least share of the points that meet a surface of the other view, and fit it.
_FITS = 0.3
# No triple counts for more.
_COUNTS = 1.5
# A direction that so much of an alignment leaves open is not compared, nor are triples that are
# held in fewer; and gaps, in units of 1 cm and 1 degree, that are as good as none.
_OPEN, _LEAST_HELD, _NOTHING = 0.3, 3, 1e-3
# Fewest runs that can tell, how much larger the gap must be, and the chance of that by luck.
_LEAST_RUNS, _LARGER, _LUCK = 4, 0.1, 0.02
_ALIGNMENT = ProjectiveOptions(
    levels=(Level(4, 20, 0.15, 0.3), Level(4, 15, 0.03, 0.1), Level(2, 10, 0.005, 0.02)),
    prior_m=3.0,
    prior_rad=3.0,
    common_tilt=0.0,
    common_slope=0.0,
)
_VIEW = SurfaceOptions()

Prepare = Callable[[Frame], Frame]


@dataclass(frozen=True)
class Trial:
    """What a trial found.

    Attributes
    ----------
    larger
        Logarithm of the ratio of the gaps with the correction to those without it, for each run.
    """

    larger: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Of all runs."""
        return float(np.mean(self.larger)) if self.larger else 0.0

    @property
    def error(self) -> float:
        """Standard error of the mean, from how much the runs differ."""
        n = len(self.larger)
        return float(np.std(self.larger, ddof=1) / np.sqrt(n)) if n > 1 else float("inf")

    @property
    def harms(self) -> bool:
        """Whether views clearly fit together worse with the correction."""
        n = len(self.larger)
        if n < _LEAST_RUNS or self.mean <= _LARGER:
            return False
        # Student's, as the spread is known from as few runs.
        return bool(self.mean > stdtrit(n - 1, 1 - _LUCK) * self.error)


def trial(recording: Recording, without: Prepare, corrected: Prepare) -> Trial:
    """Compare views without and with a correction.

    Parameters
    ----------
    without, corrected
        Make of a frame what would be tracked. Called with the same frames, run by run.
    """
    if len(recording) < _VIEWS + _LEAST_RUNS - 1:
        return Trial(())
    bench = _Bench(recording, without, corrected)
    stride, larger, seen = 1, [], set()
    for place in _PLACES:
        last = len(recording) - 1 - (_VIEWS - 1) * stride
        start = max(0, round(place * last))
        stride = bench.stride(start, stride)
        if (start, stride) in seen:
            continue
        seen.add((start, stride))
        gap = bench.larger(start, stride)
        if gap is not None:
            larger.append(gap)
        so_far = Trial(tuple(larger))
        if len(larger) >= _LEAST_RUNS and so_far.mean <= so_far.error:
            break  # no harm to be seen
    return Trial(tuple(larger))


class _Bench:
    """Views of a recording, made ready both ways when they are first asked for."""

    def __init__(self, recording: Recording, without: Prepare, corrected: Prepare) -> None:
        self._recording = recording
        self._ways = without, corrected
        self._views: dict[tuple[int, int], SurfaceMap | None] = {}
        self._steps: dict[tuple[int, int, int], Aligned | None] = {}

    def _view(self, k: int, way: int) -> SurfaceMap | None:
        if (k, way) not in self._views:
            self._views[k, way] = self._prepared(k, way)
        return self._views[k, way]

    def _prepared(self, k: int, way: int) -> SurfaceMap | None:
        if k >= len(self._recording):
            return None
        try:
            frame = self._ways[way](self._recording[k])
        except UnreadableFrameError:
            return None
        return surface_map(frame, _VIEW) if isinstance(frame, RangeFrame) and len(frame) else None

    def _step(self, i: int, j: int, way: int, guess: Float64 | None = None) -> Aligned | None:
        """View j in view i; None where they do not fit."""
        if (i, j, way) not in self._steps:
            target, source = self._view(i, way), self._view(j, way)
            found = None
            if target is not None and source is not None:
                start = np.eye(4) if guess is None else guess
                found = align(source, [Target(target, np.eye(4))], start, _ALIGNMENT)
                fits = found.inlier_share * found.overlap >= _FITS
                if not fits or len(found.unobservable) > 6 - _LEAST_HELD:
                    found = None
            self._steps[i, j, way] = found
        return self._steps[i, j, way]

    def stride(self, start: int, stride: int) -> int:
        """Frames from one view to the next, for the motion that is wanted; from that before."""
        farthest = max(1, min(_FARTHEST, (len(self._recording) - 1) // _VIEWS))
        tried = set()
        while stride not in tried:
            tried.add(stride)
            step = self._step(start, start + stride, 0)
            # What does not fit is farther away than it should be.
            moved = _TOO_FAR if step is None else max(self._moved(start, step), 1 / _TOO_FAR)
            stride = min(max(1, round(stride / moved)), farthest)
        return stride

    def _moved(self, k: int, step: Aligned) -> float:
        view, T = self._view(k, 0), step.T_world_source
        depth = 1.0 if view is None else view.depth
        far = float(np.linalg.norm(T[:3, 3]))
        return max(float(se3.angle(T)) / _ANGLE, far / (_DISTANCE * depth))

    def larger(self, start: int, stride: int) -> float | None:
        """By how much the gaps of a run grow by the correction; None if it does not tell."""
        at = [start + stride * k for k in range(_VIEWS)]
        found = [self._compared(*triple) for triple in zip(at, at[1:], at[2:], strict=False)]
        told = [x for x in found if x is not None]
        return float(np.mean(told)) if told else None

    def _compared(self, i: int, j: int, k: int) -> float | None:
        """Logarithm of the ratio of the gaps of a triple of views."""
        gaps, open_to = [], []
        for way in (0, 1):
            first, second = self._step(i, j, way), self._step(j, k, way)
            if first is None or second is None:
                return None
            around = first.T_world_source @ second.T_world_source
            straight = self._step(i, k, way, around)
            if straight is None or self._moved(i, straight) < _LEAST:
                return None
            gaps.append(se3.log(se3.inverse(straight.T_world_source) @ around) / UNITS)
            open_to += [step.unobservable for step in (first, second, straight)]
        # Only what all of them hold is compared.
        directions = np.concatenate(open_to)
        held = np.linalg.eigh(np.einsum("ki,kj->ij", directions, directions))
        axes = held[1][:, held[0] < _OPEN]
        if axes.shape[1] < _LEAST_HELD:
            return None
        held_gaps = np.linalg.norm(np.einsum("ij,ki->kj", axes, np.array(gaps)), axis=1)
        without, corrected = np.log(np.maximum(held_gaps, _NOTHING))
        return float(np.clip(corrected - without, -_COUNTS, _COUNTS))
