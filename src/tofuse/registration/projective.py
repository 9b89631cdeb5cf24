"""Projective alignment of prepared views: point to plane, and albedo where it has texture.

The normal equations of several targets add up, because the unknown is always the same right
perturbation of the source's pose. Directions that the data does not hold keep the prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.kernels import alignment as kernels
from tofuse.kernels.threads import run_chunks
from tofuse.maps.surface_map import SurfaceMap

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# A direction is held if its sigma is at most 1 cm, or 1 degree.
UNITS = np.array([0.01] * 3 + [np.radians(1.0)] * 3)
_CHUNK_POINTS = 6000
_UPPER6 = np.triu_indices(6)
_UPPER7 = np.triu_indices(7)


@dataclass(frozen=True)
class Level:
    """One stage, coarse to fine: every `stride`-th pixel, at most so many iterations.

    `slack_m` is added to the sigma of a distance, `photo_slack` to that of the log albedo.
    """

    stride: int
    iterations: int
    slack_m: float
    photo_slack: float


@dataclass(frozen=True)
class ProjectiveOptions:
    """How two prepared views are aligned.

    Attributes
    ----------
    levels
        Coarse to fine.
    robust
        Residuals beyond so many sigmas count nothing.
    max_angle
        Largest angle between the normals of source and target, rad.
    photometric
        Whether the albedo takes part.
    prior_m, prior_rad
        Sigma of the prediction. Weak: it only decides what the data leaves open.
    held
        How well a direction must be held, in units of 1 cm and 1 degree, not to be taken from the
        prediction.
    tolerance
        A level ends when a step is smaller, in units of 1 cm and 1 degree.
    settled
        An alignment has converged if its last step was smaller, in the same units.
    """

    levels: tuple[Level, ...] = (
        Level(4, 6, 0.03, 0.1),
        Level(2, 4, 0.005, 0.02),
        Level(1, 2, 0.0, 0.0),
    )
    robust: float = 3.5
    max_angle: float = 0.7
    photometric: bool = True
    prior_m: float = 0.3
    prior_rad: float = 0.3
    held: float = 1.0
    tolerance: float = 0.01
    settled: float = 0.1


@dataclass(frozen=True, eq=False)
class Points:
    """Pixels of a source view, as the kernel takes them."""

    points: Float32
    normals: Float32
    sigma: Float32
    photo: Float32

    @classmethod
    def of(cls, view: SurfaceMap, stride: int) -> Points:
        """Take every `stride`-th pixel of every `stride`-th row that has a plane."""
        part = (slice(stride // 2, None, stride), slice(stride // 2, None, stride))
        inverse_z = view.planes[part][..., 3]
        ok = inverse_z > 0
        # On the fitted surface, as the target's: what smoothing does to a curved surface is then
        # the same on both sides.
        z = 1 / inverse_z[ok]
        points = np.empty((len(z), 3), np.float32)
        points[:, :2] = view.rays[part][ok] * z[:, None]
        points[:, 2] = z
        return cls(
            points,
            view.normals[part][ok],
            (np.sqrt(view.plane_variance[part][ok]) * z * z).astype(np.float32),
            view.photo[part][ok],
        )


@dataclass(frozen=True, eq=False)
class Target:
    """A view to align with, and where it is: T_target_world."""

    view: SurfaceMap
    T_target_world: Float64


@dataclass(frozen=True, eq=False)
class Aligned:
    """The outcome of an alignment.

    Attributes
    ----------
    T_world_source
        (4, 4).
    converged
        Whether the last step was small.
    iterations
        Over all levels.
    information
        (6, 6) of the right perturbation, from the noise that the views show.
    cross
        (6, 6) the symmetrised cross-information: like the information, but independent noise in
        the Jacobians of the two views cancels in it.
    unobservable
        (k, 6) unit directions (in units of 1 cm and 1 degree) that the data does not hold.
    points, landed, compared, inliers, in_front
        Counts of source points, summed over the targets.
    rms_m
        Of the inliers' distances.
    scale
        Rms of the inliers' residuals in sigmas.
    photo_scale
        The same of the log albedo's, as a standard deviation.
    exposure
        Log albedo of the targets minus the source's.
    score
        How much of the view fits, for comparing alignments of one view: robust weights of both
        terms, less twice the points in free space, as a share of the points.
    """

    T_world_source: Float64
    converged: bool
    iterations: int
    information: Float64
    cross: Float64
    unobservable: Float64
    points: int
    landed: int
    compared: int
    inliers: int
    in_front: int
    rms_m: float
    scale: float
    photo_scale: float
    score: float
    exposure: float = 0.0

    @cached_property
    def inlier_share(self) -> float:
        """Inliers among the points that could be compared."""
        return self.inliers / self.compared if self.compared else 0.0

    @cached_property
    def overlap(self) -> float:
        """Points that land in a target, as a share of all (the mean over targets)."""
        return self.landed / self.points if self.points else 0.0


@dataclass
class _State:
    """What changes from one iteration to the next."""

    T: Float64
    exposure: float = 0.0
    scale_g: float = 1.0
    scale_p: float = 0.1
    total: Float64 = field(default_factory=lambda: np.zeros(kernels.SIZE))


def align(
    source: SurfaceMap,
    targets: Sequence[Target],
    T_world_predicted: Float64,
    options: ProjectiveOptions,
    *,
    start: Float64 | None = None,
    exposure: float = 0.0,
) -> Aligned:
    """Align a view with one or more others.

    Parameters
    ----------
    T_world_predicted
        (4, 4) where the source is expected; what the data leaves open stays there.
    start
        (4, 4) where the iterations begin; the prediction unless given.
    """
    T0 = np.ascontiguousarray(T_world_predicted if start is None else start)
    state = _State(T0.copy(), exposure)
    photometric = (
        options.photometric and source.has_photo and all(t.view.has_photo for t in targets)
    )
    iterations = 0
    converged = False
    weak = np.zeros((0, 6))
    points = Points.of(source, options.levels[0].stride)
    for number, level in enumerate(options.levels):
        if number:
            points = Points.of(source, level.stride)
        for k in range(level.iterations):
            state.total = _sum(points, targets, state, level, options, photometric)
            iterations += 1
            H, g = _normal_equations(state, photometric)
            cross = _cross(state.total, state, photometric)
            if number > 0 or k >= level.iterations // 2:
                weak = _weak_directions(cross, options.held)
            step = _step(H, g, state, weak, T_world_predicted, options)
            state.T = kernels.moved(state.T, step[:6])
            if photometric:
                state.exposure += step[6]
            _rescale(state, level, photometric)
            size = np.abs(step[:6] / UNITS).max()
            converged = bool(size < options.settled)
            if size < options.tolerance:
                break
    total = state.total
    information = _reduced_information(total, state, photometric)
    inliers = total[kernels.INLIERS]
    return Aligned(
        T_world_source=state.T,
        converged=converged,
        iterations=iterations,
        information=information,
        cross=_cross(total, state, photometric),
        unobservable=weak,
        points=len(points.points) * len(targets),
        landed=int(total[kernels.LANDED]),
        compared=int(total[kernels.COMPARED]),
        inliers=int(inliers),
        in_front=int(total[kernels.IN_FRONT]),
        rms_m=float(np.sqrt(total[kernels.SQUARES_M] / inliers)) if inliers else np.inf,
        scale=state.scale_g,
        photo_scale=state.scale_p,
        exposure=state.exposure,
        score=float(
            (total[kernels.WEIGHT_G] + total[kernels.WEIGHT_P] - 2 * total[kernels.IN_FRONT])
            / max(len(points.points), 1)
        ),
    )


def _sum(
    points: Points,
    targets: Sequence[Target],
    state: _State,
    level: Level,
    options: ProjectiveOptions,
    photometric: bool,
) -> Float64:
    total = np.zeros(kernels.SIZE)
    n = len(points.points)
    for target in targets:
        view = target.view
        T = np.ascontiguousarray(target.T_target_world @ state.T)

        def work(a: int, b: int, view: SurfaceMap = view, T: Float64 = T) -> Float64:
            return kernels.accumulate(
                points.points,
                points.normals,
                points.sigma,
                points.photo,
                view.planes,
                view.plane_variance,
                view.photo,
                view.projection.lookup,
                view.projection.frame,
                T,
                state.exposure,
                state.scale_g,
                state.scale_p if photometric else 0.0,
                level.slack_m,
                options.robust,
                float(np.cos(options.max_angle)),
                a,
                b,
            )

        for part in run_chunks(work, n, max(1, n // _CHUNK_POINTS)):
            total += part
    return total


def _symmetric(upper: Float64, size: int) -> Float64:
    out = np.zeros((size, size))
    index = _UPPER6 if size == 6 else _UPPER7
    out[index] = upper
    out.T[index] = upper
    return out


def _normal_equations(state: _State, photometric: bool) -> tuple[Float64, Float64]:
    t = state.total
    H = np.zeros((7, 7))
    g = np.zeros(7)
    H[:6, :6] = _symmetric(t[kernels.GEOMETRY_H : kernels.GEOMETRY_H + 21], 6)
    g[:6] = t[kernels.GEOMETRY_G : kernels.GEOMETRY_G + 6]
    if photometric:
        H += _symmetric(t[kernels.PHOTO_H : kernels.PHOTO_H + 28], 7)
        g += t[kernels.PHOTO_G : kernels.PHOTO_G + 7]
    if H[6, 6] <= 0:
        H[6, 6] = 1.0
    return H, g


def _without_exposure(H: Float64) -> Float64:
    """Marginalise the seventh unknown."""
    if H[6, 6] <= 0:
        return H[:6, :6]
    return H[:6, :6] - np.outer(H[:6, 6], H[6, :6]) / H[6, 6]


def _reduced_information(total: Float64, state: _State, photometric: bool) -> Float64:
    H, _ = _normal_equations(state, photometric)
    return _without_exposure(H)


def _cross(total: Float64, state: _State, photometric: bool) -> Float64:
    C = np.zeros((7, 7))
    C[:6, :6] = _symmetric(total[kernels.CROSS_G : kernels.CROSS_G + 21], 6)
    if photometric:
        C += _symmetric(total[kernels.CROSS_P : kernels.CROSS_P + 28], 7)
    return _without_exposure(C)


def _weak_directions(cross: Float64, held: float) -> Float64:
    """Unit directions, in units of 1 cm and 1 degree, whose sigma is above `held` units."""
    scaled = cross * np.outer(UNITS, UNITS)
    values, vectors = np.linalg.eigh(scaled)
    return vectors[:, values < 1 / (held * held)].T


def _step(
    H: Float64,
    g: Float64,
    state: _State,
    weak: Float64,
    T_predicted: Float64,
    options: ProjectiveOptions,
) -> Float64:
    scale = np.append(UNITS, 1.0)
    A = H * np.outer(scale, scale)
    b = g * scale
    prior = np.array([options.prior_m] * 3 + [options.prior_rad] * 3) / UNITS
    away = se3.log(se3.inverse(T_predicted) @ state.T) / UNITS
    A[np.arange(6), np.arange(6)] += 1 / prior**2
    b[:6] += away / prior**2
    if len(weak):
        # What the data does not hold is held at the prediction, far more firmly than noise can.
        firm = 1e3 * max(float(np.trace(A[:6, :6])), 1.0)
        P = weak.T @ weak
        A[:6, :6] += firm * P
        b[:6] += firm * (P @ away)
    return -np.linalg.solve(A, b) * scale


def _rescale(state: _State, level: Level, photometric: bool) -> None:
    """Take the sigmas from the residuals: the views show only their own noise, not their bias."""
    t = state.total
    if t[kernels.WEIGHT_G] > 0:
        # A biweight at 3.5 sigmas cuts the variance of a Gaussian to about 0.72 of itself.
        seen = np.sqrt(t[kernels.SQUARES_G] / t[kernels.WEIGHT_G] / 0.72)
        state.scale_g = float(np.clip(state.scale_g * seen, 0.7, 10.0))
    if photometric and t[kernels.WEIGHT_P] > 0:
        seen = np.sqrt(t[kernels.SQUARES_P] / t[kernels.WEIGHT_P] / 0.72)
        state.scale_p = float(np.clip(np.hypot(seen, level.photo_slack), 0.005, 0.5))
