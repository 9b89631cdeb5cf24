"""Loops: views that see again what an earlier view saw (section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.parts import part
from tofuse.posegraph.graph import LoopRecord
from tofuse.recordings.frames import Frame
from tofuse.registration.base import Registrar, Registration

Float64 = NDArray[np.float64]
Integers = NDArray[np.intp]

# Keeps the draws of loops apart from those of other stages that register the same pair.
SEED_STAGE = 2


@dataclass(frozen=True, eq=False)
class LoopEdge:
    """A loop to close: the measured T_i_j of frames i and j (indices, i < j).

    `information` is (6, 6), of the right perturbation in the frame of j.
    """

    i: int
    j: int
    T_i_j: Float64
    information: Float64


@dataclass(frozen=True)
class Confirmation:
    """How well two views must fit before they count as a loop (section 3.4).

    Attributes
    ----------
    max_error
        Largest E of Algorithm 1, in units of its resolution. E is divided by all points, so it
        also falls when points lose their partners: alone it confirms nothing.
    min_share
        Least share of the source's points that must have a correspondence, 0 to 1. How large it
        can be depends on how densely the registration samples the views in units of its
        resolution.
    """

    max_error: float = 0.35
    min_share: float = 0.25

    def objection(self, registration: Registration) -> str:
        """Return why a registration is not good enough, or nothing if it is."""
        if registration.share < self.min_share:
            return (
                f"too few correspondences: {registration.share:.0%} of the points, "
                f"not {self.min_share:.0%}"
            )
        if not registration.error <= self.max_error:
            return f"too large an error: {registration.error:.3g}, not {self.max_error:.3g}"
        return ""


class LoopDetector(Protocol):
    """A method that says where the camera may be again, and how to make sure."""

    part_kind: ClassVar[str] = "loops"

    @property
    def confirmation(self) -> Confirmation:
        """What a registration of the two views must reach."""
        ...

    def candidates(self, poses: Float64) -> Integers:
        """Return the positions of earlier cameras that the newest may see again, best first.

        `poses` is (N, 4, 4) T_world_camera in the order of the frames, NaN where there is none;
        the newest comes last.
        """
        ...


@part("loops", "given")
@dataclass(frozen=True)
class Given(LoopDetector):
    """Look for no loops: only those given by hand are closed, as in chapter 4 of the thesis."""

    confirmation: Confirmation = Confirmation()

    def candidates(self, poses: Float64) -> Integers:
        """See `LoopDetector.candidates`: there are none."""
        return np.zeros(0, np.intp)


@part("loops", "nearby", label="validated")
@dataclass(frozen=True)
class Nearby(LoopDetector):
    """Take cameras as candidates that are close and look the same way (section 3.4).

    Attributes
    ----------
    max_distance_m
        Largest distance between the two cameras.
    max_yaw_rad
        Largest rotation about the camera's y axis between them.
    min_gap
        Cameras closer behind than this many frames are too recent to form a loop.
    per_frame
        At most so many candidates for each frame, the nearest in distance and yaw.
    """

    max_distance_m: float = 0.5
    max_yaw_rad: float = 0.35
    min_gap: int = 16
    per_frame: int = 2
    confirmation: Confirmation = Confirmation()

    def __post_init__(self) -> None:
        for name in ("max_distance_m", "max_yaw_rad"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, not above 0")
        for name in ("min_gap", "per_frame"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not 1 or more")

    def candidates(self, poses: Float64) -> Integers:
        """See `LoopDetector.candidates`."""
        old = poses[: max(0, len(poses) - self.min_gap)]
        if len(old) == 0:
            return np.zeros(0, np.intp)
        distance = np.linalg.norm(old[:, :3, 3] - poses[-1, :3, 3], axis=1) / self.max_distance_m
        angle = np.abs(yaw(se3.inverse(old) @ poses[-1])) / self.max_yaw_rad
        # NaN, of a lost frame, compares as False.
        near = np.flatnonzero((distance <= 1) & (angle <= 1))
        order = np.argsort(distance[near] ** 2 + angle[near] ** 2, kind="stable")
        return near[order[: self.per_frame]]


def yaw(T: Float64) -> Float64:
    """Heading of the z axis about the y axis, -pi to pi rad, of motions (..., 4, 4)."""
    return np.arctan2(T[..., 0, 2], T[..., 2, 2])


def confirm(
    source: Frame,
    target: Frame,
    guess: Float64,
    registrar: Registrar,
    confirmation: Confirmation,
    *,
    seed: int,
) -> tuple[LoopRecord, LoopEdge | None]:
    """Register two views and decide whether they close a loop.

    The registration is tried from the guess and, as a trajectory may have drifted far, from the
    identity. Of those that are good enough (else of all) the one with more correspondences counts.

    Parameters
    ----------
    source, target
        The two views; the later one is registered to the earlier one, whatever their order here.
    guess
        (4, 4) T_target_source, as the trajectory has it.
    seed
        Of the run: the same pair and seed give the same answer.

    Returns
    -------
    record, edge
        What was decided and why; the edge is None where the loop is not accepted.
    """
    i, j = target.index, source.index
    if j < i:
        return confirm(target, source, se3.inverse(guess), registrar, confirmation, seed=seed)
    found: list[Registration] = []
    failure = ""
    for start in (guess, np.eye(4)):
        try:
            rng = np.random.default_rng([seed, SEED_STAGE, i, j])
            found.append(registrar.register(source, target, start, rng))
        except RegistrationError as error:
            failure = str(error)
    if not found:
        return LoopRecord(i, j, False, f"can't be registered: {failure}"), None
    best = max(found, key=lambda r: (not confirmation.objection(r), r.share, -r.error))
    objection = confirmation.objection(best)
    reason = objection or f"{best.share:.0%} of the points correspond, error {best.error:.3g}"
    record = LoopRecord(i, j, not objection, reason, overlap=best.share, rms_m=best.rms_m)
    if objection:
        return record, None
    return record, LoopEdge(i, j, best.T_target_source, best.information)
