"""Agreement of two range images at a pose: support and free-space violations.

Sampled points of each are projected into the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.compute import median, run_chunks
from tofuse.engine.geometry import se3
from tofuse.engine.normal import MEDIAN_OF_NORMAL
from tofuse.engine.search import search_kernels as kernels
from tofuse.engine.search.search_kernels import ViewPoints
from tofuse.engine.views import PreparedView, residual_kernels

# Smallest difference between the scores of different poses, as a fraction of the points.
MIN_LEAD = 0.03
_CHUNK_POINTS = 6000
_CLASH_RATIO = 2.0  # relative to the neutral difference in log albedo
_NEIGHBOURS = np.ones((5, 5), np.uint8)
# Prior standard deviation of an unknown exponent of the falloff (natural vignetting is the fourth
# power), number of points that share an albedo error, and trimmed least-squares iterations.
_FALLOFF_SIGMA, _CORRELATED_POINTS, _ITERATIONS = 4.0, 100, 4


# Weight of a point in free space, and maximum weight of one on a surface of another albedo, where
# that of a supporting point is 1.
_VIOLATION_WEIGHT, _CLASH_WEIGHT = 2.0, 1.0


@dataclass(frozen=True)
class AgreementOptions:
    """Options of the comparison of two images.

    Attributes
    ----------
    points
        Approximate number of points of each image that are projected into the other.
    sigmas, floor_m, floor_fraction
        Distance tolerance of a supporting point: standard deviations of both images, plus metres,
        plus a fraction of its depth, for systematic errors of the sensor.
    albedo
        Difference in log albedo, less the exposure, at which a point on the surface counts neither
        for nor against the pose; beyond twice this value it is a clash.
    """

    points: int = 2500
    sigmas: float = 2.0
    floor_m: float = 0.01
    floor_fraction: float = 0.01
    albedo: float = 0.1


@dataclass(frozen=True)
class Agreement:
    """Agreement of two images at a pose, over both directions.

    Attributes
    ----------
    overlap
        Fraction of the points that project onto a surface of the other image.
    support
        Fraction of the points on the other image's surface with the same albedo.
    violation
        Fraction of the points in front of it, in the other camera's free space.
    clash
        Fraction of the points on the surface with another albedo: no support.
    rms_m
        RMS distance of the points on the surface from it, m; inf without any.
    points
        Number of compared points of both images.
    score
        Mean over the points of 1 - (albedo difference / `albedo`)^2, at least the negative clash
        weight, on the surface, and of the negative violation weight in free space. Albedo
        distinguishes geometrically ambiguous poses. Occluded points and points out of view count 0.
    falloff
        Exponent of the cosine to the optical axis by which both views' albedo still falls off, if
        that was unknown: the one at which they fit best after compensation.
    """

    overlap: float
    support: float
    violation: float
    clash: float
    rms_m: float
    points: int
    score: float
    falloff: float = 0.0

    @property
    def contradiction(self) -> float:
        """Violations and clashes, as a fraction of the points that project onto a surface."""
        return (self.violation + self.clash) / max(self.overlap, 1e-9)


def agreement(
    source: PreparedView,
    target: PreparedView,
    T_target_source: Float64,
    options: AgreementOptions | None = None,
) -> Agreement:
    """Return the agreement of two images at a pose.

    Parameters
    ----------
    source, target
        Prepared views.
    T_target_source
        (4, 4) maps points of the source into the target.
    """
    return Comparison.of(source, target, options).at(T_target_source)


@dataclass(frozen=True, eq=False)
class ComparedView:
    """A view prepared for comparisons with others: some of its points, and its `nearest_depth`."""

    view: PreparedView
    points: ViewPoints
    nearest: Float32

    @classmethod
    def of(cls, view: PreparedView, options: AgreementOptions) -> ComparedView:
        """Prepare a view."""
        return cls(view, sampled_points(view, options.points), nearest_depth(view))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two views prepared for evaluation at many poses.

    Attributes
    ----------
    source, target
        The views.
    options
        Of the comparison.
    """

    source: ComparedView
    target: ComparedView
    options: AgreementOptions

    @property
    def unknown_falloff(self) -> bool:
        """Whether both views' amplitude falls off towards the corners by an unknown exponent."""
        return self.source.view.unknown_falloff and self.target.view.unknown_falloff

    @classmethod
    def of(
        cls, source: PreparedView, target: PreparedView, options: AgreementOptions | None = None
    ) -> Comparison:
        """Prepare two views."""
        options = AgreementOptions() if options is None else options
        return cls(ComparedView.of(source, options), ComparedView.of(target, options), options)

    def at(self, T_target_source: Float64) -> Agreement:
        """Return the agreement at a pose (4, 4); see `agreement`."""
        return self.with_points(T_target_source)[0]

    def with_points(self, T_target_source: Float64) -> tuple[Agreement, Bool, Bool]:
        """Return the agreement at a pose, and which points of either lie on the other's surface."""
        options = self.options
        T = np.ascontiguousarray(T_target_source, np.float64)
        total = np.zeros(kernels.AGREEMENT_SIZE)
        count = 0
        differences, supporting = [], []
        # The signs of the differences change with the direction.
        for source, target, pose, sign in (
            (self.source, self.target, T, 1),
            (self.target, self.source, se3.inverse(T), -1),
        ):
            points = source.points
            count += len(points.points)
            log_albedos = np.full((2, len(points.points)), np.nan, np.float32)
            pose = np.ascontiguousarray(pose)
            total += _one_direction(points, target, pose, options, log_albedos)
            supporting.append(np.isfinite(log_albedos[1]))  # also without albedo
            differences.append(sign * log_albedos[:, np.isfinite(log_albedos[0])])
        on_surface, violation = total[kernels.SUPPORT], total[kernels.VIOLATION]
        albedo_ratio, slants = np.hstack(differences)
        clash, consistent, falloff = 0, float(on_surface), 0.0
        if len(albedo_ratio):
            if self.unknown_falloff:
                falloff = _falloff(albedo_ratio, slants, options.albedo)
                albedo_ratio = albedo_ratio + np.float32(falloff) * slants
            # Exposure is the median difference.
            ratio = np.abs(albedo_ratio - np.float32(median(albedo_ratio))) / np.float32(
                options.albedo
            )
            clash = int(np.count_nonzero(ratio > _CLASH_RATIO))
            consistent -= float(np.minimum(ratio**2, 1 + _CLASH_WEIGHT).sum(dtype=np.float64))
        per_point = 1 / max(count, 1)
        found = Agreement(
            overlap=float(total[kernels.COMPARED] * per_point),
            support=float((on_surface - clash) * per_point),
            violation=float(violation * per_point),
            clash=float(clash * per_point),
            rms_m=float(np.sqrt(total[kernels.SQUARES_M] / on_surface)) if on_surface else np.inf,
            points=count,
            score=float(per_point * (consistent - _VIOLATION_WEIGHT * violation)),
            falloff=falloff,
        )
        return found, supporting[0], supporting[1]


