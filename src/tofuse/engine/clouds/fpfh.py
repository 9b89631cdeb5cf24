"""Poses of clouds under any rotation by matching fast point feature histograms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Int64
from tofuse.engine.clouds import fpfh_kernels as kernels
from tofuse.engine.clouds.robust_motion import (
    Consensus,
    ConsensusOptions,
    Motions,
    Pairs,
    are_distinct,
    consensus,
    motion_of,
)
from tofuse.engine.compute import run_chunks
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import reduced, spacing, surface_shape

# Defaults of `candidates`.
POINTS, REACH, FPFH_NEIGHBOURS = 4000, 5.0, 12
_BINS = 11
# Resolution of the averaged views in spacings of the points: averages are less noisy than samples.
_COARSER = 2.0
# Maximum number of neighbours within reach.
_MAX_NEIGHBOURS = 60
# Sampling noise of an averaged point along each axis, and maximum distance of points that fit, in
# resolutions.
_SAMPLING_SIGMA, _FIT_DISTANCE = 0.4, 1.5
# Maximum extent of a surface across relative to that along it.
_MAX_ROUGHNESS = 0.6
# Motions that differ by more are distinct: resolutions, and rad (rotations from matches are
# inaccurate).
_DISTINCT, _DISTINCT_RAD = 4.0, 0.3
# Reach of ICP per iteration, resolutions, and minimum number of correspondences.
_REACHES, _MIN_PAIRS = (4.0, 3.0, 3.0, 2.0, 2.0, 2.0), 6
# Minimum cosine of the angle between normals that fit.
_MIN_NORMAL_COSINE = 0.8


def candidates(
    source: Frame,
    target: Frame,
    *,
    points: int = POINTS,
    reach: float = REACH,
    neighbours: int = FPFH_NEIGHBOURS,
    signed: bool = False,
    options: ConsensusOptions | None = None,
    motions: Motions | None = None,
) -> Candidates:
    """Return the consensus poses of matched points of two views, and how well the views fit there.

    Both views are averaged to the same resolution. Each point is described by histograms of angles
    between normals, which are invariant to rigid motion (`fpfh`); mutual nearest neighbours are
    matched, and nearly all matches may be outliers.

    Parameters
    ----------
    source, target
        Views.
    points
        Maximum number of points of each averaged view.
    reach
        Radius of the histograms' neighbourhood, in resolutions of the averaged views.
    neighbours
        Points of each plane fit.
    signed
        Whether the orientation of the normals is known. Arrays of points are assumed to be seen
        from their origin.
    options
        Options of the consensus, except for those of distinct motions.
    motions
        See `consensus`.

    Raises
    ------
    RegistrationError
        If too few matches agree on a motion.
    """
    size = _COARSER * max(spacing(source), spacing(target))
    size, data, model = reduced(source, target, size, points)
    options = replace(
        options or ConsensusOptions(), distinct_m=_DISTINCT * size, distinct_rad=_DISTINCT_RAD
    )
    described_source, described_target = (
        _described(view, reach * size, neighbours, signed, options.inliers)
        for view in (data, model)
    )
    i, j = mutually_nearest(described_source.histograms, described_target.histograms)
    variance = np.full(len(i), 2 * (_SAMPLING_SIGMA * size) ** 2)
    pairs = Pairs(described_source.points[i], described_target.points[j], variance)
    tree = KdTree(described_target.points)
    refined = [
        Candidate(*_refined(described_source, described_target, tree, c.T_target_source, size), c)
        for c in consensus(pairs, options, motions)
    ]
    distinct: list[Candidate] = []
    for candidate in sorted(refined, key=lambda c: -c.inlier_ratio):
        # Discard poses that converge to a better one.
        if are_distinct(
            np.array([c.T_target_source for c in distinct]).reshape(-1, 4, 4),
            candidate.T_target_source,
            described_source.points,
            metres=options.distinct_m,
            rad=options.distinct_rad,
        ).all():
            distinct.append(candidate)
    return Candidates(size, pairs, tuple(distinct))


@dataclass(frozen=True, eq=False)
class DescribedCloud:
    """Points (n, 3) of a view, their normals (n, 3), and histograms (n, 33)."""

    points: Float64
    normals: Float64
    histograms: Float64


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose T_target_source (4, 4), the fraction of averaged points that fit, and its matches."""

    T_target_source: Float64
    inlier_ratio: float
    consensus: Consensus


