"""Loops between cameras that are close together and have similar headings (section 3.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.loops.loops import (
    ClosedLoop,
    Confirmation,
    LoopDetector,
    Loops,
    PriorLoop,
    close_prior_loop,
    in_order,
)
from tofuse.engine.parts import part
from tofuse.engine.search import SearchOptions
from tofuse.engine.stored_views import ViewStore
from tofuse.engine.views import PreparedView


@part("loops", "nearby", label="validated")
@dataclass(frozen=True)
class Nearby(Bounded, LoopDetector):
    """Selects earlier frames as candidates if the camera was close and had about the same yaw.

    Attributes
    ----------
    max_distance_m
        Largest distance between the two cameras, m: the range of the sensor.
    max_yaw_rad
        Largest rotation about the camera's y axis between them.
    min_gap
        Smallest number of frames (with a pose) between the two.
    per_frame
        Largest number of candidates for each frame, the nearest in distance and yaw; 0 for none, so
        that only prior loops are used (as in chapter 4 of the thesis).
    confirmation
        Accepts or rejects candidates.
    """

    max_distance_m: Annotated[float, Bounds(0, exclusive=True)] = 0.5
    max_yaw_rad: Annotated[float, Bounds(0, exclusive=True)] = 0.35
    min_gap: Annotated[int, Bounds(1)] = 16
    per_frame: Annotated[int, Bounds(0)] = 2
    confirmation: Confirmation = field(default_factory=Confirmation)

    def start(
        self,
        seed: int,
        prior: Sequence[PriorLoop],
        views: ViewStore[PreparedView],
        search: SearchOptions | None = None,
    ) -> Loops:
        """See `LoopDetector.start`. Given loops replace detected ones."""
        return _NearbyLoops(self, seed, prior)

    def candidates(self, poses: Float64) -> Intp:
        """Return the positions of earlier cameras that may form a loop with the newest, best first.

        `poses` is (N, 4, 4) T_world_camera in the order of the frames; the newest comes last.
        """
        earlier = poses[: max(0, len(poses) - self.min_gap)]
        if len(earlier) == 0:
            return np.zeros(0, np.intp)
        distance = (
            np.linalg.norm(earlier[:, :3, 3] - poses[-1, :3, 3], axis=1) / self.max_distance_m
        )
        angle = np.abs(yaw(se3.inverse(earlier) @ poses[-1])) / self.max_yaw_rad
        close = np.flatnonzero((distance <= 1) & (angle <= 1))
        order = np.argsort(distance[close] ** 2 + angle[close] ** 2, kind="stable")
        return close[order[: self.per_frame]]


class _NearbyLoops(Loops):
    def __init__(self, options: Nearby, seed: int, prior: Sequence[PriorLoop]) -> None:
        self._options = options
        self._prior_loops = prior
        self._seed = seed
        self._views: dict[int, Frame] = {}
        self._poses: dict[int, Float64] = {}
        self._closed: dict[tuple[int, int], ClosedLoop] = {}

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Loops.push`."""
        self._views[view.index] = view
        self._poses[view.index] = T_component_camera
        frames = list(self._poses)
        for k in self._options.candidates(np.stack(list(self._poses.values()))):
            self._closed[frames[k], view.index] = self._confirm(frames[k], view.index)

    def detection_job(self) -> Callable[[], list[ClosedLoop]] | None:
        """See `Loops.detection_job`. They were detected when the frame was added."""
        newest = next(reversed(self._poses))
        loops = [loop for (_, j), loop in self._closed.items() if j == newest]
        return (lambda: loops) if loops else None

    def finish(
        self, poses: Mapping[int, Float64], covariances: Mapping[int, Float64]
    ) -> list[ClosedLoop]:
        """See `Loops.finish`."""
        for loop in self._prior_loops:
            self._closed[loop.i, loop.j] = close_prior_loop(loop, self._poses, self._confirm)
        return in_order(self._closed)

    def _confirm(self, i: int, j: int) -> ClosedLoop:
        guess = se3.inverse(self._poses[i]) @ self._poses[j]
        confirmation = self._options.confirmation
        return confirmation.confirm(self._views[j], self._views[i], guess, seed=self._seed)


def yaw(T: Float64) -> Float64:
    """Heading of the z axis about the y axis, -pi to pi rad, of motions (..., 4, 4)."""
    return np.arctan2(T[..., 0, 2], T[..., 2, 2])
