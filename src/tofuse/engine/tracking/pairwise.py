"""Odometry by registration of each view to an earlier one.

`Sequential` is that of the thesis: to the one before (section 3.3). `Pairwise` is for wide
baselines: to several earlier ones, and verified.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from tofuse.engine.alignment import PROBABLE, Link, Registrar, Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.clouds import AnyPair
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp import algorithm_1, extent
from tofuse.engine.parts import part
from tofuse.engine.quantities import percent
from tofuse.engine.search import SearchOptions, pose_probability
from tofuse.engine.tracking.base import Guess, Odometry, Step, Tracker
from tofuse.engine.tracking.motion import FrameTime, MotionModel
from tofuse.engine.views import PreparedView

# The prediction replaces the search once it has agreed with 2 of the last 3 searches.
_MIN_CONFIRMED = 2
# Poses that differ by less than this fraction of the extent are the same.
_MAX_DIFFERENCE = 0.03
# Guesses farther from a pose, as a fraction of the extent, are not expected to be aligned to it:
# about the reach of ICP at its coarsest level.
_MAX_PREDICTED = 0.3
# Contradictions of two pairs of views, as fractions of the overlap, that differ by less are equal:
# a few of the thousands of points that are compared.
_CHANCE = 0.002

# Seeds the random draws of odometry differently from other stages that register the same pair.
SEED_STAGE = 1


@part("odometry", "sequential", label="validated")
@dataclass(frozen=True)
class Sequential(Bounded, Odometry):
    """Registers each frame to the last one that has a pose, and chains the motions.

    Eqs 3.1 and 3.2, ``t = R t_new + t`` and ``R = R R_new``, as matrices:
    ``T_world_current = T_world_previous T_previous_current``. The first frame with enough points
    defines the world frame.

    A frame is lost, without a pose, when it has too few points, when its registration fails, or
    when too few of its points correspond; the next is then registered to the last with a pose.

    Attributes
    ----------
    registration
        Registers one pair.
    guess
        Initial guess of a registration (section 4.1): "identity"; "previous", the motion of the
        preceding registration (identity at first; a lost frame does not change it); "odometry",
        the motion between the poses of an odometry file (identity where either is missing).
    minimum_points
        Valid points that a frame must have.
    min_inlier_ratio
        Smallest inlier fraction, 0 to 1. The thesis has no such threshold for consecutive frames;
        this one is low and only rejects registrations with hardly any correspondences.
    """

    registration: Registrar = field(default_factory=algorithm_1)
    guess: Guess = "identity"
    minimum_points: Annotated[int, Bounds(1)] = 10
    min_inlier_ratio: Annotated[float, Bounds(0, 1)] = 0.02

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: those of the registration."""
        return self.registration.takes

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`."""
        return _SequentialTracker(self, seed)


@dataclass(frozen=True, eq=False)
class _Tracked:
    """The last frame with a pose."""

    frame: Frame
    T_world_camera: Float64
    T_odometry: Float64 | None


class _SequentialTracker(Tracker):
    def __init__(self, options: Sequential, seed: int) -> None:
        self._options = options
        self._seed = seed
        self._last: _Tracked | None = None
        self._motion = np.eye(4)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`. Its odometry is in another frame."""
        self._motion = np.eye(4)
        self._last = None if self._last is None else replace(self._last, T_odometry=None)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`; raises nothing for frames without points."""
        options, last = self._options, self._last
        if len(frame) < options.minimum_points:
            return _lost(f"{len(frame)} valid points, {options.minimum_points} are needed")
        if last is None:
            self._last = _Tracked(frame, np.eye(4), T_odometry)
            return Step("tracked", "", np.eye(4))

        guess = self._guess(last, T_odometry)
        rng = np.random.default_rng([self._seed, SEED_STAGE, frame.index, last.frame.index])
        try:
            registration = options.registration.register(frame, last.frame, guess, rng)
        except RegistrationError as error:
            return _lost(f"not registered to frame {last.frame.index}: {error}", last)
        if registration.inlier_ratio < options.min_inlier_ratio:
            return _lost(
                f"only {percent(registration.inlier_ratio)} of the points correspond to frame "
                f"{last.frame.index}, {percent(options.min_inlier_ratio)} are needed",
                last,
            )
        self._motion = registration.T_target_source
        # Rounding accumulates in long products; each is projected onto the nearest rotation.
        T_world_camera = se3.orthonormalise(last.T_world_camera @ registration.T_target_source)
        self._last = _Tracked(frame, T_world_camera, T_odometry)
        return Step("tracked", "", T_world_camera, last.frame.index, registration)

    def _guess(self, last: _Tracked, T_odometry: Float64 | None) -> Float64:
        if self._options.guess == "odometry":
            motion = _odometry_motion(last.T_odometry, T_odometry)
            return np.eye(4) if motion is None else motion
        return self._motion if self._options.guess == "previous" else np.eye(4)