def nearest_depth(view: PreparedView) -> Float32:
    """Return the minimum z (H, W) in m over the neighbours of each valid pixel, else 0.

    It allows for mixed pixels, which are common among pixels without a plane.
    """
    nearest = cv2.erode(np.where(view.z > 0, view.z, np.float32(np.inf)), _NEIGHBOURS)
    return np.where(view.z > 0, nearest, np.float32(0)).astype(np.float32)


def _falloff(albedo_ratio: Float32, slants: Float32, albedo: float) -> float:
    """Return the exponent at which differences in log albedo (n,) have the least spread.

    Like the exposure, it is estimated anew at every pose, by trimmed least squares: otherwise the
    falloff, a pattern that is fixed to the camera, contradicts every motion.

    Parameters
    ----------
    slants
        (n,) see `measure_agreement`.
    albedo
        Tolerance of the differences.
    """
    exponent = 0.0
    ridge = _CORRELATED_POINTS * (albedo / _FALLOFF_SIGMA) ** 2
    inliers = np.ones(len(albedo_ratio), bool)
    for _ in range(_ITERATIONS):
        x, y = slants[inliers].astype(np.float64), albedo_ratio[inliers].astype(np.float64)
        x -= x.mean()
        exponent = -float(x @ (y - y.mean())) / (float(x @ x) + ridge)
        residual = albedo_ratio + np.float32(exponent) * slants
        residual = np.abs(residual - np.float32(median(residual[inliers])))
        inliers = residual <= 3 / MEDIAN_OF_NORMAL * np.float32(median(residual[inliers]))
    return exponent


def _one_direction(
    points: ViewPoints,
    target: ComparedView,
    T: Float64,
    options: AgreementOptions,
    log_albedos: Float32,
) -> Float64:
    view, grid = target.view, target.view.projection
    image = kernels.Image(
        view.planes, view.plane_variance, view.albedo, target.nearest, grid.lookup, grid.frame
    )
    tolerance = kernels.Tolerance(
        options.sigmas, options.floor_m, options.floor_fraction, projective.MIN_COSINE
    )

    def work(a: int, b: int) -> Float64:
        return kernels.measure_agreement(
            points, image, T, tolerance, log_albedos[0], log_albedos[1], a, b
        )

    n = len(points.points)
    parts = run_chunks(work, n, max(1, n // _CHUNK_POINTS))
    return np.asarray(sum(parts, np.zeros(kernels.AGREEMENT_SIZE)))


def sampled_points(view: PreparedView, count: int) -> ViewPoints:
    """Return about `count` pixels that have a plane, evenly over the image."""
    available = view.planar_fraction * view.z.size
    packed = projective.points_of(view, max(1, round(float(np.sqrt(available / count)))))
    points = np.ascontiguousarray(packed[:, residual_kernels.POINT : residual_kernels.POINT + 3])
    return ViewPoints(
        points,
        np.ascontiguousarray(packed[:, residual_kernels.NORMAL : residual_kernels.NORMAL + 3]),
        packed[:, residual_kernels.SIGMA] * points[:, 2],
        packed[:, residual_kernels.POINT_ALBEDO].copy(),
    )


def landing_pixels(view: PreparedView, points: Float64) -> tuple[Intp, Intp, Bool]:
    """Return column and row (N,) of the pixels that points (N, 3) project to, and which do to any.

    Column and row are 0 for those outside of the image.
    """
    z = np.where(points[:, 2] > 1e-3, points[:, 2], np.nan)
    pixels = np.rint(view.projection.pixels(points[:, :2] / z[:, None]))
    inside: Bool = np.all((pixels >= 0) & (pixels < view.z.shape[::-1]), axis=1)
    u, v = np.where(inside[:, None], pixels, 0).astype(np.intp).T
    return u, v, inside
