"""Projective alignment of prepared views: point to plane, and albedo where it has texture.

The normal equations of several targets add up, because the unknown is always the same right
perturbation of the source's pose. Degenerate directions keep the prediction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np

from tofuse.engine.alignment import step_kernels as steps
from tofuse.engine.alignment.base import Registration
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.compute import median
from tofuse.engine.geometry import unit_vectors
from tofuse.engine.views import PreparedView, SurfaceOptions
from tofuse.engine.views import residual_kernels as kernels

# A direction is constrained if its sigma is at most 1 cm, or 1 degree.
UNITS = np.array([0.01] * 3 + [np.radians(1.0)] * 3)
WEAK = 1e-3  # information of a weak prior in `UNITS`
# Residuals beyond this many sigmas have no weight; nor have points on surfaces with other normals.
ROBUST, MIN_COSINE = 3.5, math.cos(0.7)
# Largest sigma of a typical distance where views disagree, m. It covers noise that neighbouring
# pixels share, which plane fits do not show.
MAX_SIGMA_M = 0.02
# A level ends when a step is smaller, and an alignment has converged if its last step was, in units
# of 1 cm and 1 degree.
_TOLERANCE, _CONVERGENCE = 0.01, 0.1
# Below this depth, noise inflation is reduced in proportion to the depth.
_NEAR_M = 1.0
# With fewer points the noise scale, their median residual, has an error above 8 %.
_MIN_POINTS = 200
# Numbers of targets beyond one are rounded up to a multiple.
_FEW_TARGETS = 4
# Noise scales of one camera's views differ by less than this factor.
_MAX_SCALE_RATIO = 3.0


def step_with_weak_prior(H: Float64, g: Float64) -> tuple[Float64, Float64]:
    """Return the steps (..., 6) of normal equations (..., 6, 6), (..., 6), and their information.

    A weak prior, which is part of it, keeps what they do not constrain in place.
    """
    units = np.outer(UNITS, UNITS)
    scaled = H * units + WEAK * np.eye(6)
    return -np.linalg.solve(scaled, (g * UNITS)[..., None])[..., 0] * UNITS, scaled / units


@dataclass(frozen=True)
class Level:
    """One level, coarse to fine: every `stride`-th pixel, at most `iterations` iterations.

    `inflation_m` is added to the sigma of a distance, `photometric_inflation` to that of the log
    albedo.
    """

    stride: int
    iterations: int
    inflation_m: float
    photometric_inflation: float


@dataclass(frozen=True)
class ProjectiveOptions:
    """Options of the alignment of two prepared views.

    Attributes
    ----------
    levels
        Coarse to fine. Strides are halved for views with few pixels.
    photometric
        Whether photometric residuals of the albedo are used.
    prior_m, prior_rad
        Sigma of the prediction: a weak prior that matters along degenerate directions only.
    constrained
        Maximum sigma of a constrained direction, in units of 1 cm and 1 degree; degenerate ones are
        taken from the prediction.
    common_tilt, common_slope
        Errors fixed to the camera, which distort both views equally and cause spurious information:
        standard deviation of normals in rad, and of the log albedo's slopes by ray coordinate.
    """

    levels: tuple[Level, ...] = (
        Level(4, 6, 0.03, 0.1),
        Level(4, 2, 0.005, 0.02),
        Level(2, 2, 0.0, 0.0),
    )
    photometric: bool = True
    prior_m: float = 0.3
    prior_rad: float = 0.3
    constrained: float = 1.0
    common_tilt: float = 0.03
    common_slope: float = 0.1


def points_of(view: PreparedView, stride: int) -> Float32:
    """Return every `stride`-th pixel with a plane of every `stride`-th row, for the kernels.

    The points lie on the fitted surface, as the target's do, so that the smoothing of curved
    surfaces is the same for both.
    """
    return kernels.sample_points(view.images, stride)


def _points_of_level(view: PreparedView, level: Level) -> Float32:
    """Return the points of a level; more of a view that has few pixels with a plane."""
    stride = level.stride
    points = points_of(view, stride)
    while stride > 1 and len(points) < _MIN_POINTS:
        stride //= 2
        points = points_of(view, stride)
    return points


@dataclass(frozen=True, eq=False)
class Target:
    """A view to align with and its pose T_target_world (4, 4), by default that of the world."""

    view: PreparedView
    T_target_world: Float64 = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class Aligned:
    """Result of an alignment.

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
        the Jacobians of the two views cancels in it; less spurious information by common errors.
    unobservable
        (k, 6) degenerate unit directions, in units of 1 cm and 1 degree.
    points, projected, compared, inliers, in_front
        Counts of source points, summed over the targets.
    rms_m
        RMS distance of the inliers, m.
    scale
        Noise scale of the residuals relative to the views' stated sigmas, bounded above.
    noise_scale
        The same without a bound: from the median of all compared points, outliers included.
    photo_scale
        Standard deviation of the photometric residuals (log albedo).
    exposure
        Log albedo of the targets minus the source's.
    photometric
        Whether photometric residuals were used.
    score
        Quality of fit, for comparing alignments of one view: robust weights of both terms, less
        twice the points in free space, as a fraction of the points (the mean over targets).
    """

    T_world_source: Float64
    converged: bool
    iterations: int
    information: Float64
    cross: Float64
    unobservable: Float64
    points: int
    projected: int
    compared: int
    inliers: int
    in_front: int
    rms_m: float
    scale: float
    photo_scale: float
    score: float
    exposure: float = 0.0
    photometric: bool = False
    noise_scale: float = 1.0

    @cached_property
    def inlier_ratio(self) -> float:
        """Inliers as a fraction of the compared points."""
        return self.inliers / self.compared if self.compared else 0.0

    @cached_property
    def overlap(self) -> float:
        """Fraction of the points that project into a target (the mean over targets)."""
        return self.projected / self.points if self.points else 0.0


def span(directions: Float64, min_ratio: float) -> Float64:
    """Return an orthonormal basis (6, m), in `UNITS`, of directions (k, 6) in m and rad.

    Parameters
    ----------
    directions
        Spanning set.
    min_ratio
        Minimum singular value relative to the largest.
    """
    u, s, _ = np.linalg.svd((directions / UNITS).T, full_matrices=False)
    return np.asarray(u[:, s > min_ratio * s[0]], np.float64)


def with_free_directions(information: Float64, basis: Float64) -> Float64:
    """Return information (6, 6) without any along the directions of a basis (6, m)."""
    along = information @ basis
    return np.asarray(
        information - along @ np.linalg.pinv(basis.T @ along, hermitian=True) @ along.T, np.float64
    )


def registration_of(aligned: Aligned, T_target_source: Float64, C: Float64) -> Registration:
    """Return an alignment with one target as a registration.

    Parameters
    ----------
    aligned
        Alignment.
    T_target_source
        (4, 4).
    C
        (6, 6) covariance of the right perturbation, m and rad.
    """
    return Registration(
        T_target_source=T_target_source,
        converged=aligned.converged,
        iterations=aligned.iterations,
        correspondences=aligned.inliers,
        points=max(aligned.compared, 1),
        error=aligned.scale,
        rms_m=aligned.rms_m,
        information=np.asarray(np.linalg.inv(C), np.float64),
        unobservable=unit_vectors(aligned.unobservable * UNITS),
    )


def align(
    source: PreparedView,
    targets: Sequence[Target],
    T_world_predicted: Float64,
    options: ProjectiveOptions,
    *,
    start: Float64 | None = None,
    usual_scale: float = 0.0,
) -> Aligned:
    """Align a view with one or more others.

    Parameters
    ----------
    source, targets
        View to align, and views with known poses.
    T_world_predicted
        (4, 4) predicted pose of the source; kept along degenerate directions.
    start
        (4, 4) initial pose; the prediction unless given.
    usual_scale
        Usual noise scale of this camera's alignments, if known: the noise scale is bounded by three
        times this value, even beyond `max_sigma_m`.
    """
    T_world_predicted = np.ascontiguousarray(T_world_predicted)
    T0 = T_world_predicted if start is None else np.ascontiguousarray(start)
    photometric = (
        options.photometric and source.has_albedo and all(t.view.has_albedo for t in targets)
    )
    prior = np.array([options.prior_m] * 3 + [options.prior_rad] * 3)
    points = _points_of_level(source, options.levels[0])
    nuisance = np.array([0.0, 1.0, 0.1 if photometric else 0.0])
    if photometric:
        nuisance[steps.EXPOSURE] = _initial_exposure(points, targets, T0)
    max_scale = 10.0  # relative to the stated sigmas of the views
    if len(points):
        sigma = points[:, kernels.SIGMA] * points[:, kernels.POINT + 2]
        max_scale = max(3.0, MAX_SIGMA_M / median(sigma), _MAX_SCALE_RATIO * usual_scale)
    depth_factor = min(1.0, source.depth / _NEAR_M) if source.depth > 0 else 1.0
    images = tuple(t.view.target_image for t in targets)
    if len(images) > 1:  # kernels are compiled for one target, and for a few
        images += images[-1:] * (-len(images) % _FEW_TARGETS)
    T_targets = np.stack([t.T_target_world for t in targets])
    sigma_ratio = _sigma_ratio(source, targets)
    T = T0.copy()
    iterations = 0
    for index, level in enumerate(options.levels):
        if index and level.stride != options.levels[index - 1].stride:
            points = _points_of_level(source, level)
        settings = steps.LevelSettings(
            level.iterations,
            _TOLERANCE,
            max_scale,
            level.inflation_m * depth_factor,
            level.photometric_inflation,
            ROBUST,
            MIN_COSINE,
            remap=index > 0,  # at the coarsest level the views are not yet aligned
            tilt=options.common_tilt,
            slope=options.common_slope,
            sigma_ratio=sigma_ratio,
            max_sigma=options.constrained,
            prior=prior,
            units=UNITS,
        )
        total, spurious, unobservable, step_size, level_iterations = steps.iterate_level(
            points, images, T_targets, T, T_world_predicted, nuisance, settings
        )
        iterations += level_iterations
    inliers = total[kernels.INLIERS]
    noise_scale = steps.scale_of_distances(total[kernels.HISTOGRAM :])
    return Aligned(
        T_world_source=T,
        converged=step_size < _CONVERGENCE,
        iterations=iterations,
        information=steps.information(total),
        cross=steps.cross_information(total) - spurious,
        unobservable=unobservable,
        points=len(points) * len(targets),
        projected=int(total[kernels.PROJECTED]),
        compared=int(total[kernels.COMPARED]),
        inliers=int(inliers),
        in_front=int(total[kernels.IN_FRONT]),
        rms_m=float(np.sqrt(total[kernels.SQUARES_M] / inliers)) if inliers else np.inf,
        scale=float(nuisance[steps.SCALE_G]),
        photo_scale=float(nuisance[steps.SCALE_P]),
        exposure=float(nuisance[steps.EXPOSURE]),
        photometric=photometric and bool(total[kernels.COUNT_P] > 0),
        noise_scale=float(noise_scale) if np.isfinite(noise_scale) else np.inf,
        score=float(
            (total[kernels.WEIGHT_G] + total[kernels.WEIGHT_P] - 2 * total[kernels.IN_FRONT])
            / max(len(points) * len(targets), 1)
        ),
    )


def _sigma_ratio(source: PreparedView, targets: Sequence[Target]) -> float:
    """Return the rms sigma of the source and its targets, relative to that of the source."""
    others = sum(t.view.noise**2 for t in targets) / len(targets)
    ratio = others / source.noise**2 if source.noise > 0 else 1.0
    return math.sqrt(0.5 * (1 + ratio)) if math.isfinite(ratio) else 1.0


def _initial_exposure(points: Float32, targets: Sequence[Target], T: Float64) -> float:
    """Return the median difference in log albedo over a subset of the points at T (4, 4)."""
    stride = max(1, len(points) // steps.SAMPLE_SIZE)
    per_target = []
    for target in targets:
        T_target_source = np.ascontiguousarray(target.T_target_world @ T)
        per_target.append(
            kernels.exposure_differences(points, stride, target.view.target_image, T_target_source)
        )
    differences = np.concatenate(per_target) if per_target else np.zeros(0)
    return median(differences) if len(differences) else 0.0


@dataclass(frozen=True)
class ViewOptions(Bounded):
    """Options of preparation and alignment that depend on the camera and the scene.

    Attributes
    ----------
    columns
        Images are halved until they have at most this many columns: fewer for speed, more for fine
        structure.
    photometric
        Whether the albedo is used in the alignment; switch it off where the light changes.
    falloff
        Exponent of the cosine to the optical axis by which amplitude falls off towards the corners;
        None to estimate it from the recording.
    range_falloff
        Exponent of the range by which colour (as if lit by a lamp on the camera) or infrared
        images of kind "ir" get darker; None to estimate it from the recording.
    """

    columns: Annotated[int, Bounds(16, 4096)] = 320
    photometric: bool = True
    falloff: Annotated[float | None, Bounds(-20, 20)] = None
    range_falloff: Annotated[float | None, Bounds(0, 10)] = None

    @property
    def surface(self) -> SurfaceOptions:
        """Options of `prepare_view`."""
        return SurfaceOptions(
            columns=self.columns, falloff=self.falloff, range_falloff=self.range_falloff
        )

    @property
    def alignment(self) -> ProjectiveOptions:
        """Options of `align`."""
        return ProjectiveOptions(photometric=self.photometric)
