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
from tofuse.registration.doubt import faked_information

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# A direction is held if its sigma is at most 1 cm, or 1 degree.
UNITS = np.array([0.01] * 3 + [np.radians(1.0)] * 3)
# Points from which it is told how much information can be faked: the sums are smooth.
_DOUBT_POINTS = 500
_CHUNK_POINTS = 6000


@dataclass(frozen=True)
class Level:
    """One stage, coarse to fine: every `stride`-th pixel, at most so many iterations.

    `slack_m` is added to the sigma of a distance, `photo_slack` to that of the log albedo.
    """

    stride: int
    iterations: int
    slack_m: float
    photo_slack: float

    def __post_init__(self) -> None:
        if not 1 <= self.stride <= 64:
            raise ValueError(f"stride is {self.stride}, not 1 to 64")
        if not 1 <= self.iterations <= 1000:
            raise ValueError(f"iterations is {self.iterations}, not 1 to 1000")
        for name in ("slack_m", "photo_slack"):
            if not 0 <= getattr(self, name) < 1e3:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 or more")


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
    common_tilt, common_slope
        Errors fixed to the camera, which bend both views alike and so fake information: standard
        deviation of normals in rad, and of the log albedo's slopes by ray coordinate.
    most_sigma_m
        What the sigma of a typical distance may become where the views disagree, m. Noise that
        neighbouring pixels share is not seen by the fits of planes, but by this.
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
    common_tilt: float = 0.03
    common_slope: float = 0.1
    most_sigma_m: float = 0.02
    tolerance: float = 0.01
    settled: float = 0.1

    def __post_init__(self) -> None:
        if not 1 <= len(self.levels) <= 20:
            raise ValueError(f"levels holds {len(self.levels)}; give 1 to 20")
        for name in ("robust", "prior_m", "prior_rad", "held", "most_sigma_m"):
            if not 1e-6 <= getattr(self, name) <= 1e6:
                raise ValueError(f"{name} is {getattr(self, name)}, not above 0")
        for name in ("max_angle", "common_tilt", "common_slope", "tolerance", "settled"):
            if not 0 <= getattr(self, name) <= 1e6:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 or more")


