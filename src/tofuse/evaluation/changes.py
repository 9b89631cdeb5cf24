"""What changed between two sessions in one map: surfaces that appeared, and that vanished.

A surface of one session has appeared if the other session saw through it: from views that looked
at what lies behind. A surface of the earlier one that the later one saw through has vanished. What
the other session did not look at, or what hid there, says nothing.

Each point is compared with all views of the other session that it lands in. The standard deviation
of a comparison is that of both measurements, scaled by how views of the same session disagree
(which noise models do not know), and by how far the two sessions are off from each other. A view
that saw through a point is a likelihood ratio for the change, one that saw a surface there is one
against it; these add up over views, and voxels that have changed beyond doubt are clustered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tofuse.arrays import Bool, Float32, Float64, Intp
from tofuse.geometry import se3
from tofuse.kernels.threads import run_chunks
from tofuse.registration.agreement import nearest_depth
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.view_points import ViewPoints, landing_pixels

Kind = Literal["appeared", "vanished"]

# Points of each view, and pairs of views of one session from which is learnt how they disagree.
_POINTS, _LEARN = 2000, 60
# Residuals of surfaces that are the same are below this share of the depth; the quantile of their
# absolute values that the scale is taken from, and what it is of a normal distribution.
_SAME, _QUANTILE, _NORMAL = 0.05, 0.5, 0.6745
# A surface is seen again within so many standard deviations, and seen through beyond so many.
_SEEN, _THROUGH = 3.0, 5.0
# Probability that a view is wrong about a point for other reasons than noise, and that a point has
# changed, before it is compared: so a view counts log(19), and two must say so more than not.
_OUTLIERS, _PRIOR, _DETECT = 0.05, 0.05, 0.95
# Views of its own session that must have seen a voxel: flying pixels move with the camera.
_OWN_VIEWS = 2
# Views whose axes are farther apart hardly see the same surface from the same side.
_LEAST_COSINE = 0.25
# Edge of a voxel in pixels at the typical depth; voxels that are nearer than so many edges are of
# one cluster.
_VOXEL_PIXELS, _GAP = 2.5, 3.0
# Least surface of a change, as a share of what a view sees at the typical depth.
_LEAST_SHARE = 0.004
_CHUNKS = 32


@dataclass(frozen=True, eq=False)
class Change:
    """A cluster of surfaces that are there in one of two sessions only.

    Attributes
    ----------
    kind
        "appeared": in the later session only; "vanished": in the earlier one only.
    points
        (N, 3) middles of its surface, one for each voxel, m.
    voxel_m
        Edge of a voxel, m.
    """

    kind: Kind
    points: Float64
    voxel_m: float

    @property
    def centre(self) -> Float64:
        """(3,) of the box around it, m."""
        return np.asarray(0.5 * (self.points.min(0) + self.points.max(0)), np.float64)

    @property
    def size(self) -> Float64:
        """(3,) edges of the box around it, along the axes of the world, m."""
        return np.asarray(np.ptp(self.points, axis=0) + self.voxel_m, np.float64)

    @property
    def volume_m3(self) -> float:
        """Of the voxels that its surface fills, m^3; not of what may be inside."""
        return len(self.points) * self.voxel_m**3


@dataclass(frozen=True, eq=False)
class _Seen:
    """A view, prepared to be compared with points."""

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
    """Find what changed between two sessions, the largest first.

    Parameters
    ----------
    before, after
        Prepared views of the earlier and of the later session.
    poses_before, poses_after
        (N, 4, 4) and (M, 4, 4) T_world_camera.
    """
    if not before or not after:
        return []
    first = _prepared(before, poses_before)
    second = _prepared(after, poses_after)
    scale = max(_scale(first), _scale(second))
    shift = _shift(first, second, scale)
    depth = float(np.median([v.depth for v in (*before, *after)]))
    pitch = float(np.median([v.projection.pitch for v in (*before, *after)]))
    voxel = _VOXEL_PIXELS * pitch * depth
    sight = float(np.median([v.pixels * v.projection.pitch**2 for v in (*before, *after)]))
    least = _LEAST_SHARE * sight * depth**2 / voxel**2
    found = []
    ways: tuple[tuple[Kind, Sequence[_Seen], Sequence[_Seen]], ...] = (
        ("appeared", second, first),
        ("vanished", first, second),
    )
    for kind, own, other in ways:
        middles = _changed(own, other, scale, shift, voxel)
        found += [Change(kind, p, voxel) for p in _clusters(middles, voxel) if len(p) >= least]
    return sorted(found, key=lambda c: -len(c.points))


def _prepared(views: Sequence[PreparedView], poses: Float64) -> list[_Seen]:
    return [
        _Seen(view, ViewPoints.of(view, _POINTS), nearest_depth(view), T)
        for view, T in zip(views, poses, strict=True)
    ]


def _compare(source: _Seen, target: _Seen) -> tuple[Intp, Float64, Float64, Float64, Bool]:
    """What a view says of the points of another one.

    Returns
    -------
    (K,) which points land on something; their distance behind the surface that the target saw, m,
    NaN where it has no plane; how much nearer they are than all that it saw around there, m; the
    standard deviation of both, m; and whether both surfaces face the same way.
    """
    T = se3.inverse(target.T_world_camera) @ source.T_world_camera
    points = se3.transform(T, source.points.points.astype(np.float64))
    view = target.view
    pixel = landing_pixels(view, points)
    rows, columns = view.z.shape
    inside = (pixel >= 0).all(1) & (pixel[:, 0] < columns) & (pixel[:, 1] < rows)
    inside[inside] = target.nearest[pixel[inside, 1], pixel[inside, 0]] > 0
    at = np.flatnonzero(inside)
    j, i = pixel[at].T
    p = points[at]
    plane = view.planes[i, j].astype(np.float64)
    length = np.linalg.norm(plane[:, :3], axis=1)
    known = (plane[:, 3] > 0) & (length > 0)
    length = np.where(known, length, 1.0)
    behind = ((plane[:, :3] * p).sum(1) - 1) / length
    normal = source.points.normals[at] @ T[:3, :3].T
    facing = known & ((plane[:, :3] * normal).sum(1) / length > 0.5)
    nearer = target.nearest[i, j] - p[:, 2]
    sigma = np.hypot(source.points.sigma[at], view.sigma[i, j])
    return at, np.where(known, behind, np.nan), nearer, sigma, facing


def _facing(a: _Seen, b: _Seen) -> bool:
    """Whether two views look in about the same direction."""
    return float(a.T_world_camera[:3, 2] @ b.T_world_camera[:3, 2]) > _LEAST_COSINE


def _residuals(pairs: Sequence[tuple[_Seen, _Seen]]) -> tuple[Float64, Float64]:
    """Distances of points from the same surface in other views, m, and their sigma, m."""

    def work(start: int, stop: int) -> list[tuple[Float64, Float64]]:
        found = []
        for source, target in pairs[start:stop]:
            at, behind, _, sigma, facing = _compare(source, target)
            z = source.points.points[at, 2]
            same = facing & (np.abs(np.nan_to_num(behind, nan=np.inf)) < _SAME * z)
            found.append((np.abs(behind[same]), sigma[same]))
        return found

    chunks = [item for chunk in run_chunks(work, len(pairs), _CHUNKS) for item in chunk]
    if not chunks:
        return np.zeros(0), np.ones(0)
    r, sigma = (np.concatenate(each) for each in zip(*chunks, strict=True))
    return r, sigma


def _scale(views: Sequence[_Seen]) -> float:
    """How many times the stated sigma views of one session differ by."""
    # Neighbours share errors: views that are apart by a quarter of the session as well.
    steps = sorted({1, max(1, len(views) // 8), max(1, len(views) // 4)})
    pairs = [(views[k], views[k + s]) for s in steps for k in range(len(views) - s)]
    some = np.linspace(0, len(pairs) - 1, min(len(pairs), _LEARN)).round().astype(int)
    r, sigma = _residuals([pairs[k] for k in np.unique(some)])
    if not len(r):
        return 1.0
    return max(float(np.quantile(r / sigma, _QUANTILE)) / _NORMAL, 1.0)


def _shift(first: Sequence[_Seen], second: Sequence[_Seen], scale: float) -> float:
    """How far surfaces of two sessions are off from each other beyond noise (one sigma), m."""
    facing = [(a, b) for a in first for b in second if _facing(a, b)]
    some = np.linspace(0, len(facing) - 1, min(len(facing), 4 * _LEARN)).round().astype(int)
    r, sigma = _residuals([facing[k] for k in np.unique(some)])
    if not len(r):
        return 0.0
    both = float(np.quantile(r, _QUANTILE)) / _NORMAL
    noise = scale * float(np.sqrt((sigma**2).mean()))
    return float(np.sqrt(max(both**2 - noise**2, 0.0)))


def _changed(
    own: Sequence[_Seen], other: Sequence[_Seen], scale: float, shift: float, voxel: float
) -> Float64:
    """(K, 3) middles of the voxels with surfaces of one session that the other saw through."""

    def work(start: int, stop: int) -> list[tuple[Float64, Float64, Intp]]:
        found = []
        for k in range(start, stop):
            source = own[k]
            points = source.points.points.astype(np.float64)
            says = np.zeros(len(points))
            for target in other:
                if not _facing(source, target):
                    continue
                at, behind, nearer, sigma, facing = _compare(source, target)
                sigma = np.hypot(scale * sigma, shift)
                # What a surface at a slant is off by along the ray says little across it.
                through = (nearer > _THROUGH * sigma) & ~(behind > -_THROUGH * sigma)
                again = facing & (np.abs(behind) < _SEEN * sigma)
                says[at] += through.astype(float) - again
            found.append(
                (se3.transform(source.T_world_camera, points), says, np.full(len(points), k))
            )
        return found

    chunks = [item for chunk in run_chunks(work, len(own), _CHUNKS) for item in chunk]
    points, says, views = (np.concatenate(each) for each in zip(*chunks, strict=True))
    if not len(points):
        return np.zeros((0, 3))
    cells, cell = np.unique(np.floor(points / voxel).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell, minlength=len(cells))
    odds = np.log(_PRIOR / (1 - _PRIOR))
    odds = odds + np.log((1 - _OUTLIERS) / _OUTLIERS) * np.bincount(cell, says) / count
    seen_by = np.bincount(np.unique(np.stack([cell, views]), axis=1)[0], minlength=len(cells))
    changed = (odds >= np.log(_DETECT / (1 - _DETECT)) - 1e-9) & (seen_by >= _OWN_VIEWS)
    middles = np.stack([np.bincount(cell, points[:, axis]) / count for axis in range(3)], 1)
    return np.asarray(middles[changed], np.float64)


def _clusters(points: Float64, voxel: float) -> list[Float64]:
    """Points that are near each other."""
    if not len(points):
        return []
    pairs = cKDTree(points).query_pairs(_GAP * voxel, output_type="ndarray")
    n = len(points)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    return [points[label == k] for k in range(count)]
