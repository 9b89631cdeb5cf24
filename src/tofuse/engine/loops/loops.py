"""Loop closure: the interface of loop detectors, and the confirmation of a candidate."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np

from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds, NotEmpty
from tofuse.engine.errors import InputError, RegistrationError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3
from tofuse.engine.graph import LoopRecord
from tofuse.engine.icp import algorithm_1
from tofuse.engine.parts import check_number
from tofuse.engine.quantities import percent
from tofuse.engine.search import SearchOptions
from tofuse.engine.stored_views import ViewStore
from tofuse.engine.views import PreparedView

# Separates the random streams of loops from those of other stages that register the same pair.
SEED_STAGE = 2

# Assumed standard deviation of a prior measurement: 1 cm and 0.01 rad (about half a degree).
PRIOR_INFORMATION = np.diag([1e4] * 6)


@dataclass(frozen=True, eq=False)
class PriorLoop:
    """A loop given by the user or closed earlier: frames i, j (indices, i < j) show one place.

    `T_i_j` is the (4, 4) relative pose, or None if it is to be registered. `by_user` is False if an
    earlier result closed it.
    """

    i: int
    j: int
    T_i_j: Float64 | None = None
    by_user: bool = True

    @classmethod
    def of(cls, loop: PriorLoop | Sequence[Any]) -> PriorLoop:
        """Return a loop that the user gives, also as (i, j) or (i, j, T_i_j), in any order.

        Raises
        ------
        InputError
            If it does not join two frames, or the motion is not rigid.
        """
        given = (loop.i, loop.j, loop.T_i_j) if isinstance(loop, PriorLoop) else loop
        if not isinstance(given, Sequence) or isinstance(given, str) or len(given) not in (2, 3):
            remedy = "pass pairs (i, j) of frame indices, or (i, j, T_i_j)"
            raise InputError(f"contains {loop!r}", where="loops", remedy=remedy)
        i, j, *motion = given
        for index in (i, j):
            check_number(index, Bounds(0), f"loops: {i!r} {j!r}", whole=True)
        if i == j:
            raise InputError("joins a frame with itself", where=f"loops: {i} {j}")
        T = motion[0] if motion else None
        if T is not None:
            T = se3.check_pose(T, where=f"loops: {i} {j}")
        by_user = loop.by_user if isinstance(loop, PriorLoop) else True
        if i < j:
            return cls(int(i), int(j), T, by_user)
        return cls(int(j), int(i), None if T is None else se3.inverse(T), by_user)

    def about(self, centre: Float64) -> PriorLoop:
        """Return the loop with its motion in coordinates with another origin; see `se3.about`."""
        return self if self.T_i_j is None else replace(self, T_i_j=se3.about(centre, self.T_i_j))


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The decision on a candidate, and its measurement if it was accepted.

    `T_i_j` is the relative pose of the frames of the record, `information` (6, 6) that of its
    right perturbation, in the frame of j; both None if the loop is rejected.
    """

    record: LoopRecord
    T_i_j: Float64 | None = None
    information: Float64 | None = None

    @classmethod
    def of(cls, record: LoopRecord, registration: Registration) -> ClosedLoop:
        """Return the decision `record` on a registration, with its measurement if accepted."""
        if not record.accepted:
            return cls(record)
        return cls(record, registration.T_target_source, registration.information)


def close_prior_loop(
    loop: PriorLoop, posed: Collection[int], confirm: Callable[[int, int], ClosedLoop]
) -> ClosedLoop:
    """Accept or reject a prior loop.

    Parameters
    ----------
    loop
        The prior loop.
    posed
        Indices of the frames that have a pose.
    confirm
        Registers frames i and j, if their relative pose was not known.
    """
    for frame in (loop.i, loop.j):
        if frame not in posed:
            return ClosedLoop(LoopRecord(loop.i, loop.j, False, f"frame {frame} has no pose"))
    if loop.T_i_j is None:
        return confirm(loop.i, loop.j)
    record = LoopRecord(loop.i, loop.j, True, "given with its motion")
    return ClosedLoop(record, loop.T_i_j, PRIOR_INFORMATION)


def in_order(closed: Mapping[tuple[int, int], ClosedLoop]) -> list[ClosedLoop]:
    """Return loops, given by their frames (i, j), in the order of j, then i."""
    return [closed[pair] for pair in sorted(closed, key=lambda ij: ij[::-1])]