@dataclass(frozen=True, eq=False)
class Candidates:
    """Consensus poses of the matches of two views.

    Attributes
    ----------
    size
        Resolution of the averaged views, m.
    pairs
        All matches.
    poses
        Distinct poses, in order of decreasing fit.
    """

    size: float
    pairs: Pairs
    poses: tuple[Candidate, ...]


def _described(
    view: CloudFrame, reach: float, neighbours: int, signed: bool, min_points: int
) -> DescribedCloud:
    """Describe the points of a view that are on surfaces; `reach` in m.

    Other points have no descriptor, and corrupt those of their neighbours.
    """
    shape = surface_shape.shape_at(view, np.arange(len(view)), neighbours)
    valid = np.isfinite(shape.normals).all(1) & (shape.roughness < _MAX_ROUGHNESS)
    points, normals = view.points[valid].astype(np.float64), shape.normals[valid]
    if len(points) < min_points:
        raise RegistrationError(
            f"has {len(points)} points on surfaces, too few to be matched",
            where=f"frame {view.index}",
        )
    return DescribedCloud(points, normals, fpfh(points, normals, reach, signed))


def fpfh(points: Float64, normals: Float64, reach: float, signed: bool) -> Float64:
    """Return fast point feature histograms (n, 33).

    With p and q a point and a neighbour, d the unit vector from p to q, and u, v, w the axes
    ``n_p, u x d, u x v``, the angles are ``v . n_q``, ``u . d`` and ``atan2(w . n_q, u . n_q)``,
    each in 11 bins. A point's histogram is its own, and the mean of those of its neighbours,
    weighted by the inverse of their distances.

    Parameters
    ----------
    points, normals
        (n, 3) points in m, and unit normals.
    reach
        Maximum distance of neighbours, m.
    signed
        Whether normals are oriented. If not, the angles are folded so that a normal and its
        opposite give the same histogram.
    """
    n = len(points)
    neighbours, squared = KdTree(points).neighbours(points, min(_MAX_NEIGHBOURS + 1, n))
    spfh, neighbour_mean = np.empty((n, 3, _BINS)), np.empty((n, 3 * _BINS))
    run_chunks(
        lambda a, b: kernels.histograms(
            points, normals, neighbours, squared, reach, signed, spfh, a, b
        ),
        n,
    )
    spfh_flat = spfh.reshape(n, 3 * _BINS)
    run_chunks(
        lambda a, b: kernels.weighted_means(
            spfh_flat, neighbours, squared, reach, neighbour_mean, a, b
        ),
        n,
    )
    return spfh_flat + neighbour_mean


def mutually_nearest(a: Float64, b: Float64) -> tuple[Int64, Int64]:
    """Return the positions in a (n, d) and b (m, d) of mutual nearest neighbours."""
    forward = _nearest(a, b)
    backward = _nearest(b, a)
    i = np.flatnonzero(backward[forward] == np.arange(len(a)))
    return i.astype(np.int64), forward[i]


def _nearest(a: Float64, b: Float64) -> Int64:
    """Return the position (n,) in b (m, d) of the nearest neighbour of each row of a (n, d)."""
    rows = np.ascontiguousarray(a, np.float32)
    columns = np.ascontiguousarray(b.T, np.float32)
    nearest = np.empty(len(a), np.int64)
    run_chunks(lambda i, j: kernels.nearest_rows(rows, columns, nearest, i, j), len(a))
    return nearest


def _refined(
    source: DescribedCloud, target: DescribedCloud, tree: KdTree, T: Float64, size: float
) -> tuple[Float64, float]:
    """Refine T (4, 4) by ICP over the averaged points; return it and the fraction that fits."""
    for reach in _REACHES:
        fits, nearest = _fitting(source, target, tree, T, reach * size)
        if np.count_nonzero(fits) < _MIN_PAIRS:
            break
        p, q = source.points[fits], target.points[nearest[fits]]
        T = motion_of(Pairs(p, q, np.ones(len(p))))
    fits, _ = _fitting(source, target, tree, T, _FIT_DISTANCE * size)
    return T, float(np.mean(fits))


def _fitting(
    source: DescribedCloud, target: DescribedCloud, tree: KdTree, T: Float64, max_distance: float
) -> tuple[Bool, Int64]:
    """Return which source points fit a target point with a similar normal (n,), and its index."""
    nearest, squared = tree.nearest(se3.transform(T, source.points), max_distance)
    rotated_normals = source.normals @ T[:3, :3].T
    # Without a neighbour the squared distance is infinite and the normals are irrelevant.
    same_normal = np.abs((rotated_normals * target.normals[nearest]).sum(1)) > _MIN_NORMAL_COSINE
    return (squared < max_distance * max_distance) & same_normal, nearest