def _lost(reason: str, last: _Tracked | None = None) -> Step:
    return Step("lost", reason, None, None if last is None else last.frame.index)


def _odometry_motion(before: Float64 | None, now: Float64 | None) -> Float64 | None:
    """Return the motion (4, 4) between two poses of odometry; None if one is unknown."""
    if before is None or now is None:
        return None
    motion = se3.inverse(before) @ now
    return motion if np.isfinite(motion).all() else None


@part("odometry", "pairwise")
@dataclass(frozen=True)
class Pairwise(Bounded, Odometry):
    """Registers each view to the one before; where that is not accepted, to earlier ones.

    Once the predicted motion has agreed with searches, it replaces them as long as the views agree
    there; degenerate directions follow the motion. For unordered views, or wide baselines, each
    pair is searched.

    A view whose best pose is not accepted, but more probable than not, keeps it and is marked as
    doubtful. Else it begins a component of its own; accepted registrations to views of other
    components become links.

    Attributes
    ----------
    registration
        Registers one pair, and states whether the pose is accepted.
    references
        Maximum number of earlier views that a view is registered to, the last one first; more for
        unordered views.
    minimum_points
        Points that a view must have.
    probable
        Minimum probability of a pose that is not accepted, but kept.
    guess
        Predicted motion: "previous", that of the last views; "odometry", that of an odometry file
        (the former where it has none); "identity". The best pose of a search is accepted if
        odometry leads to the same; odometry that led to the poses of searches replaces them.
    """

    registration: AnyPair = field(default_factory=AnyPair)
    references: Annotated[int, Bounds(1)] = 6
    minimum_points: Annotated[int, Bounds(1)] = 10
    probable: Annotated[float, Bounds(0, 1)] = PROBABLE
    guess: Guess = "previous"

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: those of the registration."""
        return self.registration.takes

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`."""
        return _PairwiseTracker(self, seed)


@dataclass(frozen=True, eq=False)
class _PosedView:
    """A view with a pose."""

    frame: Frame
    T_component_view: Float64
    component: int
    T_odometry: Float64 | None = None