class Loops(Protocol):
    """State of a loop detector on one recording.

    Attributes
    ----------
    needs_points
        Whether it requires the points of frames, not only prepared views.
    """

    needs_points: ClassVar[bool] = True

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """Add the next frame that has a pose."""
        ...

    @property
    def is_long(self) -> bool:
        """Whether the trajectory is so long that a second detection is worthwhile."""
        return False

    def candidates_change(self, poses: Mapping[int, Float64]) -> bool:
        """Whether `poses` differ so much from those of the last `finish` that candidates change.

        Then `finish` may be called again, with these.
        """
        return False

    def detection_job(self) -> Callable[[], list[ClosedLoop]] | None:
        """Return a function that detects the loops that the newest frame closes; None without any.

        It may run on another thread while frames are added. `finish` returns its loops too.
        """
        ...

    def finish(
        self, poses: Mapping[int, Float64], covariances: Mapping[int, Float64]
    ) -> list[ClosedLoop]:
        """Return every candidate and prior loop with its decision, in the order of j, then i.

        Parameters
        ----------
        poses
            (4, 4) T_world_camera by index of the frames to be considered: components may have been
            joined since they were added.
        covariances
            (6, 6) of these before any loop is closed, relative to the first, as right
            perturbations; NaN where unknown.
        """
        ...


class LoopDetector(Protocol):
    """A method that detects when the camera revisits a place."""

    part_kind: ClassVar[str] = "loops"

    def start(
        self,
        seed: int,
        prior: Sequence[PriorLoop],
        views: ViewStore[PreparedView],
        search: SearchOptions | None = None,
    ) -> Loops:
        """Begin a new recording.

        Parameters
        ----------
        seed
            Of the run's random numbers.
        prior
            Loops given by the user or closed earlier.
        views
            Prepared views of frames with a pose; each is stored before its frame is pushed.
        search
            Range and effort of exhaustive searches for a pose; the default ones unless given.
        """
        ...


@dataclass(frozen=True)
class Confirmation(Bounded):
    """Register two views, and accept them if the error is low and enough points correspond (3.4).

    E of Algorithm 1 is normalised by the number of all points, and so decreases when points lose
    their correspondences; here the mean distance of corresponding points must be low instead.

    Attributes
    ----------
    registrations
        Applied sequentially, coarse to fine, each initialised by the one before, as a trajectory
        has drifted when a loop closes. The last one is judged.
    min_fraction
        Minimum fraction of the source's points with a correspondence, 0 to 1.
    max_error
        Maximum mean distance of corresponding points in units of the resolution, that is, E over
        the corresponding points alone.
    """

    registrations: Annotated[tuple[Registrar, ...], NotEmpty()] = field(
        default_factory=lambda: (algorithm_1(0.2), algorithm_1(0.05))
    )
    min_fraction: Annotated[float, Bounds(0, 1)] = 0.3
    max_error: Annotated[float, Bounds(0, exclusive=True)] = 0.65

    def rejection_reason(self, registration: Registration) -> str:
        """Return why a registration is rejected; empty if it is accepted.

        A method that verifies its pose itself (`believed`) decides.
        """
        if registration.believed is not None:
            return registration.reason
        if registration.correspondences == 0 or registration.inlier_ratio < self.min_fraction:
            return (
                f"only {percent(registration.inlier_ratio)} of the points correspond, "
                f"{percent(self.min_fraction)} are needed"
            )
        error = mean_error(registration)
        if not error <= self.max_error:
            return f"the error is {error:.2f} of the resolution, above {self.max_error:.2f}"
        return ""

    def confirm(self, source: Frame, target: Frame, guess: Float64, *, seed: int) -> ClosedLoop:
        """Decide whether two views form a loop.

        Starts from the guess and, as the trajectory may be far off, from the identity, unless the
        method searches for rival poses itself. The better result counts: accepted before rejected,
        then more corresponding points.

        Parameters
        ----------
        source, target
            The views of the later and of the earlier frame.
        guess
            (4, 4) T_target_source of the trajectory.
        seed
            Of the run: the same pair and seed give the same result.
        """
        i, j = target.index, source.index
        registrations: list[Registration] = []
        failure = ""
        for start in (guess, np.eye(4)):
            try:
                registrations.append(self._register(source, target, start, seed))
            except RegistrationError as error:
                failure = failure or str(error)
            if registrations and registrations[-1].believed is not None:
                break  # it searched for rival poses itself
        if not registrations:
            return ClosedLoop(LoopRecord(i, j, False, f"not registered: {failure}"))
        best = max(
            registrations, key=lambda r: (not self.rejection_reason(r), r.inlier_ratio, -r.error)
        )
        rejection_reason = self.rejection_reason(best)
        reason = rejection_reason or (
            f"{percent(best.inlier_ratio)} of the points correspond, with an error of "
            f"{mean_error(best):.2f} of the resolution"
        )
        record = LoopRecord(
            i, j, not rejection_reason, reason, overlap=best.inlier_ratio, rms_m=best.rms_m
        )
        return ClosedLoop.of(record, best)

    def _register(self, source: Frame, target: Frame, guess: Float64, seed: int) -> Registration:
        rng = np.random.default_rng([seed, SEED_STAGE, source.index, target.index])
        registration = self.registrations[0].register(source, target, guess, rng)
        for registrar in self.registrations[1:]:
            guess = registration.T_target_source
            registration = registrar.register(source, target, guess, rng)
        return registration


def mean_error(registration: Registration) -> float:
    """Return E over the corresponding points: their mean distance in units of the resolution."""
    return registration.error / registration.inlier_ratio if registration.inlier_ratio else np.inf
