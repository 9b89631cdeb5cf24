"""What overlapping images say of the poses: surfaces seen again, and space seen through.

Map consistency (`consistency`) compares a point with whatever surface lies at the pixel that it
lands on. The far side of a turned object then counts against poses that are right. Here a point
supports the poses where it lies on a surface that faces the same way, and contradicts them where
it is nearer than what the other image saw there: that image looked through it. A point behind a
surface is hidden, and says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.kernels.threads import run_chunks
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.recording import evenly
from tofuse.registration.agreement import AgreementOptions, agreement
from tofuse.registration.prepared_view import PreparedView, SurfaceOptions, prepare_view

# Of each image: some points, compared with images of this width.
_POINTS = 700
_COLUMNS = 200
# Pairs that see less of each other say little.
_LEAST_SHARE = 0.2
_VIEWS = 60
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Sighting:
    """What two views say of the pose between them.

    Attributes
    ----------
    i, j
        Positions of the views; i < j.
    support
        Points of either that lie on a surface of the other which faces the same way.
    against
        Points of either that the other looked through.
    squares
        Sum of the supporting points' squared distances from the surface, m^2.
    """

    i: int
    j: int
    support: float
    against: float
    squares: float


@dataclass(frozen=True)
class Sightings:
    """What all overlapping views say of the poses.

    Attributes
    ----------
    frames
        Indices of the views that were looked at.
    pairs
        Those that overlap, in order of (i, j).
    """

    frames: tuple[int, ...]
    pairs: tuple[Sighting, ...]

    def share(self, pairs: Sequence[Sighting] | None = None) -> float:
        """Share of supporting points among all that say something; NaN if there are none."""
        pairs = self.pairs if pairs is None else pairs
        support, against = sum(p.support for p in pairs), sum(p.against for p in pairs)
        return support / (support + against) if support + against else np.nan

    def share_of_views(self) -> Float64:
        """(V,) share of supporting points of each view; NaN where it overlaps with none."""
        support, against = np.zeros(len(self.frames)), np.zeros(len(self.frames))
        for p in self.pairs:
            support[[p.i, p.j]] += p.support
            against[[p.i, p.j]] += p.against
        said = support + against
        return np.divide(support, said, out=np.full(len(said), np.nan), where=said > 0)

    def rms_m(self, pairs: Sequence[Sighting] | None = None) -> float:
        """Rms distance of the supporting points from the surface, m; NaN if there are none."""
        pairs = self.pairs if pairs is None else pairs
        support = sum(p.support for p in pairs)
        return float(np.sqrt(sum(p.squares for p in pairs) / support)) if support else np.nan

    def excess_m(self) -> float:
        """Rms by which views further apart disagree beyond consecutive ones, m; 0 if unknown."""
        near = self.rms_m([p for p in self.pairs if p.j == p.i + 1])
        far = self.rms_m([p for p in self.pairs if p.j > p.i + 1])
        return float(np.sqrt(max(far**2 - near**2, 0.0))) if np.isfinite(near + far) else 0.0


def sightings(frames: Sequence[RangeFrame], poses: ArrayLike) -> Sightings:
    """Compare all pairs of frames under their poses (N, 4, 4) T_world_camera.

    Looks at no more than 60 of them, evenly spaced. Frames without a pose (NaN) don't count.
    """
    T = np.asarray(poses, float)
    rows = evenly(np.flatnonzero(np.isfinite(T).all((1, 2))), _VIEWS)
    return compared([prepared(frames[k]) for k in rows], T[rows])


def prepared(frame: RangeFrame) -> PreparedView:
    """A frame as `compared` takes it."""
    return prepare_view(frame, SurfaceOptions()).thinned(_COLUMNS)


def whole(frame: RangeFrame, filtered: RangeFrame) -> RangeFrame:
    """A frame as it was before filters, but where they removed all of a neighbourhood.

    Filters that thin an image leave no planes in it; those that cut out an object must stand.
    """
    kept = cv2.dilate(filtered.valid.astype(np.uint8), _NEIGHBOURS) > 0
    return frame.keep(kept & frame.valid)


def compared(
    views: Sequence[PreparedView], poses: Float64, groups: Sequence[int] | None = None
) -> Sightings:
    """Compare pairs of prepared views under their poses (N, 4, 4) T_world_camera.

    Parameters
    ----------
    groups
        Number of the group of each view: pairs within a group are left out. All pairs, unless
        given.
    """
    options = AgreementOptions(points=_POINTS)
    axes = poses[:, :3, 2]
    # Cameras that look in opposite directions see no surface from the same side.
    facing = axes @ axes.T > 0
    if groups is not None:
        facing &= np.not_equal.outer(groups, groups)
    pairs = np.argwhere(np.triu(facing, 1))

    def work(start: int, stop: int) -> list[Sighting]:
        found = []
        for i, j in pairs[start:stop].tolist():
            a = agreement(views[j], views[i], se3.inverse(poses[i]) @ poses[j], options)
            support, against = (a.support + a.clash) * a.points, a.violation * a.points
            if support + against > _LEAST_SHARE * a.points:
                squares = a.rms_m**2 * support if support else 0.0
                found.append(Sighting(i, j, support, against, squares))
        return found

    chunks = run_chunks(work, len(pairs), chunks=64)
    return Sightings(
        tuple(v.index for v in views), tuple(pair for chunk in chunks for pair in chunk)
    )
