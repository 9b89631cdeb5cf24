"""Odometry of views far apart: each is registered to an earlier one, as far as that is believed."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceMap
from tofuse.odometry.base import Odometry, Step, Tracker
from tofuse.odometry.sequential import SEED_STAGE
from tofuse.parts import part
from tofuse.recordings.frames import Frame
from tofuse.registration.agreement import Agreement
from tofuse.registration.any_pair import AnyPair
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.verification import Link

Float64 = NDArray[np.float64]


@part("odometry", "pairwise")
@dataclass(frozen=True)
class Pairwise(Odometry):
    """Registers each view to the one before; where that is not believed, to earlier ones.

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

    registration: Registrar = field(default_factory=AnyPair)
    references: int = 6
    minimum_points: int = 10
    probable: float = 0.5

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
        self._motion: Float64 | None = None

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion = None

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: SurfaceMap | None = None
    ) -> Step:
        """See `Tracker.push`; raises nothing for frames without points."""
        least = self._options.minimum_points
        if len(frame) < least:
            self._motion = None
            return Step("lost", f"{len(frame)} valid points, {least} are needed", None)
        own = [p for p in reversed(self._placed) if p.component == self._component]
        doubtful: list[_Registered] = []
        for each in own:
            found = self._register(frame, each)
            if found is not None and found.believed:
                return self._follow(frame, found)
            if found is not None:
                doubtful.append(found)
        links = self._links(frame)
        likely = max(doubtful, key=lambda r: r.probability, default=None)
        if likely is not None and not links and likely.probability >= self._options.probable:
            return self._follow(frame, likely)
        return self._begin(frame, links, likely)

    def _register(self, frame: Frame, to: _Placed) -> _Registered | None:
        """Register to an earlier view; the motion so far predicts that from the last one alone."""
        last = to is self._placed[-1]
        guess = self._motion if last and self._motion is not None else np.eye(4)
        rng = np.random.default_rng([self._seed, SEED_STAGE, frame.index, to.frame.index])
        try:
            return _Registered(to, self._options.registration.register(frame, to.frame, guess, rng))
        except RegistrationError:
            return None

    def _follow(self, frame: Frame, found: _Registered) -> Step:
        """Take the pose that a registration gives in the present component."""
        to, made = found.to, found.registration
        T = se3.orthonormalise(to.T_component_view @ made.T_target_source)
        self._motion = se3.inverse(self._placed[-1].T_component_view) @ T
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

    def _begin(self, frame: Frame, links: tuple[Link, ...], likely: _Registered | None) -> Step:
        """Begin a component."""
        self._component += 1
        self._connected = self._component == 0 or bool(links)
        self._motion = None
        self._placed.append(_Placed(frame, np.eye(4), self._component))
        reason = "" if likely is None else f"not connected: {likely.registration.reason}"
        return Step("tracked", reason, np.eye(4), component=self._component, links=links)

    def _links(self, frame: Frame) -> tuple[Link, ...]:
        """The registration to the last view of another component, if it is believed."""
        others = [p for p in self._placed if p.component != self._component]
        found = self._register(frame, others[-1]) if others else None
        return (found.link(frame),) if found is not None and found.believed else ()


@dataclass(frozen=True, eq=False)
class _Registered:
    """A registration to an earlier view."""

    to: _Placed
    registration: Registration

    @property
    def believed(self) -> bool:
        return bool(self.registration.believed)

    @property
    def probability(self) -> float:
        return self.registration.probability or 0.0

    def link(self, frame: Frame) -> Link:
        made = self.registration
        overlap, support = made.overlap or 0.0, made.support or 0.0
        violation = overlap * (made.contradiction or 0.0)
        said = Agreement(
            overlap, support, violation, 0.0, made.rms_m, made.points, support - violation
        )
        return Link(
            self.to.frame.index,
            frame.index,
            made.T_target_source,
            made.information,
            said,
            made.margin,
            True,
            "registered as clouds",
        )
