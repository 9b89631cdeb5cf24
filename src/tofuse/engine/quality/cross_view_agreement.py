"""Cross-view consistency: whether overlapping images support or contradict the poses.

Map consistency (`consistency`) compares a point with whatever surface lies at the pixel that it
projects to. The far side of a rotated object then counts against correct poses. Here a point
supports the poses where it lies on a surface that faces in the same direction, and contradicts
them where the other image measured free space at it. A point behind a surface is occluded and
doesn't count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.compute import run_all
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.search import pair_agreement
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

# Points per image, and the width of the images that they are compared with.
_POINTS = 700
_COLUMNS = 200
# Pairs with less overlap are left out.
_MIN_OVERLAP = 0.2
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class PairConsistency:
    """The evidence of two views for or against the pose between them.

    Attributes
    ----------
    i, j
        Positions of the views; i < j.
    support
        Number of points of either on a surface of the other that faces in the same direction.
    contradiction
        Number of points of either in the free space of the other.
    squares
        Sum of the supporting points' squared distances from the surface, m^2.
    """

    i: int
    j: int
    support: float
    contradiction: float
    squares: float

    @classmethod
    def of(cls, i: int, j: int, a: pair_agreement.Agreement) -> PairConsistency:
        """Count the points; a surface of another albedo is one, too."""
        support = (a.support + a.clash) * a.points
        squares = a.rms_m**2 * support if support else 0.0
        return cls(i, j, support, a.violation * a.points, squares)


@dataclass(frozen=True)
class CrossViewConsistency:
    """The evidence of all overlapping views for or against the poses.

    Attributes
    ----------
    frames
        Frame indices of the views.
    pairs
        Pairs of views that overlap, in order of (i, j).
    """

    frames: tuple[int, ...]
    pairs: tuple[PairConsistency, ...]

    def support(self, pairs: Sequence[PairConsistency] | None = None) -> float:
        """Fraction of supporting points among supporting and contradicting ones; NaN if none."""
        pairs = self.pairs if pairs is None else pairs
        support, contradiction = sum(p.support for p in pairs), sum(p.contradiction for p in pairs)
        return support / (support + contradiction) if support + contradiction else np.nan

    def support_of_views(self) -> Float64:
        """(V,) the same fraction for each view; NaN where it overlaps with no other."""
        support, contradiction = np.zeros(len(self.frames)), np.zeros(len(self.frames))
        for p in self.pairs:
            support[[p.i, p.j]] += p.support
            contradiction[[p.i, p.j]] += p.contradiction
        total = support + contradiction
        return np.divide(support, total, out=np.full(len(total), np.nan), where=total > 0)

    def rms_m(self, pairs: Sequence[PairConsistency] | None = None) -> float:
        """Rms distance of the supporting points from the surface, m; NaN if none."""
        pairs = self.pairs if pairs is None else pairs
        support = sum(p.support for p in pairs)
        return float(np.sqrt(sum(p.squares for p in pairs) / support)) if support else np.nan

    def excess_m(self) -> float:
        """Rms disagreement of distant views in excess of that of consecutive ones, m."""
        consecutive = self.rms_m([p for p in self.pairs if p.j == p.i + 1])
        distant = self.rms_m([p for p in self.pairs if p.j > p.i + 1])
        return (
            float(np.sqrt(max(distant**2 - consecutive**2, 0.0)))
            if np.isfinite(consecutive + distant)
            else 0.0
        )


def prepare_for_comparison(frame: RangeFrame) -> PreparedView:
    """Prepare a frame for `compare_views`."""
    return prepare_view(frame, SurfaceOptions()).subsampled(_COLUMNS)


def restore_thinned(frame: RangeFrame, filtered: RangeFrame) -> RangeFrame:
    """Restore removed pixels of a frame, except where their entire neighbourhood was removed.

    Filters that thin out an image leave no planes in it, so their effect is undone; regions that
    were cut out, for example a background, stay removed.
    """
    kept = cv2.dilate(filtered.valid.astype(np.uint8), _NEIGHBOURS) > 0
    return frame.keep(kept & frame.valid)


def compare_views(
    views: Sequence[PreparedView], poses: Float64, groups: Sequence[int] | None = None
) -> CrossViewConsistency:
    """Compare pairs of prepared views under their poses (N, 4, 4) T_world_camera.

    Parameters
    ----------
    views
        Views prepared by `prepare_view`.
    poses
        (V, 4, 4).
    groups
        Group of each view: pairs within a group are left out. By default all pairs are compared.
    """
    found = overlapping_pairs(views, poses, groups)
    pairs = tuple(PairConsistency.of(p.i, p.j, p.agreement) for p in found)
    return CrossViewConsistency(tuple(v.index for v in views), pairs)


class ComparedPair(NamedTuple):
    """Two views, i < j, their agreement, and which points (n,) lie on surfaces of the other."""

    i: int
    j: int
    agreement: pair_agreement.Agreement
    of_i: Bool
    of_j: Bool


def overlapping_pairs(
    views: Sequence[PreparedView], poses: Float64, groups: Sequence[int] | None = None
) -> list[ComparedPair]:
    """Compare all pairs of views that overlap; the parameters are those of `compare_views`."""
    options = pair_agreement.AgreementOptions(points=_POINTS)
    axes = poses[:, :3, 2]
    # Cameras with opposite viewing directions observe no surface from the same side.
    facing = axes @ axes.T > 0
    if groups is not None:
        facing &= np.not_equal.outer(groups, groups)

    prepared = run_all([partial(pair_agreement.ComparedView.of, v, options) for v in views])

    def compared(i: int, j: int) -> ComparedPair | None:
        T_i_j = se3.inverse(poses[i]) @ poses[j]
        pair = pair_agreement.Comparison(prepared[j], prepared[i], options)
        a, of_j, of_i = pair.with_points(T_i_j)
        if not a.support + a.clash + a.violation > _MIN_OVERLAP:
            return None
        return ComparedPair(i, j, a, of_i, of_j)

    found = run_all([partial(compared, i, j) for i, j in np.argwhere(np.triu(facing, 1)).tolist()])
    return [pair for pair in found if pair is not None]
