"""What two images say of a pose between them: support, and space that one of them saw through."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.kernels import search as kernels
from tofuse.kernels.threads import run_chunks
from tofuse.maps.surface_map import SurfaceMap
from tofuse.registration.projective import Points

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_CHUNK_POINTS = 6000
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
    violation_weight
        How many supporting points a point in free space outweighs.
    """

    points: int = 2500
    sigmas: float = 2.0
    floor_m: float = 0.01
    floor_share: float = 0.01
    max_angle: float = 0.7
    violation_weight: float = 2.0

    def __post_init__(self) -> None:
        if not 10 <= self.points <= 10_000_000:
            raise ValueError(f"points is {self.points}, not 10 or more")
        for name in ("sigmas", "floor_m", "floor_share", "max_angle", "violation_weight"):
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
        Share of the points that lie on the other image's surface.
    violation
        Share of the points that lie in front of it: where the other camera saw through.
    rms_m
        Of the supporting points' distances from the surface; inf without any.
    points
        How many were compared, of both images.
    score
        Support less twice the violation. Points that are hidden, or out of view, say nothing.
    """

    overlap: float
    support: float
    violation: float
    rms_m: float
    points: int
    score: float


def agreement(
    source: SurfaceMap,
    target: SurfaceMap,
    T_target_source: Float64,
    options: AgreementOptions | None = None,
) -> Agreement:
    """Judge a pose by what both images saw.

    Parameters
    ----------
    T_target_source
        (4, 4) maps points of the source into the target.
    """
    options = AgreementOptions() if options is None else options
    T = np.ascontiguousarray(T_target_source, np.float64)
    total = np.zeros(kernels.AGREE_SIZE)
    count = 0
    for seen, by, pose in ((source, target, T), (target, source, se3.inverse(T))):
        points = Points.of(seen, stride_for(seen, options.points))
        count += len(points.points)
        total += _one_way(points, by, np.ascontiguousarray(pose), options)
    support, violation = total[kernels.SUPPORT], total[kernels.VIOLATION]
    share = 1 / max(count, 1)
    return Agreement(
        overlap=float(total[kernels.COMPARED] * share),
        support=float(support * share),
        violation=float(violation * share),
        rms_m=float(np.sqrt(total[kernels.SQUARES_M] / support)) if support else np.inf,
        points=count,
        score=float((support - options.violation_weight * violation) * share),
    )


def stride_for(view: SurfaceMap, points: int) -> int:
    """Stride at which about so many pixels of a view with a plane are taken."""
    there = view.planar_share * view.z.size
    return max(1, round(float(np.sqrt(there / points))))


def nearest_depth(view: SurfaceMap) -> Float32:
    """(H, W) least z in m among the neighbours of a pixel, 0 where it is invalid itself.

    Pixels without a plane are often at edges, where they mix the depths of both sides.
    """
    least = cv2.erode(np.where(view.z > 0, view.z, np.float32(np.inf)), _NEIGHBOURS)
    return np.where(view.z > 0, least, np.float32(0)).astype(np.float32)


def _one_way(points: Points, view: SurfaceMap, T: Float64, options: AgreementOptions) -> Float64:
    nearest = nearest_depth(view)

    def work(a: int, b: int) -> Float64:
        return kernels.agree(
            points.points,
            points.normals,
            points.sigma,
            view.planes,
            view.plane_variance,
            nearest,
            view.projection.lookup,
            view.projection.frame,
            T,
            options.sigmas,
            options.floor_m,
            options.floor_share,
            float(np.cos(options.max_angle)),
            a,
            b,
        )

    n = len(points.points)
    parts = run_chunks(work, n, max(1, n // _CHUNK_POINTS))
    return np.asarray(sum(parts, np.zeros(kernels.AGREE_SIZE)))
