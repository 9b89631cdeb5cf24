"""Measurements on trajectories and models: sizes, angles, girth, distances from the truth.

Models are points in the frame of the true surface, which has z up; see
`RecordedScene.T_truth_world`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.quality import trajectory_errors

_MAX_FIT_POINTS = 20_000  # max points of a wall fit


@dataclass(frozen=True, eq=False)
class PathScore:
    """Errors of a trajectory; lost frames are ignored.

    Attributes
    ----------
    ate_m, rotation_deg
        Root mean square errors of positions and orientations after alignment.
    end_m, end_deg
        Error of the last pose in the frame of the first camera, without alignment.
    drift
        (N, 3) error of the position along x, y, z of the first camera, m, without alignment:
        the cumulative error of figures 5.2 and 5.6. NaN where lost.
    step_m
        (N,) length of the error of the motion since the frame before; NaN for the first and where
        lost.
    """

    ate_m: float
    rotation_deg: float
    end_m: float
    end_deg: float
    drift: Float64
    step_m: Float64

    @property
    def axes_rms_m(self) -> Float64:
        """(3,) root mean square of the drift along each axis, m."""
        return np.sqrt(np.nanmean(self.drift**2, axis=0))


def score_path(poses: Float64, truth: Float64) -> PathScore:
    """Compare poses (N, 4, 4), NaN where lost, with true ones; both begin with the identity."""
    times = np.arange(len(poses), dtype=float)
    error = trajectory_errors.evaluate_trajectory(times, poses, times, truth)
    last = int(np.flatnonzero(np.isfinite(poses[:, 0, 0]))[-1])
    end = se3.inverse(truth[last]) @ poses[last]
    motion_errors = se3.inverse(motions(truth)) @ motions(poses)
    return PathScore(
        error.ate_rms_m,
        float(np.degrees(error.rotation_rms_rad)),
        float(np.linalg.norm(end[:3, 3])),
        float(np.degrees(se3.angle(end))),
        poses[:, :3, 3] - truth[:, :3, 3],
        np.append(np.nan, np.linalg.norm(motion_errors[:, :3, 3], axis=1)),
    )


def motions(poses: Float64) -> Float64:
    """(N - 1, 4, 4) motions between neighbours of poses (N, 4, 4); NaN next to a lost one."""
    return se3.inverse(poses[:-1]) @ poses[1:]


def unwrapped_angle_deg(poses: Float64, axis: Float64) -> Float64:
    """(N,) rotation in degrees since the first pose about an axis (3,) of the camera.

    Angles continue beyond 360 degrees. A lost frame takes the angle of the previous one.
    """
    has_pose = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    angle = np.zeros(len(poses))
    angle[has_pose[1:]] = se3.so3_log(motions(poses[has_pose])[:, :3, :3]) @ axis
    return np.degrees(np.cumsum(angle))


def straightness_m(positions: Float64) -> float:
    """RMS distance of positions (N, 3) from their best-fit line."""
    valid = positions[np.isfinite(positions[:, 0])]
    residual = np.linalg.svd(valid - valid.mean(0), compute_uv=False)[1:]
    return float(np.sqrt((residual**2).sum() / len(valid)))


def circle_radius_m(positions: Float64) -> float:
    """Radius of the best-fit circle of positions (N, 3), in their best-fit plane (Kasa 1976)."""
    valid = positions[np.isfinite(positions[:, 0])]
    centred = valid - valid.mean(0)
    planar = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
    A = np.column_stack([2 * planar, np.ones(len(planar))])
    (a, b, c), *_ = np.linalg.lstsq(A, (planar**2).sum(1), rcond=None)
    return float(np.sqrt(c + a * a + b * b))


def extent_m(points: Float64) -> Float64:
    """(3,) size of a model along its axes, without one percent of the points at each end."""
    low, high = np.percentile(points, [1, 99], axis=0)
    return high - low


def surface_error_m(points: Float64, surface: Any) -> float:
    """Median distance of a model's points from those of a tree of the true surface, m."""
    sample = points[:: -(-len(points) // 10_000)]
    return float(np.median(surface.query(sample)[0]))


def girth_m(points: Float64, low: float, high: float, sectors: int = 36) -> float:
    """Length around a body between two heights, m; NaN if a sector is empty.

    Each sector contributes its median distance from the centre, so that double walls of a poor
    model are averaged.
    """
    xy = points[(points[:, 2] >= low) & (points[:, 2] <= high), :2]
    if len(xy) == 0:
        return float("nan")
    # The centre of the outline; the points may be denser on one side.
    low_xy, high_xy = np.percentile(xy, [2, 98], axis=0)
    r = xy - (low_xy + high_xy) / 2
    sector = ((np.arctan2(r[:, 1], r[:, 0]) / (2 * np.pi) % 1) * sectors).astype(int) % sectors
    radius = np.linalg.norm(r, axis=1)
    median = np.array(
        [np.median(radius[sector == k]) if (sector == k).any() else np.nan for k in range(sectors)]
    )
    angle = 2 * np.pi * (np.arange(sectors) + 0.5) / sectors
    outline = median[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return float(np.linalg.norm(outline - np.roll(outline, -1, axis=0), axis=1).sum())


@dataclass(frozen=True, eq=False)
class BoxFit:
    """Four upright walls and a top fitted to a model of a box.

    Attributes
    ----------
    corners
        (4, 2) plan of the walls' corners, m.
    widths_m
        (2,) distances between opposite walls.
    angles_deg
        (4,) angles between neighbouring walls, inside the box.
    height_m
        From the lower rim of the walls to the top face.
    """

    corners: Float64
    widths_m: Float64
    angles_deg: Float64
    height_m: float


def fit_box(points: Float64, bottom: float, height: float, width: float) -> BoxFit:
    """Fit the walls and the top of a box near its expected position.

    All is NaN where a wall has no points.

    Parameters
    ----------
    points
        (N, 3) model.
    bottom, height, width
        True heights above the floor and approximate width, m: the search region.
    """
    z = points[:, 2]
    sides = points[(z > bottom + 0.15 * height) & (z < bottom + 0.85 * height), :2]
    sides = sides[:: -(-len(sides) // _MAX_FIT_POINTS)]
    # The centre of the outline, not biased towards the side with most points.
    initial_centre = (np.percentile(sides, 3, axis=0) + np.percentile(sides, 97, axis=0)) / 2
    fits = [_walls(sides, initial_centre, a, width) for a in np.radians([-30, -15, 0, 15, 30])]
    normals, offsets, _ = min(fits, key=lambda fit: fit[2])
    if np.isnan(offsets).any():
        missing = np.full((4, 2), np.nan)
        return BoxFit(missing, missing[0], missing[:, 0], float("nan"))
    next_wall = np.roll(np.arange(4), -1)
    pairs = np.stack([np.arange(4), next_wall], 1)
    corners = np.linalg.solve(normals[pairs], offsets[pairs][..., None])[..., 0].astype(np.float64)
    centre = corners.mean(0)
    distances = offsets - normals @ centre
    cosines = (normals * normals[next_wall]).sum(1)
    interior_angles = 180 - np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    distance = np.abs(points[:, :2] - centre).max(1)
    top = z[(distance < 0.35 * width) & (z > bottom + 0.8 * height)]
    walls = z[(distance > 0.4 * width) & (distance < 0.75 * width) & (z > bottom - 0.1)]
    rise = float(np.median(top) - np.percentile(walls, 0.5)) if len(top) and len(walls) else np.nan
    return BoxFit(corners, distances[:2] + distances[2:], interior_angles, rise)


def _walls(
    xy: Float64, centre: Float64, start_angle: float, width: float
) -> tuple[Float64, Float64, float]:
    """Fit four lines, n . p = d, to points (N, 2); returns n, d (NaN without points) and misfit.

    The initial lines are a square of `width` m at `start_angle` rad about `centre`. Points are
    assigned to the nearest line, with distances truncated at a fifth of the width, so that a model
    with double walls keeps four lines.
    """
    angle = start_angle + np.pi / 2 * np.arange(4)
    normals = np.stack([np.cos(angle), np.sin(angle)], 1)
    offsets = normals @ centre + width / 2
    truncation = width / 5
    fitted = np.zeros(4, bool)
    for _ in range(15):
        distance = np.abs(xy @ normals.T - offsets)
        nearest = distance.argmin(1)
        inlier = distance.min(1) < truncation
        for k in range(4):
            assigned = xy[inlier & (nearest == k)]
            if len(assigned) < 10:
                continue
            mean = assigned.mean(0)
            n = np.linalg.svd(assigned - mean, full_matrices=False)[2][1]
            n *= np.sign(n @ (mean - centre)) or 1.0
            # Reject lines that cross the box.
            if n @ normals[k] > 0.8:
                normals[k], offsets[k], fitted[k] = n, n @ mean, True
    misfit = np.minimum(np.abs(xy @ normals.T - offsets).min(1), truncation)
    return normals, np.where(fitted, offsets, np.nan), float(np.mean(misfit**2))


def displacement_m(a: Float64, b: Float64) -> Float64:
    """(N,) displacement of a point 2 m in front of a camera between poses a and b (N, 4, 4).

    It combines position and orientation errors in one length. NaN where a pose is NaN.
    """
    point = np.array([0.0, 0.0, 2.0, 1.0])
    return np.linalg.norm(((a - b) @ point)[:, :3], axis=1)
