"""Odometry of views far apart: each is registered to an earlier one, if the pose is accepted."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.bounds import Bounded, Bounds
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.odometry.base import Odometry, Step, Tracker
from tofuse.odometry.motion import Moment, MotionModel
from tofuse.odometry.sequential import SEED_STAGE
from tofuse.parts import part
from tofuse.recordings.frames import Frame
from tofuse.registration.any_pair import AnyPair
from tofuse.registration.base import PROBABLE, Link, Registration
from tofuse.registration.pose_probability import CERTAIN
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.reduce import extent
from tofuse.registration.search import SearchOptions

# The prediction replaces the search once it has agreed with 2 of the last 3 searches.
_MIN_CONFIRMED = 2
# Poses that differ by less than this fraction of the extent are the same.
_SAME_POSE = 0.03


@part("odometry", "pairwise")
@dataclass(frozen=True)
class Pairwise(Bounded, Odometry):
    """Registers each view to the one before; where that is not accepted, to earlier ones.

    Once the predicted motion has agreed with searches, it replaces them as long as the views agree
    there; degenerate directions follow the motion. For unordered views, or views far apart, each
    pair is searched.

    A view whose best pose is not accepted, but more probable than not, keeps it and is marked as
    doubtful. Else it begins a component of its own; accepted registrations to views of other
    components become links.

    Attributes
    ----------
    registration
        Registers one pair, and states whether the pose is accepted.
    references
        Maximum number of earlier views that a view is registered to, the last one first.
    minimum_points
        Points that a view must have.
    probable
        Minimum probability of a pose that is not accepted, but kept.
    """

    registration: AnyPair = field(default_factory=AnyPair)
    references: Annotated[int, Bounds(1)] = 6
    minimum_points: Annotated[int, Bounds(1)] = 10
    probable: Annotated[float, Bounds(0, 1)] = PROBABLE

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: those of the registration."""
        return self.registration.takes

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`."""
        return _PairwiseTracker(self, seed)


@dataclass(frozen=True, eq=False)
class _Placed:
    """A view with a pose."""

    frame: Frame
    T_component_view: Float64
    component: int


class _PairwiseTracker(Tracker):
    def __init__(self, options: Pairwise, seed: int) -> None:
        self._options = options
        self._seed = seed
        self._placed: deque[_Placed] = deque(maxlen=options.references)
        self._component = -1
        self._connected = True  # whether links join the component to an earlier one
        self._motion = MotionModel()
        self._degenerate = False  # whether some direction of the last motion was degenerate
        self._local_registration = replace(options.registration, search=False)
        # Whether predicted poses of the last views agreed with searches.
        self._motion_confirmed: deque[bool] = deque(maxlen=_MIN_CONFIRMED + 1)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion.interrupt()
        self._motion_confirmed.clear()

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`; raises nothing for frames without points."""
        minimum = self._options.minimum_points
        if len(frame) < minimum:
            self._motion.interrupt()
            return Step("lost", f"{len(frame)} valid points, {minimum} are needed", None)
        own = [p for p in reversed(self._placed) if p.component == self._component]
        local = self._by_prediction(frame, own[0]) if own else None
        confirmed = sum(self._motion_confirmed) >= _MIN_CONFIRMED
        if confirmed and local is not None and local.needs_no_search:
            return self._continue_component(frame, local)
        doubtful: list[_Registered] = []
        for earlier in own:
            registered = self._by_search(frame, earlier)
            if registered is not None and registered.accepted:
                if earlier is own[0]:
                    self._motion_confirmed.append(
                        local is not None and local.agrees(registered, frame.points)
                    )
                return self._continue_component(frame, registered)
            if registered is not None:
                doubtful.append(registered)
        links = self._links(frame)
        # The latest views overlap most with this one.
        probable = [r for r in doubtful if r.probability >= self._options.probable]
        if probable and not links:
            return self._continue_component(frame, probable[0])
        return self._begin_component(frame, links, doubtful[0] if doubtful else None)

    def _by_prediction(self, frame: Frame, last: _Placed) -> _Registered | None:
        """Register to the last view from the predicted pose.

        Along a direction that is degenerate for many views, the noise of single motions would
        accumulate.
        """
        now = _moment(frame)
        T = (
            self._motion.smoothed_pose(now)
            if self._degenerate
            else self._motion.predicted_pose(now)
        )
        guess = np.eye(4) if T is None else se3.inverse(last.T_component_view) @ T
        return self._registered(frame, last, guess, self._local_registration)

    def _by_search(self, frame: Frame, to: _Placed) -> _Registered | None:
        """Register to an earlier view, wherever it is."""
        return self._registered(frame, to, None, self._options.registration)

    def _registered(
        self, frame: Frame, to: _Placed, guess: Float64 | None, method: AnyPair
    ) -> _Registered | None:
        rng = np.random.default_rng([self._seed, SEED_STAGE, frame.index, to.frame.index])
        try:
            return _Registered(to, method.register(frame, to.frame, guess, rng))
        except RegistrationError:
            return None

    def _continue_component(self, frame: Frame, registered: _Registered) -> Step:
        """Take the pose of a registration to a view of the present component."""
        to, registration = registered.to, registered.registration
        T = se3.orthonormalise(to.T_component_view @ registration.T_target_source)
        self._motion.update(T, _moment(frame))
        self._degenerate = len(registration.unobservable) > 0
        links = () if self._connected else self._links(frame)
        self._connected |= bool(links)
        self._placed.append(_Placed(frame, T, self._component))
        return Step(
            "tracked",
            "" if registered.accepted else registration.reason,
            T,
            to.frame.index,
            registration,
            component=self._component,
            links=links,
            doubtful=not registered.accepted,
        )

    def _begin_component(
        self, frame: Frame, links: tuple[Link, ...], refused: _Registered | None
    ) -> Step:
        self._component += 1
        self._connected = self._component == 0 or bool(links)
        self._motion.interrupt()
        self._motion.update(np.eye(4), _moment(frame))
        self._placed.append(_Placed(frame, np.eye(4), self._component))
        reason = "" if refused is None else f"not connected: {refused.registration.reason}"
        return Step("tracked", reason, np.eye(4), component=self._component, links=links)

    def _links(self, frame: Frame) -> tuple[Link, ...]:
        """Return the registration to the last view of another component, if it is accepted."""
        others = [p for p in self._placed if p.component != self._component]
        registered = self._by_search(frame, others[-1]) if others else None
        return (registered.link(frame),) if registered is not None and registered.accepted else ()


def _moment(frame: Frame) -> Moment:
    return Moment(frame.index, frame.timestamp)


@dataclass(frozen=True, eq=False)
class _Registered:
    """A registration to an earlier view."""

    to: _Placed
    registration: Registration

    @property
    def accepted(self) -> bool:
        return bool(self.registration.believed)

    @property
    def needs_no_search(self) -> bool:
        """Whether a pose is accepted and either certain or degenerate, so that no search helps."""
        certain = self.probability >= CERTAIN or len(self.registration.unobservable) > 0
        return self.accepted and certain

    def agrees(self, other: _Registered, points: Float32) -> bool:
        """Whether both map points (n, 3) to the same place, relative to their extent."""
        ours, theirs = (r.registration.T_target_source for r in (self, other))
        gap = se3.transform(ours, points) - se3.transform(theirs, points)
        rms = np.sqrt((gap**2).sum(1).mean())
        return bool(rms <= _SAME_POSE * extent(points))

    @property
    def probability(self) -> float:
        return self.registration.probability or 0.0

    def link(self, frame: Frame) -> Link:
        r = self.registration
        return Link(self.to.frame.index, frame.index, r, self.accepted, r.how)
