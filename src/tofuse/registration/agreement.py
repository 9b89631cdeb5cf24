"""What two images say of a pose between them: support, and space that one of them saw through."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.geometry import se3
from tofuse.kernels import search as kernels
from tofuse.kernels.threads import run_chunks
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.view_points import ViewPoints

_CHUNK_POINTS = 6000
_CLASH = 2.0  # times the difference that counts neither way
_NEIGHBOURS = np.ones((5, 5), np.uint8)


@dataclass(frozen=True)
class AgreementOptions:
    """How two images are compared.

    Attributes
    ----------
    points
        About how many points of each image are moved into the other.
    sigmas, floor_m, floor_share
        A point supports the pose within so many sigmas of both images, plus metres, plus a share
        of its depth: errors of the sensor that its noise does not show.
    max_angle
        Largest angle between the normals of surfaces that support each other, rad.
    albedo
        Difference in log albedo, exposure apart, with which a point on the surface counts neither
        for nor against the pose; one that differs more than twice as much does not support it.
    violation_weight, clash_weight
        How many supporting points are outweighed by a point in free space, and at most by one
        that lies on a surface of another albedo.
    """

    points: int = 2500
    sigmas: float = 2.0
    floor_m: float = 0.01
    floor_share: float = 0.01
    max_angle: float = 0.7
    albedo: float = 0.1
    violation_weight: float = 2.0
    clash_weight: float = 1.0

    def __post_init__(self) -> None:
        if not 1e-6 <= self.albedo <= 1e6:
            raise ValueError(f"albedo is {self.albedo}, not above 0")
        if not 10 <= self.points <= 10_000_000:
            raise ValueError(f"points is {self.points}, not 10 or more")
        for name in (
            "sigmas",
            "floor_m",
            "floor_share",
            "max_angle",
            "violation_weight",
            "clash_weight",
        ):
            if not 0 <= getattr(self, name) <= 1e6:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 or more")


@dataclass(frozen=True)
class Agreement:
    """What both images say of a pose, both ways taken together.

    Attributes
    ----------
    overlap
        Share of the points that land on a surface of the other image.
    support
        Share of the points that lie on the other image's surface, and reflect as it does.
    violation
        Share of the points that lie in front of it: where the other camera saw through.
    clash
        Share of the points that lie on the surface, but reflect otherwise: no support.
    rms_m
        Distance from the surface of the points that lie on it; inf without any.
    points
        How many were compared, of both images.
    score
        Points on the surface, each by how alike it reflects: 1 - (difference / `albedo`)^2, and
        no less than the negative clash weight; less twice the violation. Of poses that geometry
        can't tell apart the right one makes the albedo agree. Points that are hidden, or out of
        view, say nothing.
    """

    overlap: float
    support: float
    violation: float
    clash: float
    rms_m: float
    points: int
    score: float

    @property
    def contradiction(self) -> float:
        """Violations and clashes, as a share of the points that land on a surface."""
        return (self.violation + self.clash) / max(self.overlap, 1e-9)


def agreement(
    source: PreparedView,
    target: PreparedView,
    T_target_source: Float64,
    options: AgreementOptions | None = None,
) -> Agreement:
    """Judge a pose by what both images saw.

    Parameters
    ----------
    T_target_source
        (4, 4) maps points of the source into the target.
    """
    return Comparison.of(source, target, options).at(T_target_source)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two views, prepared to be judged at many poses.

    Attributes
    ----------
    ways
        Points of one view, and the view that they are looked up in with its `nearest_depth`: from
        the source to the target, and back.
    """

    ways: tuple[tuple[ViewPoints, PreparedView, Float32], tuple[ViewPoints, PreparedView, Float32]]
    options: AgreementOptions

    @classmethod
    def of(
        cls, source: PreparedView, target: PreparedView, options: AgreementOptions | None = None
    ) -> Comparison:
        """Prepare two views."""
        options = AgreementOptions() if options is None else options
        there = ViewPoints.of(source, options.points), target, nearest_depth(target)
        back = ViewPoints.of(target, options.points), source, nearest_depth(source)
        return cls((there, back), options)

    def at(self, T_target_source: Float64) -> Agreement:
        """Judge a pose (4, 4); see `agreement`."""
        options = self.options
        T = np.ascontiguousarray(T_target_source, np.float64)
        total = np.zeros(kernels.AGREEMENT_SIZE)
        count = 0
        differences = []
        for (points, by, nearest), pose in zip(self.ways, (T, se3.inverse(T)), strict=True):
            count += len(points.points)
            differences.append(np.empty(len(points.points), np.float32))
            pose = np.ascontiguousarray(pose)
            total += _one_way(points, by, nearest, pose, options, differences[-1])
        on_surface, violation = total[kernels.SUPPORT], total[kernels.VIOLATION]
        # Exposure is what most of them differ by; the way back sees its negative.
        lighter = np.concatenate([differences[0], -differences[1]])
        lighter = lighter[np.isfinite(lighter)]
        clash, alike = 0, float(on_surface)
        if len(lighter):
            apart = np.abs(lighter - np.median(lighter)) / options.albedo
            clash = int(np.count_nonzero(apart > _CLASH))
            alike -= float(np.minimum(apart**2, 1 + options.clash_weight).sum(dtype=np.float64))
        share = 1 / max(count, 1)
        return Agreement(
            overlap=float(total[kernels.COMPARED] * share),
            support=float((on_surface - clash) * share),
            violation=float(violation * share),
            clash=float(clash * share),
            rms_m=float(np.sqrt(total[kernels.SQUARES_M] / on_surface)) if on_surface else np.inf,
            points=count,
            score=float(share * (alike - options.violation_weight * violation)),
        )


def nearest_depth(view: PreparedView) -> Float32:
    """(H, W) least z in m among the neighbours of a pixel, 0 where it is invalid itself.

    Pixels without a plane are often at edges, where they mix the depths of both sides.
    """
    least = cv2.erode(np.where(view.z > 0, view.z, np.float32(np.inf)), _NEIGHBOURS)
    return np.where(view.z > 0, least, np.float32(0)).astype(np.float32)


def _one_way(
    points: ViewPoints,
    view: PreparedView,
    nearest: Float32,
    T: Float64,
    options: AgreementOptions,
    differences: Float32,
) -> Float64:
    def work(a: int, b: int) -> Float64:
        return kernels.measure_agreement(
            points.points,
            points.normals,
            points.sigma,
            points.light,
            view.planes,
            view.plane_variance,
            view.albedo,
            nearest,
            view.projection.lookup,
            view.projection.frame,
            T,
            options.sigmas,
            options.floor_m,
            options.floor_share,
            float(np.cos(options.max_angle)),
            differences,
            a,
            b,
        )

    n = len(points.points)
    parts = run_chunks(work, n, max(1, n // _CHUNK_POINTS))
    return np.asarray(sum(parts, np.zeros(kernels.AGREEMENT_SIZE)))
