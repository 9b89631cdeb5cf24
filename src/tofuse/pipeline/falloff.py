"""How much a camera's amplitude falls off towards the corners, estimated from its own recording.

Lens and illumination together make an image darker off the axis, about as a power of the cosine to
the axis (natural vignetting of a lens is the fourth power; illumination adds to it, and cameras may
compensate either). Left in, it is a texture that is fixed to the camera, and drags every alignment
towards standing still. Two views that are aligned by geometry alone see the same surfaces at
different places of the image: what their albedo differs by shows the exponent, whatever the scene.

Along a wall geometry alone does not tell the motion. Then the light has to help with it: the views
are aligned by both, the exponent that this shows is taken off, and so on until nothing changes.
What pairs say is pooled, those with much motion counting most.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from tofuse.arrays import Float64
from tofuse.errors import UnreadableFrameError
from tofuse.kernels.alignment import POINT, POINT_ALBEDO
from tofuse.pipeline.pooling import pooled
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.registration.prepared_view import PreparedView, SurfaceOptions, prepare_view
from tofuse.registration.projective import ProjectiveOptions, Target, align, points_of
from tofuse.registration.verification import PATIENT
from tofuse.registration.view_points import landing_pixels

Prepare = Callable[[Frame], Frame]

# Pairs of frames, evenly spaced over the recording; frames from one to the other, which are doubled
# while that is too little motion, up to so many times.
_PAIRS, _STRIDE, _DOUBLED = 7, 2, 3
# Mean motion of points in the image, in units of x/z, that is wanted, and the least that tells; and
# less than this fraction of inliers is no alignment.
_WANTED, _MOVED, _FITS = 0.05, 0.02, 0.6
# Geometry alone, from far enough; and with light.
_BY_SHAPE = ProjectiveOptions(levels=PATIENT, photometric=False, prior_m=3.0, prior_rad=3.0)
_BY_LIGHT = replace(_BY_SHAPE, photometric=True)
# Alignments with light, at most, and by how much the exponent still changes when they are enough.
_ROUNDS, _SETTLED = 5, 0.1
# Points that count: on the surface within so many metres and fraction of the depth.
_NEAR_M, _NEAR = 0.01, 0.01
# Fewest points of a pair, fewest pairs, and the chance that what they say is luck.
_LEAST_POINTS, _LEAST_PAIRS, _LUCK = 300, 3, 0.01


def estimate_falloff(recording: Recording, prepare: Prepare, options: SurfaceOptions) -> float:
    """Exponent of the cosine by which amplitude falls off; 0 where the recording shows none.

    Parameters
    ----------
    prepare
        Makes of a frame what will be tracked.
    options
        How views are prepared.
    """
    views = _Views(recording, prepare, replace(options, falloff=0.0))
    found: list[_Slope] = []
    for start in np.unique(np.linspace(0, len(recording) - 1, _PAIRS + 1)[:-1].astype(int)):
        # What is known by then: light that is hardly wrong hardly drags.
        known = float(np.median([one.exponent for one in found])) if found else 0.0
        shown = _from(views, int(start), known)
        if shown is not None:
            found.append(shown)
    if len(found) < _LEAST_PAIRS:
        return 0.0
    exponents, information = np.array([(one.exponent, one.information) for one in found]).T
    exponent, error = pooled(exponents, information)
    # Student's, as the spread is known from as few pairs.
    least = float(stdtrit(len(found) - 1, 1 - _LUCK)) * error
    return exponent if abs(exponent) > least else 0.0


@dataclass(frozen=True)
class _Slope:
    """What a pair shows: the exponent, what it is known by (squares of x), and its motion."""

    exponent: float
    information: float
    moved: float


class _Views:
    """Views of a recording without anything taken off their light."""

    def __init__(self, recording: Recording, prepare: Prepare, options: SurfaceOptions) -> None:
        self._recording, self._prepare, self._options = recording, prepare, options

    def get(self, k: int) -> PreparedView | None:
        """The k-th view; None if there is none, or none with light."""
        if k >= len(self._recording):
            return None
        try:
            frame = self._prepare(self._recording[k])
        except UnreadableFrameError:
            return None
        if not isinstance(frame, RangeFrame) or not len(frame):
            return None
        view = prepare_view(frame, self._options)
        return view if view.has_albedo else None


def _from(views: _Views, start: int, known: float) -> _Slope | None:
    """What a view and a later one show, far enough from it; None where they show nothing."""
    target = views.get(start)
    if target is None:
        return None
    best, T, stride = None, np.eye(4), _STRIDE
    for _ in range(1 + _DOUBLED):
        source = views.get(start + stride)
        aligned = None if source is None else _aligned(source, target, T, known)
        if aligned is None:
            if best is not None or stride < _STRIDE:
                break
            T, stride = np.eye(4), 1  # that was too far
            continue
        T, shown = aligned
        if shown is not None:
            best = shown
            if shown.moved >= _WANTED:
                break
        if stride < _STRIDE:
            break
        T, stride = T @ T, 2 * stride
    return best


def _aligned(
    source: PreparedView, target: PreparedView, guess: Float64, known: float
) -> tuple[Float64, _Slope | None] | None:
    """T_target_source (4, 4), and what the light of two views shows; None where they don't fit.

    Parameters
    ----------
    guess
        (4, 4) T_target_source to start from.
    known
        Exponent as known so far.
    """
    T = _fitted(source, target, guess, _BY_SHAPE)
    shown = None if T is None else _slope(source, target, T)
    if T is not None and shown is not None:
        return T, shown
    T, exponent, shown = guess, known, None
    for _ in range(_ROUNDS):
        lit = _without(source, exponent), _without(target, exponent)
        found = _fitted(*lit, T, _BY_LIGHT)
        if found is None:
            return None
        T, shown = found, _slope(source, target, found)
        if shown is None or abs(shown.exponent - exponent) < _SETTLED:
            return T, shown
        exponent = shown.exponent
    return T, None


def _fitted(
    source: PreparedView, target: PreparedView, guess: Float64, options: ProjectiveOptions
) -> Float64 | None:
    """T_target_source (4, 4), if the views fit, and hold it in every direction."""
    found = align(source, [Target(target, np.eye(4))], guess, options)
    if not found.converged or found.inlier_share < _FITS or len(found.unobservable):
        return None
    return found.T_world_source


def _without(view: PreparedView, exponent: float) -> PreparedView:
    """A view with the falloff taken off its albedo."""
    x, y = np.moveaxis(view.rays, -1, 0)
    length2 = 1 + x * x + y * y
    more = np.stack([0.5 * np.log(length2), x / length2, y / length2], -1)
    albedo = np.asarray(view.albedo + exponent * more, np.float32)
    return replace(view, albedo=albedo)


def _slope(source: PreparedView, target: PreparedView, T: Float64) -> _Slope | None:
    """Slope of the difference in log albedo over that in the log cosine; None without much motion.

    Parameters
    ----------
    T
        (4, 4) T_target_source.
    """
    packed = points_of(source, 2).astype(np.float64)
    p = packed[:, POINT : POINT + 3]
    q = p @ T[:3, :3].T + T[:3, 3]
    u, v = landing_pixels(target, q).T
    rows, columns = target.z.shape
    inside = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    p, q, u, v = p[inside], q[inside], u[inside], v[inside]
    z = target.planes[v, u, 3].astype(np.float64)
    near = (z > 0) & (np.abs(q[:, 2] - 1 / np.maximum(z, 1e-9)) < _NEAR_M + _NEAR * q[:, 2])
    lighter = target.albedo[v, u, 0] - packed[inside, POINT_ALBEDO]
    near &= np.isfinite(lighter)
    if np.count_nonzero(near) < _LEAST_POINTS:
        return None
    here, there = p[near, :2] / p[near, 2:], q[near, :2] / q[near, 2:]
    moved = float(np.linalg.norm(there - here, axis=1).mean())
    if moved < _MOVED:
        return None
    cosine = -0.5 * (np.log1p((there**2).sum(1)) - np.log1p((here**2).sum(1)))
    y = lighter[near].astype(np.float64)
    keep = np.ones(len(y), bool)
    slope = squares = 0.0
    for _ in range(4):  # least squares, trimmed at three robust standard deviations
        x = cosine[keep] - cosine[keep].mean()
        squares = max(float(x @ x), 1e-12)
        slope = float(x @ (y[keep] - y[keep].mean()) / squares)
        off = y - slope * cosine
        off -= np.median(off[keep])
        keep = np.abs(off) < 3 * 1.48 * float(np.median(np.abs(off[keep]))) + 1e-9
    return _Slope(slope, squares, moved)