class _PairwiseTracker(Tracker):
    def __init__(self, options: Pairwise, seed: int) -> None:
        self._options = options
        self._seed = seed
        self._posed: deque[_PosedView] = deque(maxlen=options.references)
        self._component = -1
        self._connected = True  # whether links join the component to an earlier one
        self._motion = MotionModel()
        self._rejected: list[_Registered] = []  # of the component's first view, to earlier ones
        self._degenerate = False  # whether some direction of the last motion was degenerate
        self._local_registration = replace(options.registration, search=False)
        self._T_odometry: Float64 | None = None  # of the present view
        self._has_odometry = False  # whether its prediction is that of odometry
        # Whether predicted poses of the last views agreed with searches.
        self._motion_confirmed: deque[bool] = deque(maxlen=_MIN_CONFIRMED + 1)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`. Its odometry is in another frame."""
        self._motion.interrupt()
        self._motion_confirmed.clear()
        for k, posed in enumerate(self._posed):
            self._posed[k] = replace(posed, T_odometry=None)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`; raises nothing for frames without points."""
        min_points = self._options.minimum_points
        if len(frame) < min_points:
            self._motion.interrupt()
            return Step("lost", f"{len(frame)} valid points, {min_points} are needed", None)
        references = [p for p in reversed(self._posed) if p.component == self._component]
        self._T_odometry, self._has_odometry = T_odometry, False
        guess = self._prediction(frame, references[0]) if references else np.eye(4)
        confirmed = sum(self._motion_confirmed) >= _MIN_CONFIRMED
        local = None
        if references and (confirmed or self._has_odometry):
            local = self._locally(_unposed(frame), references[0], guess)
        if confirmed and local is not None and local.needs_no_search:
            return self._continue_component(frame, local)
        doubtful: list[_Registered] = []
        for reference in references:
            registered = self._by_search(_unposed(frame), reference)
            if registered is None:
                continue
            if reference is references[0]:
                registered = self._confirmed_by_odometry(registered, local)
            registered = self._unless_contradicted(registered, doubtful)
            if registered.accepted:
                if reference is references[0]:
                    self._motion_confirmed.append(self._is_predicted(registered, guess, local))
                return self._continue_component(frame, registered)
            doubtful.append(registered)
        if confirmed and self._has_odometry and local is not None and local.accepted:
            return self._continue_component(frame, local)
        # The latest views overlap most with this one.
        probable = [r for r in doubtful if r.probability >= self._options.probable]
        if probable:
            placed = _PosedView(frame, probable[0].T_components, self._component)
            links = self._links(placed, self._rejected)
        else:
            links = self._links(_unposed(frame))
        if probable and not links:
            return self._continue_component(frame, probable[0])
        return self._begin_component(frame, links, doubtful)

    def _prediction(self, frame: Frame, last: _PosedView) -> Float64:
        """Return the predicted pose (4, 4) relative to the last view.

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
        if self._options.guess == "identity":
            guess = np.eye(4)
        motion = _odometry_motion(last.T_odometry, self._T_odometry)
        if self._options.guess == "odometry" and motion is not None:
            guess, self._has_odometry = motion, True
        return guess

    def _is_predicted(
        self, searched: _Registered, guess: Float64, local: _Registered | None
    ) -> bool:
        """Whether alignment from a guess, which may be known, leads to the pose of a search."""
        if local is None and searched.difference(guess) <= _MAX_PREDICTED:
            local = self._locally(searched.view, searched.reference, guess)
        return local is not None and local.agrees(searched)

    def _confirmed_by_odometry(
        self, searched: _Registered, local: _Registered | None
    ) -> _Registered:
        """Accept the best pose of a search if odometry, independent of it, leads there too.

        Odometry excludes the rivals of the search: the probability near the guess counts.
        """
        if local is None or not self._has_odometry or not local.agrees(searched):
            return searched
        if local.probability < self._options.probable:
            return searched
        registration = replace(searched.registration, believed=True, reason="", confirmed=True)
        return replace(searched, registration=registration)

    def _by_search(self, view: _PosedView, reference: _PosedView) -> _Registered | None:
        """Register to an earlier view by a global search."""
        return self._registered(view, reference, None, self._options.registration)

    def _locally(
        self, view: _PosedView, reference: _PosedView, guess: Float64
    ) -> _Registered | None:
        """Register to an earlier view from a guess."""
        return self._registered(view, reference, guess, self._local_registration)

    def _registered(
        self, view: _PosedView, reference: _PosedView, guess: Float64 | None, method: AnyPair
    ) -> _Registered | None:
        frame, target = view.frame, reference.frame
        rng = np.random.default_rng([self._seed, SEED_STAGE, frame.index, target.index])
        try:
            return _Registered(view, reference, method.register(frame, target, guess, rng))
        except RegistrationError:
            return None

    def _unless_contradicted(
        self, found: _Registered, others: Sequence[_Registered]
    ) -> _Registered:
        """Reject a pose if one that was found relative to another view may be right as well.

        Rooms that look alike fit each other better than neighbouring views do, which overlap less.
        So a higher probability does not decide, but what the views of both registrations see as
        free does. Where that contradicts both equally, the other pose must be probable.
        """
        if not found.registration.is_probable:
            return found
        for other in others:
            if found.agrees(other):
                continue
            contradiction, of_other = (
                sum(self._contradiction_at(at.T_components, pair) for pair in (found, other))
                for at in (found, other)
            )
            least = -_CHANCE if other.registration.is_probable else _CHANCE
            if contradiction - of_other >= least:
                reason = f"the registration to frame {other.reference.frame.index} contradicts it"
                probability = found.probability / 2  # either may be right
                registration = found.registration
                return replace(
                    found,
                    registration=replace(
                        registration, believed=False, probability=probability, reason=reason
                    ),
                )
        return found

    def _contradiction_at(self, T_components: Float64, pair: _Registered) -> float:
        """Return the contradiction of the views of a registration if components are so posed."""
        view, reference = pair.view, pair.reference
        guess = se3.inverse(reference.T_component_view) @ T_components @ view.T_component_view
        local = self._locally(view, reference, guess)
        return 0.0 if local is None else local.registration.contradiction or 0.0

    def _continue_component(self, frame: Frame, registered: _Registered) -> Step:
        """Take the pose of a registration to a view of the present component."""
        reference, registration = registered.reference, registered.registration
        T = se3.orthonormalise(reference.T_component_view @ registration.T_target_source)
        self._motion.update(T, _moment(frame))
        self._degenerate = len(registration.unobservable) > 0
        posed = _PosedView(frame, T, self._component, self._T_odometry)
        links = () if self._connected else self._links(posed, self._rejected)
        self._connected |= bool(links)
        self._posed.append(posed)
        return Step(
            "tracked",
            "" if registered.accepted else registration.reason,
            T,
            reference.frame.index,
            registration,
            component=self._component,
            links=links,
            doubtful=not registered.accepted,
        )

    def _begin_component(
        self, frame: Frame, links: tuple[Link, ...], rejected: list[_Registered]
    ) -> Step:
        self._component += 1
        self._rejected = rejected
        self._connected = self._component == 0 or bool(links)
        self._motion.interrupt()
        self._motion.update(np.eye(4), _moment(frame))
        self._posed.append(_PosedView(frame, np.eye(4), self._component, self._T_odometry))
        reason = f"not connected: {rejected[0].registration.reason}" if rejected else ""
        return Step("tracked", reason, np.eye(4), component=self._component, links=links)

    def _links(self, view: _PosedView, rejected: Sequence[_Registered] = ()) -> tuple[Link, ...]:
        """Return the registration to the last view of another component, if it is accepted.

        `rejected` are others between both components.
        """
        others = [p for p in self._posed if p.component != self._component]
        registered = self._by_search(view, others[-1]) if others else None
        if registered is None:
            return ()
        component = registered.reference.component
        between = [r for r in rejected if r.reference.component == component]
        registered = self._unless_contradicted(registered, between)
        return (registered.link(),) if registered.accepted else ()


