"""Map consistency: how well the range images of a recording agree under a set of poses.

It needs no ground truth, so it distinguishes good poses from bad ones even where the reference is
no more accurate than the estimate. The definition:

1. Of the frames with a pose at most `frames` are used, evenly spaced, including the first and the
   last.
2. z images are subsampled by 2 until they have at most 320 columns; pixels outside 0.1 to 12 m are
   invalid.
3. A normal is the cross product of central differences over +-2 pixels of the raw points, and is
   unknown where one of the four is invalid or differs from the centre by over 5 % of its depth.
4. A pair counts if at least 35 % of the valid pixels of each project to a valid pixel of the other
   with a difference in z under 0.25 m.
5. The later image's points are compared with the plane at the pixel of the earlier one that they
   project to. Inliers are those with a normal there and at most 0.10 m from the point there.

The figures are the rms distance of the inliers from the plane, and the fraction of inliers among
the points that project to a pixel with a normal, pooled over all pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import Camera, Pinhole
from tofuse.engine.compute import run_all
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import RangeFrame, Recording, evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import finite_or_none
from tofuse.engine.quality.view_agreement_kernels import agreement_sums, transform_points
from tofuse.engine.sensor import Corrector

MAX_COLUMNS = 320
MIN_DEPTH, MAX_DEPTH = 0.1, 12.0  # m
NORMAL_REACH = 2  # pixels
NORMAL_JUMP = 0.05  # fraction of the depth
MIN_OVERLAP = 0.35  # fraction of the valid pixels, both ways
MAX_FRAMES = 100


@dataclass(frozen=True)
class PairAgreement:
    """How well view j agrees with the earlier view i.

    Attributes
    ----------
    i, j
        Positions of the views in the input; i < j.
    overlap
        The smaller of the two fractions of step 4.
    compared
        Number of points of j that project to a pixel of i with a normal.
    inliers
        Number of these within 0.10 m of the point there.
    squares
        Sum of the inliers' squared distances from the plane, m^2.
    """

    i: int
    j: int
    overlap: float
    compared: int
    inliers: int
    squares: float

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the inliers from the plane, m; NaN without inliers."""
        return float(np.sqrt(self.squares / self.inliers)) if self.inliers else np.nan

    @property
    def inlier_ratio(self) -> float:
        """Fraction of inliers among the points compared, 0 to 1; NaN if there are none."""
        return self.inliers / self.compared if self.compared else np.nan


@dataclass(frozen=True)
class Consistency:
    """Map consistency of a set of views.

    Attributes
    ----------
    rms_m
        Pooled rms of the inliers' distances from the plane, m; NaN if no pair counts.
    inlier_ratio
        Pooled fraction of inliers, 0 to 1; NaN if no pair counts.
    pairs
        Number of pairs of views that count.
    frames
        Number of views that were used.
    agreements
        The pairs that count, in order of (i, j).
    """

    rms_m: float
    inlier_ratio: float
    pairs: int
    frames: int
    agreements: tuple[PairAgreement, ...] = ()

    @classmethod
    def of(cls, agreements: Sequence[PairAgreement], frames: int) -> Consistency:
        """Pool the pairs that count, of a number of views."""
        compared = sum(p.compared for p in agreements)
        inliers = sum(p.inliers for p in agreements)
        squares = sum(p.squares for p in agreements)
        return cls(
            float(np.sqrt(squares / inliers)) if inliers else np.nan,
            inliers / compared if compared else np.nan,
            len(agreements),
            frames,
            tuple(agreements),
        )

    def to_dict(self) -> dict[str, float | int | None]:
        """Return the pooled figures as plain data; None instead of NaN."""
        return {
            "rms_m": finite_or_none(self.rms_m),
            "inlier_share": finite_or_none(self.inlier_ratio),
            "pairs": self.pairs,
            "frames": self.frames,
        }


@dataclass(frozen=True, eq=False)
class SurfaceImage:
    """A range image prepared for comparison (steps 2 and 3).

    Attributes
    ----------
    camera
        The camera, at full resolution.
    step
        Every n-th pixel of the camera is used.
    points
        (H, W, 3) in m, z = 0 where invalid.
    normals
        (H, W, 3) unit normals, 0 where unknown.
    """

    camera: Camera
    step: int
    points: Float64
    normals: Float32

    @classmethod
    def of(cls, frame: RangeFrame, depth_unit_m: float | None = None) -> SurfaceImage:
        """Prepare a frame.

        Parameters
        ----------
        frame
            The frame.
        depth_unit_m
            Unit of the recording's depth images in m, if known. Depths in single precision are
            then rounded to it, so that comparisons with limits that counts can meet exactly have
            the same outcome as in double precision.
        """
        depth = frame.depth.astype(np.float64)
        if depth_unit_m:
            counts = np.rint(depth / depth_unit_m) * depth_unit_m
            depth = np.where(np.abs(counts - depth) <= 1e-6 * depth, counts, depth)
        rays = _rays(frame.camera)
        if frame.depth_kind == "range":
            depth = depth / np.sqrt((rays * rays).sum(-1) + 1)
        depth[~((depth >= MIN_DEPTH) & (depth <= MAX_DEPTH))] = 0
        step = 1
        while depth.shape[1] // step > MAX_COLUMNS:
            step *= 2
        z, rays = depth[::step, ::step], rays[::step, ::step]
        points = np.empty((*z.shape, 3))
        points[..., :2] = np.where(z[..., None] > 0, rays * z[..., None], 0)
        points[..., 2] = z
        return cls(frame.camera, step, points, _normals(points))

    @cached_property
    def valid(self) -> int:
        """Number of valid pixels."""
        return int(np.count_nonzero(self.points[..., 2]))

    @cached_property
    def max_radius2(self) -> float:
        """Maximum x^2 + y^2 at z = 1 in the field of view, with a margin."""
        return 1.1 * float(np.nanmax((_rays(self.camera) ** 2).sum(-1)))

    def pixels(self, points: Float64) -> Float64:
        """Project points (N, 3) in the camera frame to pixels (N, 2) of the camera."""
        if isinstance(self.camera, Pinhole):
            return self.camera.project(points)
        # Other cameras project slowly, so only points that can be in view are projected.
        pixels = np.full((len(points), 2), np.nan)
        x, y, z = points.T
        in_view = (z > 0.05) & (x * x + y * y <= self.max_radius2 * z * z)
        pixels[in_view] = self.camera.project(points[in_view])
        return pixels


