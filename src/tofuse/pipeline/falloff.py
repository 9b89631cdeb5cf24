"""How much a camera's amplitude falls off towards the corners, estimated from its own recording.

Lens and illumination together make an image darker off the axis, about as a power of the cosine to
the axis (natural vignetting of a lens is the fourth power; illumination adds to it, and cameras may
compensate either). Left in, it is a texture that is fixed to the camera, and drags every alignment
towards standing still. Two views that are aligned by geometry alone see the same surfaces at
different places of the image: what their albedo differs by shows the exponent, whatever the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import UnreadableFrameError
from tofuse.kernels.alignment import LIGHT, POINT
from tofuse.maps.surface_map import SurfaceMap, SurfaceOptions, surface_map
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording
from tofuse.registration.projective import ProjectiveOptions, Target, align, points_of
from tofuse.registration.verification import PATIENT
from tofuse.registration.view_points import landing_pixels

Float64 = NDArray[np.float64]
Prepare = Callable[[Frame], Frame]

# Pairs of frames, evenly spaced over the recording; how many frames they may be apart.
_PAIRS, _STRIDES = 7, (2, 8)
# Mean motion of points in the image, in units of x/z, by which two views differ enough; and less
# than this fraction of inliers is no alignment.
_MOVED, _FITS = 0.05, 0.6
# Geometry alone, from far enough.
_ALIGNMENT = ProjectiveOptions(levels=PATIENT, photometric=False, prior_m=3.0, prior_rad=3.0)
# Points that count: on the surface within so many metres and fraction of the depth.
_NEAR_M, _NEAR = 0.01, 0.01
# Fewest points of a pair, fewest pairs, and how many standard errors make an effect.
_LEAST_POINTS, _LEAST_PAIRS, _SIGNIFICANT = 300, 4, 3.0


def estimate_falloff(recording: Recording, prepare: Prepare, options: SurfaceOptions) -> float:
    """Exponent of the cosine by which amplitude falls off; 0 where the recording shows none.

    Parameters
    ----------
    prepare
        Makes of a frame what will be tracked.
    options
        How views are prepared.
    """
    plain = replace(options, falloff=0.0)
    found = []
    for start in np.linspace(0, len(recording) - 1, _PAIRS + 1)[:-1].astype(int):
        exponent = _from_pair(recording, int(start), prepare, plain)
        if exponent is not None:
            found.append(exponent)
    if len(found) < _LEAST_PAIRS:
        return 0.0
    middle = float(np.median(found))
    # Standard error of a median, from the median absolute deviation.
    error = 1.86 * float(np.median(np.abs(np.array(found) - middle))) / np.sqrt(len(found))
    return middle if abs(middle) > _SIGNIFICANT * error else 0.0


def _from_pair(
    recording: Recording, start: int, prepare: Prepare, options: SurfaceOptions
) -> float | None:
    """The exponent that two frames show; None where they show none."""
    target = _view(recording, start, prepare, options)
    if target is None or not target.has_photo:
        return None
    for stride in _STRIDES:
        source = _view(recording, start + stride, prepare, options)
        if source is None:
            return None
        aligned = align(source, [Target(target, np.eye(4))], np.eye(4), _ALIGNMENT)
        fits = aligned.converged and aligned.inlier_share >= _FITS
        if not fits or len(aligned.unobservable):
            return None
        exponent = _slope(source, target, aligned.T_world_source)
        if exponent is not None:
            return exponent
    return None


def _view(
    recording: Recording, k: int, prepare: Prepare, options: SurfaceOptions
) -> SurfaceMap | None:
    if k >= len(recording):
        return None
    try:
        frame = prepare(recording[k])
    except UnreadableFrameError:
        return None
    return surface_map(frame, options) if isinstance(frame, RangeFrame) and len(frame) else None


def _slope(source: SurfaceMap, target: SurfaceMap, T: Float64) -> float | None:
    """Slope of the difference in log albedo over that in the log cosine; None where both are small.

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
    lighter = target.photo[v, u, 0] - packed[inside, LIGHT]
    near &= np.isfinite(lighter)
    if np.count_nonzero(near) < _LEAST_POINTS:
        return None
    here, there = p[near, :2] / p[near, 2:], q[near, :2] / q[near, 2:]
    if float(np.linalg.norm(there - here, axis=1).mean()) < _MOVED:
        return None
    cosine = -0.5 * (np.log1p((there**2).sum(1)) - np.log1p((here**2).sum(1)))
    y = lighter[near].astype(np.float64)
    keep = np.ones(len(y), bool)
    slope = 0.0
    for _ in range(4):  # least squares, trimmed at three robust standard deviations
        x = cosine[keep] - cosine[keep].mean()
        slope = float(x @ (y[keep] - y[keep].mean()) / max(float(x @ x), 1e-12))
        off = y - slope * cosine
        off -= np.median(off[keep])
        keep = np.abs(off) < 3 * 1.48 * float(np.median(np.abs(off[keep]))) + 1e-9
    return slope
