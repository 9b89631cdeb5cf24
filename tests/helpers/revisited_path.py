"""A path that leaves a place and returns to it, and odometry that drifts along it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from corner_views import corner
from tofuse.engine.alignment.base import Registration
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views.view_store import Spacing, ViewStore
from tofuse.engine.tracking.base import Step, Tracker
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import FineScale, SurfaceOptions

ALL = Spacing(angle=0, distance=0)
OPTIONS = SurfaceOptions(radii=(4,), fine_scale=FineScale(noise=0))


DRIFT = se3.exp(np.array([0.004, -0.003, 0.004, 0.002, -0.003, 0.002]))


def away_and_back(count=13, most=1.1):
    """Yaw out to `most` and back, with a little sway, so that views in between differ."""
    a = np.linspace(0, np.pi, count)
    yaw = most * np.sin(a)
    sway = 0.1 * np.sin(2 * a)
    zero = np.zeros(count)
    return se3.exp(np.stack([sway, zero, sway, zero, yaw, zero], axis=-1))


@dataclass(frozen=True)
class Drifting:
    """Odometry along `away_and_back` with the same error in every step; at its end it stays.

    `drift` is the error as a multiple of `DRIFT`, `sigma` that of its stated standard deviation:
    4 mm and 3 mrad.
    """

    count: int
    drift: float
    sigma: float
    part_kind: ClassVar[str] = "odometry"
    part_name: ClassVar[str] = "drifting"
    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    @property
    def error(self):
        return se3.exp(self.drift * se3.log(DRIFT))

    def start(self, seed, search=None):
        return _Drifting(self)


class _Drifting(Tracker):
    def __init__(self, options):
        self.options = options
        self.before = None

    def push(self, frame, T_odometry=None, surface=None):
        options = self.options
        at = min(frame.index, options.count - 1)
        truth = away_and_back(options.count)
        view = prepare_view(frame, OPTIONS)
        if self.before is None:
            self.before = 0, np.eye(4)
            return Step("tracked", "", np.eye(4), surface=view)
        k, T = self.before
        motion = se3.inverse(truth[k]) @ truth[at] @ options.error
        self.before = at, T @ motion
        sigma = options.sigma * np.array([0.004] * 3 + [0.003] * 3)
        registration = Registration(motion, True, 1, 100, 100, 0.0, 0.001, np.diag(sigma**-2.0))
        return Step("tracked", "", self.before[1], frame.index - 1, registration, view)


@pytest.fixture(scope="module")
def turn():
    truth = away_and_back()
    rng = np.random.default_rng(1)
    frames = []
    for k, T in enumerate(truth):
        frame = replace(corner(T), index=k)
        noise = 0.003 * rng.standard_normal(frame.depth.shape).astype(np.float32)
        frames.append(replace(frame, depth=frame.depth + noise))
    start = [truth[0]]
    for k in range(1, len(truth)):
        start.append(start[-1] @ se3.inverse(truth[k - 1]) @ truth[k] @ DRIFT)
    return frames, truth, np.stack(start)


def pushed(options, frames, poses, given=(), covariances=None):
    store = ViewStore(ALL)
    loops = options.start(0, given, store, spacing=ALL)
    for frame, T in zip(frames, poses, strict=True):
        store.push(prepare_view(frame, OPTIONS), T)
        loops.push(frame, T)
    known = {f.index: T for f, T in zip(frames, poses, strict=True)}
    return loops.finish(known, covariances or dict.fromkeys(known, np.zeros((6, 6))))
