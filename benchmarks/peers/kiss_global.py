"""KISS-Matcher (Lim et al. 2025), with its default parameters for the voxel size, and refinement.

small_gicp begins at KISS-Matcher's pose, or at the identity; FRICP (Zhang et al. 2022) at
KISS-Matcher's pose. Both get one point a voxel.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import Frame
from tofuse.engine.icp import averaged

# It refuses small voxels, so clouds are scaled to these.
_VOXEL_M = 0.3
# Maximum distance of corresponding points of GICP, in voxels.
_REACH = 3.0
Method = Callable[[Frame, Frame], Float64]


def method(voxel_m: float) -> Method | None:
    """KISS-Matcher; None where it is not installed."""
    try:
        kiss = importlib.import_module("kiss_matcher")
    except ImportError:
        return None

    def registered(source: Frame, target: Frame) -> Float64:
        matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(_VOXEL_M))
        scale = np.float32(_VOXEL_M / voxel_m)
        found = matcher.estimate(scale * source.points, scale * target.points)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.asarray(found.rotation), np.ravel(found.translation) / scale
        if not np.isfinite(T).all():
            raise RegistrationError("found nothing", where="KISS-Matcher")
        return T

    return registered


def with_gicp(voxel_m: float) -> Method | None:
    """KISS-Matcher, refined by small_gicp; None where one of them is not installed."""
    start = method(voxel_m)
    return None if start is None else _refined(voxel_m, start)


def with_fricp(voxel_m: float) -> Method | None:
    """KISS-Matcher, refined by FRICP; None where one of them is not installed."""
    start = method(voxel_m)
    try:
        peer = importlib.import_module("fricp")
    except ImportError:
        return None
    if start is None:
        return None

    def registered(source: Frame, target: Frame) -> Float64:
        points = [averaged(view, voxel_m).points.astype(float) for view in (source, target)]
        return np.array(peer.register(*points, init=start(source, target)).transform)

    return registered


def gicp(voxel_m: float) -> Method | None:
    """small_gicp from the identity; None where it is not installed."""
    return _refined(voxel_m, lambda _source, _target: np.eye(4))


def _refined(voxel_m: float, start: Method) -> Method | None:
    try:
        peer = importlib.import_module("small_gicp")
    except ImportError:
        return None

    def registered(source: Frame, target: Frame) -> Float64:
        found = peer.align(
            target.points.astype(float),
            source.points.astype(float),
            init_T_target_source=start(source, target),
            registration_type="GICP",
            downsampling_resolution=voxel_m,
            max_correspondence_distance=_REACH * voxel_m,
        )
        return np.array(found.T_target_source)

    return registered
