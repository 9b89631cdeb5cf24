"""The scale of poses without metres, such as those of COLMAP, from the depth of a recording.

It is that by which the given translations agree best with registered ones (least squares, robust
against wrong pairs). A few pairs of neighbouring views show whether it may differ from 1
(`first_scale`). If so, all are registered, from the rotation between the given poses and their
translation at a few scales (`estimated_scale`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.compute import run_all
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.search import follow
from tofuse.engine.views import PreparedView

# Translations from which a pair is registered at first, in given units: as metres, and none.
_STARTS = (1.0, 0.0)
_MIN_PAIRS, _FIRST_PAIRS = 3, 8
_ITERATIONS, _TUKEY = 20, 4.685
# Scales of metric poses are right within this fraction: phones and odometry err by a few percent.
_METRIC = 0.1
_SIGNIFICANT = 3.0  # standard deviations


@dataclass(frozen=True)
class PoseScale:
    """Metres per unit of given poses.

    Attributes
    ----------
    factor, sigma
        The estimate and its standard deviation.
    pairs
        Number of pairs of views.
    applied
        Whether the poses were multiplied by it.
    """

    factor: float
    sigma: float
    pairs: int
    applied: bool = False

    @property
    def is_other_unit(self) -> bool:
        """Whether the poses can't be in metres, not even with the usual errors of scale."""
        off = abs(np.log(self.factor))
        return bool(off > max(_SIGNIFICANT * self.sigma / self.factor, _METRIC))


def with_scale(poses: Float64, factor: float) -> Float64:
    """Return poses (N, 4, 4) with their translations multiplied."""
    out = poses.copy()
    out[:, :3, 3] *= factor
    return out


def estimated_scale(views: Sequence[PreparedView], poses: Float64) -> PoseScale | None:
    """Return the scale of poses (N, 4, 4) of N views; None if too few pairs can be registered."""
    later = np.arange(1, len(poses))
    found = [_registered(views, poses, start, later) for start in _STARTS]
    first = _fitted(poses, later, _best(found))
    if first is None:
        return None
    found.append(_registered(views, poses, first.factor, later))
    return _fitted(poses, later, _best(found))


def first_scale(views: Sequence[PreparedView], poses: Float64) -> PoseScale | None:
    """Return the scale by a few pairs near the given poses: whether it may differ from 1."""
    later = evenly_spaced(np.arange(1, len(poses)), _FIRST_PAIRS)
    return _fitted(poses, later, _registered(views, poses, 1.0, later))


def _registered(
    views: Sequence[PreparedView], poses: Float64, scale: float, later: Intp
) -> list[Registration | None]:
    """Register views `later` to the ones before them, from the given motion at a scale."""
    poses = with_scale(poses, scale)
    motions = se3.inverse(poses[later - 1]) @ poses[later]
    return run_all([
        partial(follow, views[k], views[k - 1], T) for k, T in zip(later, motions, strict=True)
    ])  # fmt: skip


def _best(found: Sequence[Sequence[Registration | None]]) -> list[Registration | None]:
    return [max(pair, key=_probability) for pair in zip(*found, strict=True)]


def _probability(registration: Registration | None) -> float:
    return 0.0 if registration is None else registration.probability or 0.0


def _fitted(poses: Float64, later: Intp, found: Sequence[Registration | None]) -> PoseScale | None:
    motions = se3.inverse(poses[later - 1]) @ poses[later]
    given, measured, information = [], [], []
    for motion, registration in zip(motions, found, strict=True):
        covariance = None if registration is None else registration.covariance
        if registration is None or covariance is None or not registration.is_probable:
            continue
        R = registration.T_target_source[:3, :3]
        given.append(motion[:3, 3])
        measured.append(registration.T_target_source[:3, 3])
        information.append(R @ np.linalg.inv(covariance[:3, :3]) @ R.T)
    if len(given) < _MIN_PAIRS:
        return None
    g, t, W = np.array(given), np.array(measured), np.array(information)
    curvature = np.einsum("ni,nij,nj->n", g, W, g)
    slope = np.einsum("ni,nij,nj->n", g, W, t)
    # The weighted median is hardly moved by wrong pairs.
    order = np.argsort(slope / np.maximum(curvature, 1e-300))
    half = np.searchsorted(np.cumsum(np.sqrt(curvature[order])), 0.5 * np.sqrt(curvature).sum())
    s = float(slope[order[half]] / max(curvature[order[half]], 1e-300))
    for _ in range(_ITERATIONS):
        r = t - s * g
        squared = np.einsum("ni,nij,nj->n", r, W, r) / 3
        # Errors beyond the stated ones, of the given poses or of the camera.
        excess = max(float(np.median(squared)), 1.0)
        weight = tukey.weights(squared / excess / _TUKEY**2)
        total = float((weight * curvature).sum())
        if not total > 0:
            return None
        s = float((weight * slope).sum() / total)
    # Errors of the given translations make the slope too small, and those of the measured ones make
    # that of the opposite fit too large: the scale lies between.
    extent = np.einsum("ni,nij,nj->n", t, W, t)
    opposite = float((weight * extent).sum() / max((weight * slope).sum(), 1e-300))
    used = int((weight > 0).sum())
    spread = float((weight * squared).sum() / max(weight.sum(), 1e-9))
    sigma = float(np.sqrt(max(spread, 1.0) / total * used / max(used - 1, 1)))
    sigma = float(np.hypot(sigma, opposite - s))
    return PoseScale(s, sigma, used) if s > 0 and used >= _MIN_PAIRS else None
