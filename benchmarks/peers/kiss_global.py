"""KISS-Matcher (Lim et al. 2025), with its default parameters for the voxel size."""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import Frame


def method(voxel_m: float) -> Callable[[Frame, Frame], Float64] | None:
    """The registration of two views; None where KISS-Matcher is not installed."""
    try:
        kiss = importlib.import_module("kiss_matcher")
    except ImportError:
        return None

    def registered(source: Frame, target: Frame) -> Float64:
        matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(voxel_m))
        found = matcher.estimate(source.points, target.points)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.asarray(found.rotation), np.ravel(found.translation)
        if not np.isfinite(T).all():
            raise RegistrationError("found nothing", where="KISS-Matcher")
        return T

    return registered
