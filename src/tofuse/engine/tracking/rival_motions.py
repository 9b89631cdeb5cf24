"""Rivals of the tracked motion: another one that a large part of the view follows.

A crowd that walks past a camera at rest looks like a crowd at rest that a camera moves past, and a
person near the camera may fill most of the image. So the motion of each view is compared with
rivals: that the camera stands still, and that it goes on as before. Parts of the view that both
explain say nothing. Elsewhere each cell yields a likelihood ratio: of depth, or of the pattern of
the albedo on surfaces that both motions map onto themselves. As what is near may move slowly, and
what is far then shows it only in the long run, a third rival is that the camera has stood still
since an earlier view, as long as nothing refutes it.

The shares of the cells that follow either motion are those of the mixture of both with the largest
likelihood, over a window of frames. They are counted by solid angle and by area of surface: what is
near must not win by its size in the image. The share of the view is smaller where only some cells
say anything, because the others are occluded, noisy or out of view.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, UInt8
from tofuse.engine.geometry import homogeneous, se3
from tofuse.engine.search import pair_agreement
from tofuse.engine.tracking import moving_object_kernels as kernels
from tofuse.engine.tracking.keyframe_map import Keyframe
from tofuse.engine.tracking.moving_objects import compared, stride_of
from tofuse.engine.views import PreparedView

# Every n-th frame is compared, and the last comparisons count together.
_EVERY, _WINDOW = 2, 8
# Number of frames by which a rival is noticed late, and forgotten late.
DELAY = _EVERY * _WINDOW
# Motions are the same if they move the view by less than this, in cells.
_MIN_SHIFT = 1.0
# Largest log-likelihood ratio of a cell: that of an error of three sigmas.
_MAX_LLR = 4.5
_BINS = 19
_CENTRES = _MAX_LLR * ((2 * np.arange(_BINS) + 1) / _BINS - 1)
# Width of the squares, in cells, beyond which albedo may differ for other reasons than motion, such
# as the light of the camera.
_PATTERN = 9
# Width of the squares whose mean likelihood ratio counts: parts of a view are larger than that, and
# errors of single cells average out.
_REGION = 5
# Names of the rivals that the camera has not moved since the keyframe, and since `stood_since`.
STANDS, STOOD = "stands", "stood"
_LOWER_QUARTILE = 0.3186  # of the absolute values of a normal distribution
_MIN_RESIDUALS = 50
# Number of cells that share an error, and the log-likelihood ratio to one motion alone above which
# the mixture counts.
_CORRELATED_CELLS, _MIN_EVIDENCE = 100, 3.0
# Shares of a rival, and the log-likelihood ratio (S, B) of the mixture of both motions to the
# tracked one alone, for each share and bin.
_SHARES = np.linspace(0, 1, 201)
_MIXTURES = np.log1p(_SHARES[:, None] * np.expm1(_CENTRES))
# Part of a view, without albedo, that must contradict the tracked motion: a rival matters from a
# quarter on.
_MIN_PART = 0.125


class Rivalry(NamedTuple):
    """What follows other motions than the tracked one.

    Attributes
    ----------
    share
        Largest share of the view that follows a rival.
    winner
        Name of the rival that most of the surface follows, or "".
    rest
        Share that does not follow the winner: that of the tracked motion if the winner is adopted.
    """

    share: float
    winner: str = ""
    rest: float = 0.0


class Rival(NamedTuple):
    """Another pose (4, 4) of a view in its component, and the keyframe to compare the view with."""

    keyframe: Keyframe
    T_component_camera: Float64


class RivalMotions:
    """Compares the tracked motion with its rivals, from frame to frame.

    Attributes
    ----------
    stood_since
        The keyframe since which nothing refutes that the camera stands; None after a `reset`.
    """

    def __init__(self) -> None:
        self.stood_since: Keyframe | None = None
        self._windows: dict[str, deque[_Evidence]] = {}
        self._share, self._views = 0.0, 0

    def reset(self, stood_since: Keyframe | None = None) -> None:
        """Forget the last frames, but not since when the camera stands, if it does."""
        self._windows.clear()
        self._share, self.stood_since = 0.0, stood_since

    def compare(
        self,
        view: PreparedView,
        T_component_camera: Float64,
        rivals: Mapping[str, Rival],
        scale: float,
    ) -> Rivalry:
        """Compare a view if it is one of every second, and judge the last ones.

        A rival that is not given is not judged.

        Parameters
        ----------
        view, T_component_camera
            The view, and its (4, 4) pose as tracked.
        rivals
            By name: `STANDS`, and others.
        scale
            Factor of the sigmas of depth.
        """
        self._views += 1
        if self._views % _EVERY != 1:
            return Rivalry(self._share)
        self._share, winner, rest = 0.0, "", 0.0
        tracked_from: dict[int, _Tracked] = {}
        for name, (keyframe, T_rival) in rivals.items():
            T_keyframe_component = se3.inverse(keyframe.T_component_camera)
            T, T_rival = T_keyframe_component @ T_component_camera, T_keyframe_component @ T_rival
            tracked = tracked_from.get(keyframe.view.index)
            if tracked is None:  # else the comparison at the tracked motion is known
                tracked = _Tracked(view, keyframe.view, T, scale)
                tracked_from[keyframe.view.index] = tracked
            window = self._windows.setdefault(name, deque(maxlen=_WINDOW))
            window.append(tracked.evidence(T_rival, shortcut=name != STOOD))
            if name == STOOD and (tracked.refutes(window[-1]) or not tracked.overlaps):
                self.stood_since = None
            if not window[-1].visible:  # now it is the tracked motion
                continue
            histograms = np.sum([e.histograms for e in window], axis=0)
            of_cells, of_area = map(_share, histograms)
            decisive = histograms[0].sum() / sum(e.visible for e in window)
            self._share = max(self._share, decisive * max(of_cells, of_area))
            if not winner and of_area > 0.5:
                winner, rest = name, decisive * (1 - min(of_cells, of_area))
        if self.stood_since is None:
            self.stood_since = rivals[STANDS].keyframe
        return Rivalry(self._share, winner, rest)


class _Evidence(NamedTuple):
    """Likelihood ratios of the cells of two views, between the tracked motion and a rival.

    Attributes
    ----------
    histograms
        (2, B) of those that say anything: by number of cells, and by area, with the same total.
    visible
        Number of cells with a depth; 0 if the motions are the same.
    """

    histograms: Float64
    visible: int


@dataclass(frozen=True, eq=False)
class _Tracked:
    """A view at the tracked motion (4, 4), to which rivals are compared; `scale` is of sigmas."""

    view: PreparedView
    reference: PreparedView
    T_reference_view: Float64
    scale: float

    @property
    def overlaps(self) -> bool:
        """Whether the views overlap in more than half of the smaller one."""
        return bool(2 * np.count_nonzero(self._forward) > min(self._visible))

    @cached_property
    def _visible(self) -> tuple[int, int]:
        """Numbers of cells with a depth, of the view and of the reference."""
        view, reference = (
            int(np.count_nonzero(v.z[:: stride_of(v), :: stride_of(v)]))
            for v in (self.view, self.reference)
        )
        return view, reference

    def refutes(self, evidence: _Evidence) -> bool:
        """Whether nothing follows a rival, although it could be seen."""
        histograms = evidence.histograms
        return bool(not self._settled and histograms.any()) and not any(map(_share, histograms))

    @cached_property
    def _forward(self) -> UInt8:
        return _outcome(self.view, self.reference, self.T_reference_view, self.scale)

    @cached_property
    def _backward(self) -> UInt8:
        return _outcome(self.reference, self.view, se3.inverse(self.T_reference_view), self.scale)

    def evidence(self, T_rival: Float64, *, shortcut: bool) -> _Evidence:
        """Compare both views at a rival's motion T_rival (4, 4).

        With a shortcut, all that agrees is against a rival that can't matter.
        """
        total = np.zeros((2, _BINS))
        T, visible = self.T_reference_view, sum(self._visible)
        if _shift(self.view, se3.inverse(T) @ T_rival) < _MIN_SHIFT:
            return _Evidence(total, 0)
        if self._settled and shortcut:
            total[:, 0] = self._settled
            return _Evidence(total, visible)
        for a, b, motions, outcome in (
            (self.view, self.reference, (T, T_rival), self._forward),
            (self.reference, self.view, (se3.inverse(T), se3.inverse(T_rival)), self._backward),
        ):
            ratios = likelihood_ratios(a, b, *motions, self.scale, outcome)
            used, stride = np.isfinite(ratios), stride_of(a)
            bins = ((ratios[used] / _MAX_LLR + 1) * (0.5 * _BINS)).astype(np.intp)
            bins = np.minimum(bins, _BINS - 1)
            area = a.z[::stride, ::stride][used].astype(np.float64) ** 2
            for row, weights in zip(total, (None, area), strict=True):
                row += np.bincount(bins, weights, _BINS)
        total[1] *= total[0].sum() / max(total[1].sum(), 1e-9)
        return _Evidence(total, visible)

    @cached_property
    def _settled(self) -> int:
        """How many cells agree with the tracked motion, if no rival can matter; else 0.

        Depth alone can't be in favour of a rival where it agrees with the tracked motion.
        """
        view = self.view
        if view.has_albedo and self.reference.has_albedo:
            return 0
        outcome, stride = self._forward, stride_of(view)
        agrees, contradicts = outcome == kernels.AGREES, _contradicts(outcome)
        area = view.z[::stride, ::stride].astype(np.float64) ** 2
        parts = [
            weight[contradicts].sum() / max(weight[agrees | contradicts].sum(), 1e-9)
            for weight in (np.ones_like(area), area)
        ]
        return int(np.count_nonzero(agrees)) if max(parts) < _MIN_PART else 0


def _shift(view: PreparedView, T: Float64) -> float:
    """Return by how many cells a motion (4, 4) moves the view."""
    width = float(view.rays[0, -1, 0] - view.rays[0, 0, 0])
    cell = abs(width) * stride_of(view) / view.z.shape[1]
    return float(se3.change_of_view(T, view.depth) / cell)


def likelihood_ratios(
    view: PreparedView,
    other: PreparedView,
    T: Float64,
    T_rival: Float64,
    scale: float,
    outcome: UInt8 | None = None,
) -> Float32:
    """Return log-likelihood ratios of the cells of a view, positive for a rival, else NaN.

    Parameters
    ----------
    view, other
        The view, and the one it is compared with.
    T, T_rival
        (4, 4) T_other_view of both motions.
    scale
        Factor of the sigmas of depth.
    outcome
        Of the comparison (rows, columns) at `T`, if it is known.
    """
    if outcome is None:
        outcome = _outcome(view, other, T, scale)
    by_rival = _outcome(view, other, T_rival, scale)
    agrees, rival_agrees = outcome == kernels.AGREES, by_rival == kernels.AGREES
    contradicts, rival_contradicts = _contradicts(outcome), _contradicts(by_rival)
    llr = _MAX_LLR * (1.0 * (rival_agrees & contradicts) - (agrees & rival_contradicts))
    if view.has_albedo and other.has_albedo:
        both = agrees & rival_agrees
        residuals = [_pattern_residual(view, other, motion, both) for motion in (T, T_rival)]
        both &= np.isfinite(residuals[0]) & np.isfinite(residuals[1])
        if np.count_nonzero(both) >= _MIN_RESIDUALS:
            sigma = min(float(np.quantile(np.abs(r[both]), 0.25)) for r in residuals)
            sigma = max(sigma / _LOWER_QUARTILE, 1e-6)
            cost, rival_cost = (np.minimum(0.5 * (r / sigma) ** 2, _MAX_LLR) for r in residuals)
            llr[both] = (cost - rival_cost)[both]
    used = (agrees | contradicts) & (rival_agrees | rival_contradicts)
    mean = _local_mean(np.where(used, llr, np.nan), _REGION)
    return np.where(used, mean, np.float32(np.nan))


def _outcome(view: PreparedView, other: PreparedView, T: Float64, scale: float) -> UInt8:
    stride = stride_of(other)
    still = np.zeros(other.z[::stride, ::stride].shape, np.bool_)
    return compared(view, other, still, np.ascontiguousarray(T), scale)[0]


def _contradicts(outcome: UInt8) -> Bool:
    return (outcome == kernels.IN_FRONT) | (outcome == kernels.BEHIND)


def _pattern_residual(view: PreparedView, other: PreparedView, T: Float64, cells: Bool) -> Float32:
    """Return differences of log albedo of cells (rows, columns), less their local mean, else NaN.

    The other view's albedo is extrapolated from the nearest pixel by its slopes.
    """
    stride = stride_of(view)
    grid = np.s_[::stride, ::stride]
    z, rays, albedo = view.z[grid][cells], view.rays[grid][cells], view.albedo[grid][cells]
    points = se3.transform(T, homogeneous(rays) * z[:, None])
    u, v, inside = pair_agreement.landing_pixels(other, points)
    seen = other.albedo[v, u]
    offset = points[:, :2] / points[:, 2:] - other.rays[v, u]
    difference = albedo[:, 0] - seen[:, 0] - (seen[:, 1:] * offset).sum(1)
    residual = np.full(cells.shape, np.nan, np.float32)
    residual[cells] = np.where(inside, difference, np.nan)
    return residual - _local_mean(residual, _PATTERN)


def _local_mean(image: Float32, width: int) -> Float32:
    """Return the mean of the known values, not NaN, in a square of some width in cells."""
    known = np.isfinite(image)
    sums, counts = (
        cv2.boxFilter(
            values.astype(np.float32), -1, (width, width), normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
        for values in (np.where(known, image, 0), known)
    )  # fmt: skip
    return np.asarray(sums / np.maximum(counts, 1), np.float32)


def _share(weights: Float64) -> float:
    """Return the share of the rival by a histogram (B,); 0 without enough evidence."""
    evidence = _MIXTURES @ weights
    best = int(evidence.argmax())
    return float(_SHARES[best]) if evidence[best] / _CORRELATED_CELLS > _MIN_EVIDENCE else 0.0
