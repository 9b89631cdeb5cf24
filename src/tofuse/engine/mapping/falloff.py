"""Falloff of the amplitude towards the corners, or of colour with the range, from a recording.

Lens and illumination together make an image darker off the axis, about as a power of the cosine to
the axis (natural vignetting of a lens is the fourth power; illumination adds to it, and cameras may
compensate either). Uncompensated, it is a texture fixed to the camera, and biases every alignment
towards no motion. Two views aligned by geometry alone observe the same surfaces at different image
positions: the difference of their albedo determines the exponent, for any scene.

Along a wall, geometry alone does not constrain the motion. Then views are aligned by geometry and
amplitude, the exponent is estimated and compensated, and this is repeated until it converges. The
exponents of pairs are pooled, weighted by their information, which grows with the motion.

Colour in ambient light has no falloff. Where a lamp on the camera lights the scene, colour gets
darker with range and incidence. Infrared images of a ToF camera fall off with the squared
range, unless the camera compensates it. The range stands for both: on a plane, which keeps its
distance to the camera as it moves along, the cosine of incidence is inverse to the range; and
unlike the cosine it is nearly free of noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float64
from tofuse.engine.frames import Frame, RangeFrame, Recording
from tofuse.engine.mapping.recorded_views import RecordedViews
from tofuse.engine.mapping.trial import pooled
from tofuse.engine.normal import robust_sigma
from tofuse.engine.search import pair_agreement, verification
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view, residual_kernels

Prepare = Callable[[Frame], Frame]

# Number of pairs, evenly spaced over the recording; frames between the views of a pair, which are
# doubled up to this number of times while there is too little motion.
_PAIRS, _STRIDE, _MAX_DOUBLINGS = 7, 2, 3
# Desired and minimum mean motion of points (`Law.travel`), in units of x/z or of the logarithm of
# the range; and the minimum inlier fraction of an alignment.
_DESIRED_MOTION, _MIN_MOTION, _MIN_INLIERS = 0.05, 0.02, 0.6
# Alignment by geometry alone, with wide priors; and with amplitude.
_GEOMETRIC = projective.ProjectiveOptions(
    levels=verification.PATIENT, photometric=False, prior_m=3.0, prior_rad=3.0
)
_PHOTOMETRIC = replace(_GEOMETRIC, photometric=True)
# Maximum number of photometric alignments, and the change of the exponent at convergence.
_MAX_ROUNDS, _CONVERGED = 5, 0.1
# Maximum distance of corresponding points from the surface: m, plus a fraction of the depth.
_MAX_DISTANCE_M, _MAX_DISTANCE_FRACTION = 0.01, 0.01
# Minimum numbers of points of a pair (few, as pairs are weighted by their information, and some
# cameras have few pixels) and of pairs, and the significance level.
_MIN_POINTS, _MIN_PAIRS, _SIGNIFICANCE = 50, 3, 0.01


@dataclass(frozen=True)
class Law:
    """A quantity; light falls off as a power of it.

    Attributes
    ----------
    logarithm
        Its logarithm at points (N, 3) in the camera's frame.
    compensated
        Returns a view with an albedo that is compensated for an exponent.
    travel
        Mean motion of points (N, 3) from one view to another, in the units in which the law is
        observable.
    limit
        No light falls off by a larger exponent: then the pairs show something else.
    """

    logarithm: Callable[[Float64], Float64]
    compensated: Callable[[PreparedView, float], PreparedView]
    travel: Callable[[Float64, Float64], float]
    limit: float


def _image_motion(p: Float64, q: Float64) -> float:
    return float(np.linalg.norm(p[:, :2] / p[:, 2:] - q[:, :2] / q[:, 2:], axis=1).mean())


def _log_range(p: Float64) -> Float64:
    return -0.5 * np.log((p**2).sum(1))


# The cosine to the optical axis, of amplitude; and the inverse of the range, of colour.
OFF_AXIS = Law(
    lambda p: -0.5 * np.log1p((p[:, :2] ** 2).sum(1) / p[:, 2] ** 2),
    PreparedView.with_falloff,
    _image_motion,
    20.0,
)
RANGE = Law(
    _log_range,
    PreparedView.with_range_falloff,
    lambda p, q: float(np.abs(_log_range(p) - _log_range(q)).mean()),
    8.0,
)


def estimate_falloff(
    recording: Recording, prepare: Prepare, options: SurfaceOptions, law: Law = OFF_AXIS
) -> float:
    """Return the exponent of the remaining falloff in the views; 0 if there is no evidence.

    Parameters
    ----------
    recording
        The recording.
    prepare
        Corrects and filters a frame as for tracking.
    options
        How views are prepared, with the falloffs that are compensated.
    law
        Law of the falloff of amplitude, or else of colour.
    """

    def corrected(image: RangeFrame) -> RangeFrame | None:
        frame = prepare(image)
        return frame if isinstance(frame, RangeFrame) and len(frame) else None

    def prepared(frame: RangeFrame) -> PreparedView | None:
        view = prepare_view(frame, options)
        return view if view.has_albedo else None

    views = RecordedViews(recording, corrected, prepared)
    slopes: list[_Slope] = []
    starts = np.unique(np.linspace(0, len(recording) - 1, _PAIRS + 1)[:-1].astype(int))
    views.load([k for start in starts.tolist() for k in (start, start + _STRIDE)])
    for start in starts:
        # The initial exponent is the median so far: nearly compensated amplitude hardly biases.
        initial = float(np.median([s.exponent for s in slopes])) if slopes else 0.0
        slope = _slope_from(views, int(start), initial, law)
        if slope is not None:
            slopes.append(slope)
    if len(slopes) < _MIN_PAIRS:
        return 0.0
    exponents, information = np.array([(s.exponent, s.information) for s in slopes]).T
    exponent, error = pooled(exponents, information)
    # Student's t, as the spread is estimated from few pairs.
    threshold = float(stdtrit(len(slopes) - 1, 1 - _SIGNIFICANCE)) * error
    return exponent if threshold < abs(exponent) < law.limit else 0.0


@dataclass(frozen=True)
class _Slope:
    """Exponent of a pair, its information (sum of squares of x), and the motion (`Law.travel`)."""

    exponent: float
    information: float
    motion: float


def _slope_from(
    views: RecordedViews[RangeFrame, PreparedView], start: int, initial: float, law: Law
) -> _Slope | None:
    """Return the slope of a view and a later one with enough motion in between, if any."""
    target = views.get(start)
    if target is None:
        return None
    best, T, stride = None, np.eye(4), _STRIDE
    for _ in range(1 + _MAX_DOUBLINGS):
        source = views.get(start + stride)
        aligned = None if source is None else _aligned(source, target, T, initial, law)
        if aligned is None:
            if best is not None or stride < _STRIDE:
                break
            T, stride = np.eye(4), 1  # the stride was too large
            continue
        T, slope = aligned
        if slope is not None:
            best = slope
            if slope.motion >= _DESIRED_MOTION:
                break
        if stride < _STRIDE:
            break
        T, stride = T @ T, 2 * stride
    return best


def _aligned(
    source: PreparedView, target: PreparedView, guess: Float64, initial: float, law: Law
) -> tuple[Float64, _Slope | None] | None:
    """Return T_target_source (4, 4) and the slope of two views; None if they don't fit.

    Parameters
    ----------
    guess
        (4, 4) initial T_target_source.
    initial
        Initial exponent.
    """
    T = _constrained_pose(source, target, guess, _GEOMETRIC)
    slope = None if T is None else _slope(source, target, T, law)
    if T is not None and slope is not None:
        return T, slope
    T, exponent, slope = guess, initial, None
    for _ in range(_MAX_ROUNDS):
        compensated = law.compensated(source, exponent), law.compensated(target, exponent)
        pose = _constrained_pose(*compensated, T, _PHOTOMETRIC)
        if pose is None:
            return None
        T, slope = pose, _slope(source, target, pose, law)
        if slope is None or abs(slope.exponent - exponent) < _CONVERGED:
            return T, slope
        exponent = slope.exponent
    return T, None


def _constrained_pose(
    source: PreparedView,
    target: PreparedView,
    guess: Float64,
    options: projective.ProjectiveOptions,
) -> Float64 | None:
    """Return T_target_source (4, 4), if the views fit and constrain it in all directions."""
    aligned = projective.align(source, [projective.Target(target)], guess, options)
    if not aligned.converged or aligned.inlier_ratio < _MIN_INLIERS or len(aligned.unobservable):
        return None
    return aligned.T_world_source


def _slope(source: PreparedView, target: PreparedView, T: Float64, law: Law) -> _Slope | None:
    """Regress the difference of log albedo on that of the law; None without much motion.

    Parameters
    ----------
    T
        (4, 4) T_target_source.
    """
    packed = projective.points_of(source, 2).astype(np.float64)
    p = packed[:, residual_kernels.POINT : residual_kernels.POINT + 3]
    q = p @ T[:3, :3].T + T[:3, 3]
    u, v, inside = pair_agreement.landing_pixels(target, q)
    p, q, u, v = p[inside], q[inside], u[inside], v[inside]
    z = target.planes[v, u, 3].astype(np.float64)
    matched = (z > 0) & (
        np.abs(q[:, 2] - 1 / np.maximum(z, 1e-9))
        < _MAX_DISTANCE_M + _MAX_DISTANCE_FRACTION * q[:, 2]
    )
    log_ratio = target.albedo[v, u, 0] - packed[inside, residual_kernels.POINT_ALBEDO]
    matched &= np.isfinite(log_ratio)
    if np.count_nonzero(matched) < _MIN_POINTS:
        return None
    motion = law.travel(p[matched], q[matched])
    if motion < _MIN_MOTION:
        return None
    log_change = law.logarithm(q[matched]) - law.logarithm(p[matched])
    y = log_ratio[matched].astype(np.float64)
    inliers = np.ones(len(y), bool)
    slope = squares = 0.0
    for _ in range(4):  # least squares, trimmed at three robust standard deviations
        x = log_change[inliers] - log_change[inliers].mean()
        squares = max(float(x @ x), 1e-12)
        slope = float(x @ (y[inliers] - y[inliers].mean()) / squares)
        residual = y - slope * log_change
        residual -= np.median(residual[inliers])
        inliers = np.abs(residual) < 3 * robust_sigma(residual[inliers]) + 1e-9
    return _Slope(slope, squares, motion)
