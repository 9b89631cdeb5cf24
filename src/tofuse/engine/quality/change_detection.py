"""Change detection between two sessions in one map: surfaces that appeared or vanished.

A surface of the later session has appeared if the earlier one measured free space there; one of the
earlier session has vanished if the later one did. Points that the other session did not observe, or
that were occluded, are not compared.

Each point is compared with all views of the other session that it projects into. The standard
deviation of a comparison is that of both measurements, scaled by the disagreement of views of the
same session (which noise models do not include), plus the misalignment of the two sessions. A view
with free space at a point is a likelihood ratio for a change, one with a surface there is one
against it; log-ratios are summed over views, and voxels that have changed with high probability are
clustered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from tofuse.engine.arrays import Bool, Float32, Float64, Intp
from tofuse.engine.compute import run_all
from tofuse.engine.connections import parts_of
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.normal import robust_sigma
from tofuse.engine.search import ViewPoints, pair_agreement
from tofuse.engine.views import PreparedView

Kind = Literal["appeared", "vanished"]

# Points of each view, and pairs of views from which the disagreement within a session is estimated.
_POINTS, _MAX_PAIRS = 2000, 60
# Residuals of the same surface are below this fraction of the depth.
_MAX_RESIDUAL = 0.05
# A surface is the same within this many standard deviations; beyond the second, it is free space.
_SURFACE_SIGMAS, _FREE_SPACE_SIGMAS = 3.0, 5.0
# Probability that a view is wrong about a point for reasons other than noise, prior probability of
# a change, and the posterior that is required: a view counts log(19), and two more must support a
# change than contradict it.
_OUTLIER_PROBABILITY, _PRIOR, _MIN_POSTERIOR = 0.05, 0.05, 0.95
# Minimum views of the same session that observe a voxel: flying pixels move with the camera.
_MIN_VIEWS = 2
# Views with larger angles between their axes hardly observe a surface from the same side.
_MIN_COSINE = 0.25
# Edge of a voxel in pixels at the typical depth; voxels closer than this many edges form a cluster.
_VOXEL_PIXELS, _CLUSTER_GAP = 2.5, 3.0
# Minimum area of a change, as a fraction of the area that a view covers at the typical depth.
_MIN_AREA_RATIO = 0.004


@dataclass(frozen=True, eq=False)
class Change:
    """A cluster of surfaces that exist in only one of two sessions.

    Attributes
    ----------
    kind
        "appeared": in the later session only; "vanished": in the earlier one only.
    points
        (N, 3) centroids of its surface in each voxel, world frame, m.
    voxel_m
        Edge of a voxel, m.
    """

    kind: Kind
    points: Float64
    voxel_m: float

    @property
    def centre(self) -> Float64:
        """(3,) centre of its bounding box, world frame, m."""
        return np.asarray(0.5 * (self.points.min(0) + self.points.max(0)), np.float64)

    @property
    def size(self) -> Float64:
        """(3,) size of its bounding box along the axes of the world frame, m."""
        return np.asarray(np.ptp(self.points, axis=0) + self.voxel_m, np.float64)

    @property
    def volume_m3(self) -> float:
        """Volume of the voxels that its surface fills, m^3, without any interior."""
        return len(self.points) * self.voxel_m**3


@dataclass(frozen=True, eq=False)
class _SessionView:
    """A view, prepared for comparison with points."""

    view: PreparedView
    points: ViewPoints
    nearest: Float32
    T_world_camera: Float64


def changes(
    before: Sequence[PreparedView],
    poses_before: Float64,
    after: Sequence[PreparedView],
    poses_after: Float64,
) -> list[Change]:
    """Return what changed between two sessions, the largest change first.

    Parameters
    ----------
    before, after
        Prepared views of the earlier and of the later session.
    poses_before, poses_after
        (N, 4, 4) and (M, 4, 4) T_world_camera.
    """
    if not before or not after:
        return []
    first = _prepare(before, poses_before)
    second = _prepare(after, poses_after)
    scale = max(_noise_scale(first), _noise_scale(second))
    misalignment = _misalignment(first, second, scale)
    depth = float(np.median([v.depth for v in (*before, *after)]))
    pitch = float(np.median([v.projection.pitch for v in (*before, *after)]))
    voxel = _VOXEL_PIXELS * pitch * depth
    solid_angle = float(np.median([v.pixels * v.projection.pitch**2 for v in (*before, *after)]))
    min_voxels = _MIN_AREA_RATIO * solid_angle * depth**2 / voxel**2
    detected = []
    directions: tuple[tuple[Kind, Sequence[_SessionView], Sequence[_SessionView]], ...] = (
        ("appeared", second, first),
        ("vanished", first, second),
    )
    for kind, views, other_views in directions:
        points = _changed_voxels(views, other_views, scale, misalignment, voxel)
        detected += [
            Change(kind, p, voxel) for p in _clusters(points, voxel) if len(p) >= min_voxels
        ]
    return sorted(detected, key=lambda c: -len(c.points))


def _prepare(views: Sequence[PreparedView], poses: Float64) -> list[_SessionView]:
    return [
        _SessionView(
            view,
            pair_agreement.sampled_points(view, _POINTS),
            pair_agreement.nearest_depth(view),
            T,
        )
        for view, T in zip(views, poses, strict=True)
    ]


def _compare(
    source: _SessionView, target: _SessionView
) -> tuple[Intp, Float64, Float64, Float64, Bool]:
    """Compare the points of a view with another view.

    Returns
    -------
    (K,) rows of the points that project to a valid pixel; their distances behind the target's
    surface, m, NaN where it has no plane; how much closer they are than everything that the target
    measured around the pixel, m; the standard deviation of both measurements, m; and whether both
    surfaces face in the same direction.
    """
    T = se3.inverse(target.T_world_camera) @ source.T_world_camera
    points = se3.transform(T, source.points.points.astype(np.float64))
    view = target.view
    j, i, inside = pair_agreement.landing_pixels(view, points)
    projected = np.flatnonzero(inside & (target.nearest[i, j] > 0))
    i, j = i[projected], j[projected]
    p = points[projected]
    plane = view.planes[i, j].astype(np.float64)
    length = np.linalg.norm(plane[:, :3], axis=1)
    has_plane = (plane[:, 3] > 0) & (length > 0)
    length = np.where(has_plane, length, 1.0)
    behind = ((plane[:, :3] * p).sum(1) - 1) / length
    normal = source.points.normals[projected] @ T[:3, :3].T
    facing = has_plane & ((plane[:, :3] * normal).sum(1) / length > 0.5)
    nearer = target.nearest[i, j] - p[:, 2]
    sigma = np.hypot(source.points.sigma[projected], view.sigma[i, j])
    return projected, np.where(has_plane, behind, np.nan), nearer, sigma, facing


def _similar_direction(a: _SessionView, b: _SessionView) -> bool:
    """Whether two views have similar viewing directions."""
    return float(a.T_world_camera[:3, 2] @ b.T_world_camera[:3, 2]) > _MIN_COSINE


def _residuals(pairs: Sequence[tuple[_SessionView, _SessionView]]) -> tuple[Float64, Float64]:
    """Distances of points from the same surface in other views, and their stated sigma, m."""

    def residuals(source: _SessionView, target: _SessionView) -> tuple[Float64, Float64]:
        rows, behind, _, sigma, facing = _compare(source, target)
        z = source.points.points[rows, 2]
        same_surface = facing & (np.abs(np.nan_to_num(behind, nan=np.inf)) < _MAX_RESIDUAL * z)
        return np.abs(behind[same_surface]), sigma[same_surface]

    if not pairs:
        return np.zeros(0), np.ones(0)
    compared = run_all([partial(residuals, *pair) for pair in pairs])
    r, sigma = (np.concatenate(each) for each in zip(*compared, strict=True))
    return r, sigma


def _noise_scale(views: Sequence[_SessionView]) -> float:
    """The disagreement of views of one session, as a multiple of the stated sigma; at least 1."""
    # Neighbours share errors, so views up to a quarter of the session apart are compared too.
    steps = sorted({1, max(1, len(views) // 8), max(1, len(views) // 4)})
    pairs = [(views[k], views[k + s]) for s in steps for k in range(len(views) - s)]
    r, sigma = _residuals(evenly_spaced(pairs, _MAX_PAIRS))
    if not len(r):
        return 1.0
    return max(robust_sigma(r / sigma), 1.0)


def _misalignment(
    first: Sequence[_SessionView], second: Sequence[_SessionView], scale: float
) -> float:
    """The distance between surfaces of two sessions in excess of noise (one sigma), m."""
    facing = [(a, b) for a in first for b in second if _similar_direction(a, b)]
    r, sigma = _residuals(evenly_spaced(facing, 4 * _MAX_PAIRS))
    if not len(r):
        return 0.0
    total = robust_sigma(r)
    noise = scale * float(np.sqrt((sigma**2).mean()))
    return float(np.sqrt(max(total**2 - noise**2, 0.0)))


def _changed_voxels(
    views: Sequence[_SessionView],
    other_views: Sequence[_SessionView],
    scale: float,
    misalignment: float,
    voxel: float,
) -> Float64:
    """(K, 3) surface centroids of voxels where the other session measured free space."""

    def compared(k: int) -> tuple[Float64, Float64, Intp]:
        source = views[k]
        points = source.points.points.astype(np.float64)
        votes = np.zeros(len(points))
        for target in other_views:
            if not _similar_direction(source, target):
                continue
            rows, behind, nearer, sigma, facing = _compare(source, target)
            sigma = np.hypot(scale * sigma, misalignment)
            # On slanted surfaces, errors along the ray exceed those along the normal.
            limit = _FREE_SPACE_SIGMAS * sigma
            free_space = (nearer > limit) & ~(behind > -limit)
            same_surface = facing & (np.abs(behind) < _SURFACE_SIGMAS * sigma)
            votes[rows] += free_space.astype(float) - same_surface
        return se3.transform(source.T_world_camera, points), votes, np.full(len(points), k)

    of_views = run_all([partial(compared, k) for k in range(len(views))])
    points, votes, view_numbers = (np.concatenate(each) for each in zip(*of_views, strict=True))
    if not len(points):
        return np.zeros((0, 3))
    cells, cell = np.unique(np.floor(points / voxel).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell, minlength=len(cells))
    per_vote = np.log((1 - _OUTLIER_PROBABILITY) / _OUTLIER_PROBABILITY)
    log_odds = np.log(_PRIOR / (1 - _PRIOR)) + per_vote * np.bincount(cell, votes) / count
    cells_of_views = np.unique(np.stack([cell, view_numbers]), axis=1)[0]
    view_counts = np.bincount(cells_of_views, minlength=len(cells))
    likely = log_odds >= np.log(_MIN_POSTERIOR / (1 - _MIN_POSTERIOR)) - 1e-9
    changed = likely & (view_counts >= _MIN_VIEWS)
    centroids = np.stack([np.bincount(cell, points[:, axis]) / count for axis in range(3)], 1)
    return np.asarray(centroids[changed], np.float64)


def _clusters(points: Float64, voxel: float) -> list[Float64]:
    """Clusters (K, 3) of points that are close to each other."""
    if not len(points):
        return []
    pairs = cKDTree(points).query_pairs(_CLUSTER_GAP * voxel, output_type="ndarray")
    label = parts_of(len(points), pairs)
    return [points[label == k] for k in range(label.max() + 1)]