def _moment(frame: Frame) -> FrameTime:
    return FrameTime(frame.index, frame.timestamp)


def _unposed(frame: Frame) -> _PosedView:
    """Return a view as a component of its own."""
    return _PosedView(frame, np.eye(4), -1)


@dataclass(frozen=True, eq=False)
class _Registered:
    """A registration of a view to an earlier one."""

    view: _PosedView
    reference: _PosedView
    registration: Registration

    @property
    def accepted(self) -> bool:
        return bool(self.registration.believed)

    @property
    def needs_no_search(self) -> bool:
        """Whether a pose is accepted and certain or degenerate, so that no search is needed."""
        certain = (
            self.probability >= pose_probability.CERTAIN or len(self.registration.unobservable) > 0
        )
        return self.accepted and certain

    @property
    def T_components(self) -> Float64:
        """Pose (4, 4) of the view's component in that of the reference."""
        T = self.reference.T_component_view @ self.registration.T_target_source
        return T @ se3.inverse(self.view.T_component_view)

    def agrees(self, other: _Registered) -> bool:
        """Whether both map the view's points to the same place."""
        T_other = other.T_components @ self.view.T_component_view
        T_reference_component = se3.inverse(self.reference.T_component_view)
        return self.difference(T_reference_component @ T_other) <= _MAX_DIFFERENCE

    def difference(self, T_target_source: Float64) -> float:
        """Rms distance of the view's points at another pose, as a fraction of their extent."""
        points = self.view.frame.points
        difference = se3.transform(self.registration.T_target_source, points)
        difference -= se3.transform(T_target_source, points)
        rms = np.sqrt((difference**2).sum(1).mean())
        return float(rms / max(extent(points), np.finfo(float).tiny))

    @property
    def probability(self) -> float:
        return self.registration.probability or 0.0

    def link(self) -> Link:
        i, j, r = self.reference.frame.index, self.view.frame.index, self.registration
        return Link(i, j, r, self.accepted, r.how)