@dataclass(frozen=True, eq=False)
class Points:
    """Pixels of a source view, as the kernel takes them."""

    points: Float32
    normals: Float32
    sigma: Float32
    photo: Float32

    @classmethod
    def of(cls, view: SurfaceMap, stride: int) -> Points:
        """Take every `stride`-th pixel of every `stride`-th row that has a plane.

        The points lie on the fitted surface, as the target's do: what smoothing does to a curved
        surface is then the same on both sides.
        """
        rows, columns = view.z.shape
        most = -(-rows // stride) * -(-columns // stride)
        points, normals, photo = (np.empty((most, 3), np.float32) for _ in range(3))
        sigma = np.empty(most, np.float32)
        n = kernels.gather(
            view.rays,
            view.planes,
            view.plane_variance,
            view.photo,
            stride,
            points,
            normals,
            sigma,
            photo,
        )
        return cls(points[:n], normals[:n], sigma[:n], photo[:n])


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
        the Jacobians of the two views cancels in it; less what errors that they share can fake.
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
    photometric
        Whether the albedo took part.
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
    photometric: bool = False

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
    most: float = 10.0  # what scale_g may become
    total: Float64 = field(default_factory=lambda: np.zeros(kernels.SIZE))


def align(
    source: SurfaceMap,
    targets: Sequence[Target],
    T_world_predicted: Float64,
    options: ProjectiveOptions,
    *,
    start: Float64 | None = None,
    exposure: float | None = None,
) -> Aligned:
    """Align a view with one or more others.

    Parameters
    ----------
    T_world_predicted
        (4, 4) where the source is expected; what the data leaves open stays there.
    start
        (4, 4) where the iterations begin; the prediction unless given.
    exposure
        Log albedo of the targets minus the source's to begin with; seen at the start unless given.
    """
    T_world_predicted = np.ascontiguousarray(T_world_predicted)
    T0 = T_world_predicted if start is None else np.ascontiguousarray(start)
    state = _State(T0.copy())
    photometric = (
        options.photometric and source.has_photo and all(t.view.has_photo for t in targets)
    )
    iterations = 0
    converged = False
    weak = np.zeros((0, 6))
    points = Points.of(source, options.levels[0].stride)
    if photometric:
        state.exposure = _seen_exposure(points, targets, T0) if exposure is None else exposure
    if len(points.sigma):
        state.most = max(3.0, options.most_sigma_m / float(np.median(points.sigma)))
    for number, level in enumerate(options.levels):
        if number:
            points = Points.of(source, level.stride)
        doubt = None
        for _ in range(level.iterations):
            state.total = _sum(points, targets, state, level, options, photometric)
            iterations += 1
            H, g, C = kernels.normal_equations(state.total, photometric)
            if number > 0:  # at the coarsest level the views are not yet where they belong
                if doubt is None:
                    doubt = _doubt(points, state, level, options, photometric)
                weak = _weak_directions(_without_exposure(C) - doubt, options.held)
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
    H, _, C = kernels.normal_equations(total, photometric)
    inliers = total[kernels.INLIERS]
    return Aligned(
        T_world_source=state.T,
        converged=converged,
        iterations=iterations,
        information=_without_exposure(H),
        cross=_without_exposure(C) - (np.zeros((6, 6)) if doubt is None else doubt),
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
        photometric=photometric and bool(total[kernels.COUNT_P] > 0),
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


def _seen_exposure(points: Points, targets: Sequence[Target], T: Float64) -> float:
    """Median difference in log albedo, from some of the points, before they are aligned."""
    some = slice(None, None, max(1, len(points.points) // _DOUBT_POINTS))
    seen = []
    for target in targets:
        view = target.view
        moved = se3.transform(target.T_target_world @ T, points.points[some])
        ahead = moved[:, 2] > 0.02
        moved, light = moved[ahead], points.photo[some][ahead, 0]
        x0, y0, per_x, per_y = view.projection.frame
        nodes = np.rint((moved[:, :2] / moved[:, 2:] - [x0, y0]) * [per_x, per_y])
        lookup = view.projection.lookup
        u, v = np.clip(nodes, 0, [lookup.shape[1] - 1, lookup.shape[0] - 1]).astype(int).T
        pixel = np.rint(lookup[v, u])
        rows, columns = view.z.shape
        inside = (pixel >= 0).all(1) & (pixel[:, 0] < columns) & (pixel[:, 1] < rows)
        j, i = pixel[inside].astype(int).T
        found = view.photo[i, j, 0] - light[inside]
        seen.append(found[np.isfinite(found)])
    both = np.concatenate(seen) if seen else np.zeros(0)
    return float(np.median(both)) if len(both) else 0.0


def _without_exposure(H: Float64) -> Float64:
    """Marginalise the seventh unknown."""
    if H[6, 6] <= 0:
        return H[:6, :6]
    return H[:6, :6] - np.outer(H[:6, 6], H[6, :6]) / H[6, 6]


def _doubt(
    points: Points, state: _State, level: Level, options: ProjectiveOptions, photometric: bool
) -> Float64:
    """(6, 6) information that errors fixed to the camera can fake; from some of the points."""
    n = len(points.points)
    some = slice(None, None, max(1, n // _DOUBT_POINTS))
    p, normals = points.points[some], points.normals[some]
    along = (p * normals).sum(1) / p[:, 2]
    variance = 2 * (along * points.sigma[some] * state.scale_g) ** 2 + level.slack_m**2
    faked = faked_information(
        p,
        normals,
        variance,
        state.scale_p**2 if photometric else 0.0,
        np.isfinite(points.photo[some, 1]),
        options.common_tilt,
        options.common_slope,
    )
    return faked * state.total[kernels.INLIERS] / max(len(p), 1)


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
    away = kernels.twist_between(T_predicted, state.T) / UNITS
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
    counts = t[kernels.HISTOGRAM : kernels.HISTOGRAM + kernels.BINS]
    if counts.sum() > 0:
        # Of all that was compared, not of what fitted: a scale from inliers would confirm itself.
        share = np.cumsum(counts) / counts.sum()
        k = int(np.searchsorted(share, 0.5))
        below = share[k - 1] if k else 0.0
        median = 2 ** ((k - 16 + (0.5 - below) / max(share[k] - below, 1e-9)) / 4)
        state.scale_g = float(np.clip(1.48 * median, 0.7, state.most))
    if photometric and t[kernels.WEIGHT_P] > 0:
        seen = np.sqrt(t[kernels.SQUARES_P] / t[kernels.WEIGHT_P] / 0.72)
        state.scale_p = float(np.clip(np.hypot(seen, level.photo_slack), 0.005, 0.5))
