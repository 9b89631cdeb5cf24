"""The interface of registration methods, and their result."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import se3, unit_vectors
from tofuse.engine.quantities import percent

# Minimum probability of a pose that other evidence may confirm.
PROBABLE = 0.5


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """Result of a registration: the pose of one view in the frame of another.

    Attributes
    ----------
    T_target_source
        (4, 4) maps points of the source view into the target's frame.
    converged
        False if the iterations ran out before the stopping rule was met.
    iterations
        Number of iterations.
    correspondences
        Number of pairs in the last iteration.
    points
        Number of points of the source that were used (n_p of the thesis).
    error
        E of Algorithm 1: sum of the distances of corresponding points / (points * resolution).
    rms_m
        Root mean square distance of corresponding points, m.
    information
        (6, 6) information of the right perturbation (tx ty tz rx ry rz) in the source frame, about
        `reference_point`: 1/m^2, 1/(m rad), 1/rad^2.
    unobservable
        (k, 6) directions of the right perturbation that the data doesn't constrain.
    errors
        E at every iteration.
    margin
        Score of the pose minus that of the best other pose, as a fraction of the points, for
        methods that search; None for those that follow a guess.
    believed
        Whether the pose is verified; None for methods that don't verify. `converged` does not imply
        it: iterations converge at wrong poses too.
    probability
        That the pose is right, 0 to 1; None for methods that don't estimate it.
    reason
        Why the pose is rejected, in words; empty otherwise.
    remedy
        What would decide whether a rejected pose is right, in words; empty otherwise.
    runner_up
        (4, 4) T_target_source of the best other pose; None if there is none, or none was searched
        for.
    overlap, support
        Fraction of the points of both views that project onto a surface of the other one, and that
        lie on it, 0 to 1; None for methods that don't compare views in both directions.
    contradiction
        Points in the other view's free space, or with another reflectance, as a fraction of those
        that project onto a surface.
    violation
        Fraction of the points in the other view's free space.
    confirmed
        Whether an alignment from the guess converges to the pose of the search.
    given_guess
        Whether `believed` and `probability` hold only for poses near the guess, or near the
        identity without one: another pose fits as well, or none was tried.
    scale, scale_sigma
        Factor of the source's points before `T_target_source` is applied, and its standard
        deviation; 1 and None where it was not estimated.
    reference_point
        (3,) of the source, m: its `shift` for clouds in map coordinates, else its origin.
    """

    T_target_source: Float64
    converged: bool
    iterations: int
    correspondences: int
    points: int
    error: float
    rms_m: float
    information: Float64
    unobservable: Float64 = field(default_factory=lambda: np.zeros((0, 6)))
    errors: tuple[float, ...] = ()
    margin: float | None = None
    believed: bool | None = None
    probability: float | None = None
    reason: str = ""
    remedy: str = ""
    runner_up: Float64 | None = None
    overlap: float | None = None
    support: float | None = None
    contradiction: float | None = None
    violation: float | None = None
    confirmed: bool = False
    given_guess: bool = False
    scale: float = 1.0
    scale_sigma: float | None = None
    reference_point: Float64 = field(default_factory=lambda: np.zeros(3))

    def __repr__(self) -> str:
        decision = {True: "accepted", False: "rejected", None: "not verified"}[self.believed]
        if self.believed and self.given_guess:
            decision += " given the guess"
        t, w = self.T_target_source[:3, 3], se3.so3_log(self.T_target_source[:3, :3])
        return (
            f"Registration: {decision}, translation {np.linalg.norm(t):.4f} m, "
            f"rotation {np.degrees(np.linalg.norm(w)):.3f} degrees, "
            f"{percent(self.inlier_ratio)} inliers, rms {1000 * self.rms_m:.2f} mm"
        )

    @property
    def inlier_ratio(self) -> float:
        """Corresponding points as a fraction of the source's points, 0 to 1."""
        return self.correspondences / self.points if self.points else 0.0

    @property
    def covariance(self) -> Float64 | None:
        """(6, 6), the inverse of `information`: m^2, m rad, rad^2; None if it is unbounded."""
        return None if len(self.unobservable) else self._observed_covariance

    @property
    def sigma(self) -> tuple[float | None, float | None]:
        """Standard deviations (m, rad) in the worst observable direction.

        None where not known, or where no direction is observable.
        """
        covariance = self._observed_covariance
        if covariance is None:
            return None, None
        sigma_m, sigma_rad = se3.largest_sigmas(covariance).tolist()
        # In metres both are of similar size; a negligible one is rounding error.
        limit = 1e-6 * max(sigma_m, sigma_rad * self.lever_m)
        return (
            sigma_m if sigma_m > limit else None,
            sigma_rad if sigma_rad * self.lever_m > limit else None,
        )

    @property
    def lever_m(self) -> float:
        """Distance at which a rotation moves the points by as much as is known of them, m."""
        of_translation, of_rotation = np.diag(self.information).reshape(2, 3).sum(1)
        return float(np.sqrt(of_rotation / of_translation)) if of_translation > 0 else 1.0

    @property
    def _observed_covariance(self) -> Float64 | None:
        """(6, 6), without the unobservable directions; None where the information is unusable."""
        information = np.asarray(self.information, float)
        if not np.isfinite(information).all():
            return None
        units = np.array([1, 1, 1, *[max(self.lever_m, 1e-6)] * 3])
        basis = np.eye(6)
        if len(self.unobservable):
            _, s, vt = np.linalg.svd(self.unobservable * units)
            basis = vt[int((s > 1e-9 * s[0]).sum()) :].T
        if basis.shape[1] == 0:
            return None
        values, vectors = np.linalg.eigh(basis.T @ (information / np.outer(units, units)) @ basis)
        if not values[0] > 1e-12 * values[-1]:
            return None
        root = basis @ vectors / np.sqrt(values)
        return np.asarray(root @ root.T / np.outer(units, units), np.float64)

    @property
    def is_probable(self) -> bool:
        """Whether the pose is more probable than not."""
        return self.probability is not None and self.probability >= PROBABLE

    @property
    def is_decisive(self) -> bool:
        """Whether it needs no confirmation by another measurement.

        It is accepted, or a search and an alignment agree on a probable pose.
        """
        return bool(self.believed) or (self.is_probable and self.confirmed)

    @property
    def how(self) -> str:
        """How the pose was estimated, in words."""
        if self.margin is None:
            return "followed from a guess"
        return f"found by a search, margin {percent(max(self.margin, 0.0))}"

    def between(self, T_a_target: Float64, T_source_b: Float64) -> Registration:
        """Return the registration of source b in target a, given two rigid transforms (4, 4).

        Parameters
        ----------
        T_a_target
            Maps the target's frame into a.
        T_source_b
            Maps b into the source's frame.
        """
        T_reference_b = se3.translation(-self.reference_point) @ T_source_b
        adjoint, inverse_adjoint = (
            se3.adjoint(T) for T in (T_reference_b, se3.inverse(T_reference_b))
        )
        runner_up = self.runner_up
        return replace(
            self,
            T_target_source=T_a_target @ self.T_target_source @ T_source_b,
            information=adjoint.T @ self.information @ adjoint,
            unobservable=unit_vectors(self.unobservable @ inverse_adjoint.T),
            reference_point=np.zeros(3),
            runner_up=None if runner_up is None else T_a_target @ runner_up @ T_source_b,
        )


@dataclass(frozen=True, eq=False)
class Link:
    """A registration of two views of different components.

    Attributes
    ----------
    i, j
        Frame indices of target and source.
    registration
        Of source and target.
    certain
        Whether it is accepted by itself. Otherwise it needs other consistent links.
    how
        Origin of the link, in words.
    """

    i: int
    j: int
    registration: Registration
    certain: bool
    how: str

    @property
    def T_i_j(self) -> Float64:
        """(4, 4)."""
        return self.registration.T_target_source

    @property
    def information(self) -> Float64:
        """(6, 6) of the right perturbation."""
        return self.registration.information


class Registrar(Protocol):
    """A method that registers one pair of views."""

    part_kind: ClassVar[str] = "registration"

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view it works on: "range", "cloud"; by default both."""
        return frozenset({"range", "cloud"})

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """Register `source` into the frame of `target`, starting from `guess` (T_target_source).

        Raises RegistrationError if there are too few points to try.
        """
        ...
