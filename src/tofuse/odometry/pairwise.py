"""Odometry of views far apart: each is registered to an earlier one, as far as that is believed."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.odometry.base import Odometry, Step, Tracker
from tofuse.odometry.motion import Moment, Motion
from tofuse.odometry.sequential import SEED_STAGE
from tofuse.parts import part
from tofuse.recordings.frames import Frame
from tofuse.registration.any_pair import AnyPair
from tofuse.registration.base import PROBABLE, Link, Registration
from tofuse.registration.confidence import CERTAIN
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.reduce import extent

# The motion is followed without a search once it has predicted the results of so many of the last
# searches, of which one more is looked at.
_PROVEN = 2
# Poses that differ by this share of the extent are the same.
_SAME = 0.03


@part("odometry", "pairwise")
@dataclass(frozen=True)
class Pairwise(Odometry):
    """Registers each view to the one before; where that is not believed, to earlier ones.

    Once the motion has led to where searches ended, it is followed without a search, as far as the
    views agree there; along degenerate directions it goes on. In views in no order, or far apart,
    it does not, and each pair is searched.

    A view whose best pose is not believed, but more probable than not, keeps it and is marked as
    doubtful. Else it begins a component of its own; registrations to views of other components that
    are believed become links.

    Attributes
    ----------
    registration
        Registers one pair, and says whether the pose is to be believed.
    references
        Earlier views that a view is registered to at most, the last one first.
    minimum_points
        Points that a view must have.
    probable
        Least probability of a pose that is not believed, but kept.
    """

    registration: AnyPair = field(default_factory=AnyPair)
    references: int = 6
    minimum_points: int = 10
    probable: float = PROBABLE

    def __post_init__(self) -> None:
        for name in ("references", "minimum_points"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not 1 or more")
        if not 0 <= self.probable <= 1:
            raise ValueError(f"probable is {self.probable}, not 0 to 1")

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: those of the registration."""
        return self.registration.takes

    def start(self, seed: int) -> Tracker:
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
        self._motion = Motion()
        self._degenerate = False  # whether the last motion was, in some direction
        self._following = replace(options.registration, search=False)
        # Whether what the motion led to was what a search found, in the last few views.
        self._steady: deque[bool] = deque(maxlen=_PROVEN + 1)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion.interrupt()
        self._steady.clear()

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`; raises nothing for frames without points."""
        least = self._options.minimum_points
        if len(frame) < least:
            self._motion.interrupt()
            return Step("lost", f"{len(frame)} valid points, {least} are needed", None)
        own = [p for p in reversed(self._placed) if p.component == self._component]
        near = self._followed(frame, own[0]) if own else None
        steady = sum(self._steady) >= _PROVEN
        if steady and near is not None and near.needs_no_search:
            return self._follow(frame, near)
        doubtful: list[_Registered] = []
        for each in own:
            found = self._searched(frame, each)
            if found is not None and found.believed:
                if each is own[0]:
                    self._steady.append(near is not None and near.agrees(found, frame.points))
                return self._follow(frame, found)
            if found is not None:
                doubtful.append(found)
        links = self._links(frame)
        # The latest views share most with this one.
        probable = [r for r in doubtful if r.probability >= self._options.probable]
        if probable and not links:
            return self._follow(frame, probable[0])
        return self._begin(frame, links, doubtful[0] if doubtful else None)

    def _followed(self, frame: Frame, last: _Placed) -> _Registered | None:
        """Register to the last view from where the motion so far leads to.

        In a direction that is degenerate for many views, the noise of one motion would add up.
        """
        now = _moment(frame)
        T = self._motion.steadily(now) if self._degenerate else self._motion.expected(now)
        guess = np.eye(4) if T is None else se3.inverse(last.T_component_view) @ T
        return self._registered(frame, last, guess, self._following)

    def _searched(self, frame: Frame, to: _Placed) -> _Registered | None:
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

    def _follow(self, frame: Frame, found: _Registered) -> Step:
        """Take the pose that a registration gives in the present component."""
        to, made = found.to, found.registration
        T = se3.orthonormalise(to.T_component_view @ made.T_target_source)
        self._motion.follow(T, _moment(frame))
        self._degenerate = len(made.unobservable) > 0
        links = () if self._connected else self._links(frame)
        self._connected |= bool(links)
        self._placed.append(_Placed(frame, T, self._component))
        return Step(
            "tracked",
            "" if found.believed else made.reason,
            T,
            to.frame.index,
            made,
            component=self._component,
            links=links,
            doubtful=not found.believed,
        )

    def _begin(self, frame: Frame, links: tuple[Link, ...], refused: _Registered | None) -> Step:
        """Begin a component."""
        self._component += 1
        self._connected = self._component == 0 or bool(links)
        self._motion.interrupt()
        self._motion.follow(np.eye(4), _moment(frame))
        self._placed.append(_Placed(frame, np.eye(4), self._component))
        reason = "" if refused is None else f"not connected: {refused.registration.reason}"
        return Step("tracked", reason, np.eye(4), component=self._component, links=links)

    def _links(self, frame: Frame) -> tuple[Link, ...]:
        """The registration to the last view of another component, if it is believed."""
        others = [p for p in self._placed if p.component != self._component]
        found = self._searched(frame, others[-1]) if others else None
        return (found.link(frame),) if found is not None and found.believed else ()


def _moment(frame: Frame) -> Moment:
    return Moment(frame.index, frame.timestamp)


@dataclass(frozen=True, eq=False)
class _Registered:
    """A registration to an earlier view."""

    to: _Placed
    registration: Registration

    @property
    def believed(self) -> bool:
        return bool(self.registration.believed)

    @property
    def needs_no_search(self) -> bool:
        """Whether a pose that was followed is certain, or the best that a search could say."""
        sure = self.probability >= CERTAIN or len(self.registration.unobservable) > 0
        return self.believed and sure

    def agrees(self, other: _Registered, points: Float32) -> bool:
        """Whether both take points (n, 3) to the same place, as far as their extent tells."""
        ours, theirs = (r.registration.T_target_source for r in (self, other))
        gap = se3.transform(ours, points) - se3.transform(theirs, points)
        rms = np.sqrt((gap**2).sum(1).mean())
        return bool(rms <= _SAME * extent(points))

    @property
    def probability(self) -> float:
        return self.registration.probability or 0.0

    def link(self, frame: Frame) -> Link:
        made = self.registration
        return Link(self.to.frame.index, frame.index, made, self.believed, made.how)