def pair_agreement(
    a: SurfaceImage, b: SurfaceImage, T_a_b: Float64, i: int = 0, j: int = 1
) -> PairAgreement | None:
    """Compare view b with the earlier view a.

    Parameters
    ----------
    a, b
        The views.
    T_a_b
        (4, 4) relative pose.
    i, j
        Their positions, for the result.

    Returns
    -------
    None if they overlap too little (step 4).
    """
    projected_b, compared, inliers, squares = _compare(a, b, T_a_b)
    overlap = projected_b / max(b.valid, 1)
    if overlap < MIN_OVERLAP:
        return None
    projected_a, *_ = _compare(b, a, se3.inverse(T_a_b))
    overlap = min(overlap, projected_a / max(a.valid, 1))
    if overlap < MIN_OVERLAP:
        return None
    return PairAgreement(i, j, overlap, compared, inliers, squares)


def consistency_of_images(
    images: Sequence[SurfaceImage], poses: ArrayLike, pairs: Sequence[tuple[int, int]] | None = None
) -> Consistency:
    """Map consistency of prepared views under poses (N, 4, 4) T_world_camera.

    Over all pairs, unless `pairs` i < j are given. Independent of the number of threads.
    """
    T = np.asarray(poses, float)
    if pairs is None:
        pairs = [(i, j) for i in range(len(images)) for j in range(i + 1, len(images))]

    def compared(i: int, j: int) -> PairAgreement | None:
        return pair_agreement(images[i], images[j], se3.inverse(T[i]) @ T[j], i, j)

    agreements = run_all([partial(compared, i, j) for i, j in pairs])
    return Consistency.of([pair for pair in agreements if pair is not None], len(images))


def map_consistency(
    recording: Recording,
    poses: ArrayLike,
    frames: int = MAX_FRAMES,
    correctors: Sequence[Corrector] = (),
) -> Consistency:
    """Map consistency of a recording under poses of its frames.

    Frames that can't be read are left out.

    Parameters
    ----------
    recording
        Range images.
    poses
        (M, 4, 4) T_world_camera of the M frames of the recording, NaN where there is none.
    frames
        Maximum number of frames to use.
    correctors
        Corrections that are applied to the frames first.

    Raises
    ------
    InputError
        If the recording contains clouds, or the number of poses is not that of the frames.
    """
    T = np.asarray(poses, float)
    if T.shape != (len(recording), 4, 4):
        raise InputError(
            f"have shape {T.shape}, for {quantities.count(len(recording), 'frame')}",
            where="poses",
            remedy="pass one pose per frame",
        )
    if frames < 1:
        raise InputError(f"is {frames}", where="frames", remedy="use 1 or more")
    depth_unit_m = recording.metadata.get("depth_unit_m")
    selected = evenly_spaced(np.flatnonzero(np.isfinite(T).all((1, 2))), frames)
    images, used = [], []
    for k in selected:
        try:
            frame = recording[int(k)]
        except UnreadableFrameError:
            continue
        if not isinstance(frame, RangeFrame):
            raise InputError(
                "contains clouds, but map consistency compares range images",
                where=recording.path,
                remedy="leave out --recording",
            )
        for corrector in correctors:
            frame = corrector.apply(frame)
        assert isinstance(frame, RangeFrame)
        images.append(SurfaceImage.of(frame, depth_unit_m))
        used.append(int(k))
    return consistency_of_images(images, T[used])


def _compare(a: SurfaceImage, b: SurfaceImage, T_a_b: Float64) -> tuple[int, int, int, float]:
    """Compare b's points, in a's frame, with the pixels of a that they project to."""
    points = b.points.reshape(-1, 3)
    transformed = np.empty_like(points)
    transform_points(points, np.ascontiguousarray(T_a_b), transformed)
    return agreement_sums(
        transformed, a.pixels(transformed), a.points, a.normals, a.step, a.max_radius2
    )


def _rays(camera: Camera) -> Float64:
    """(H, W, 2) rays in double precision: computed exactly for a pinhole camera."""
    if type(camera) is Pinhole:
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
        return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)
    return camera.rays().astype(np.float64)


def _normals(points: Float64) -> Float32:
    k = NORMAL_REACH
    normals = np.zeros(points.shape, np.float32)
    if min(points.shape[:2]) <= 2 * k:
        return normals
    centre = points[k:-k, k:-k, 2]
    sides = [points[k:-k, 2 * k :], points[k:-k, : -2 * k], points[2 * k :, k:-k]]
    sides.append(points[: -2 * k, k:-k])
    valid = centre > 0
    for side in sides:
        z = side[..., 2]
        valid &= (z > 0) & (np.abs(z - centre) <= NORMAL_JUMP * centre)
    normal = np.cross(sides[0] - sides[1], sides[2] - sides[3])
    length = np.linalg.norm(normal, axis=-1)
    valid &= length > 0
    normals[k:-k, k:-k][valid] = normal[valid] / np.maximum(length[valid], 1e-12)[:, None]
    return normals
