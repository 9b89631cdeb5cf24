"""Poses of clouds under any rotation by matching fast point feature histograms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine import quantities
from tofuse.engine.arrays import Float32, Float64, Int64
from tofuse.engine.clouds import distinct_surfaces
from tofuse.engine.clouds import fpfh_kernels as kernels
from tofuse.engine.clouds.robust_motion import (
    Consensus,
    ConsensusOptions,
    Motions,
    Pairs,
    consensus,
    match_scores,
)
from tofuse.engine.clouds.viewpoint import RangeSphere, Viewpoint
from tofuse.engine.compute import run_chunks
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import averaged, reduced, spacing, surface_shape

# Defaults of `candidates`.
POINTS, REACH, FPFH_NEIGHBOURS = 4000, 5.0, 12
_BINS = 11
# Resolution of the averaged views in spacings of the points: averages are less noisy than samples.
_COARSER = 2.0
# Resolution of the surroundings, in resolutions of the points, and their radius in its resolutions.
_SURROUNDINGS, _SURROUNDINGS_REACH = 2.0, 6.0
# Each point is matched with this many, if it is among as many nearest of theirs.
_MATCHES = 2
# Sets of compatible matches that propose motions.
SEEDS = 1000
# Sampling noise of an averaged point along each axis, and maximum distance of points that fit, in
# resolutions.
_SAMPLING_SIGMA, _FIT_DISTANCE = 0.4, 2.0
# Maximum extent of a surface across relative to that along it.
_MAX_ROUGHNESS = 0.6
# Motions that differ by more are distinct: resolutions, and rad (rotations from matches are
# inaccurate).
_DISTINCT, _DISTINCT_RAD = 4.0, 0.15
# Points of each view that evaluate a motion, and minimum cosine between normals that fit.
_FIT_POINTS, _MIN_NORMAL_COSINE = 300, 0.7
# A point violates free space if it lies before the other view's surface by more resolutions, plus
# this fraction of its range; weight of such points, and the fraction of them that counts.
_IN_FRONT, _IN_FRONT_RANGE = 2.5, 0.03
VIOLATION_WEIGHT, MAX_VIOLATION = 20.0, 0.05
# Weight of the log of the matches that agree with a pose, and of those that do by chance.
MATCH_WEIGHT, _CHANCE_MATCHES = 0.1, 5.0
# Weight of the log of the distinct surfaces that fit.
_SURFACE_WEIGHT = 0.5


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
    options = options or ConsensusOptions(seeds=SEEDS)
    pair = matched(
        source,
        target,
        points=points,
        reach=reach,
        neighbours=neighbours,
        signed=signed,
        options=options,
    )
    found = consensus(pair.pairs, pair.options, motions)
    T = np.array([c.T_target_source for c in found])
    score, inlier_ratio = pair.evaluated(T)
    best = np.argsort(-score, kind="stable")
    return Candidates(pair, tuple(Candidate(T[k], float(inlier_ratio[k]), found[k]) for k in best))


def matched(
    source: Frame,
    target: Frame,
    *,
    points: int = POINTS,
    reach: float = REACH,
    neighbours: int = FPFH_NEIGHBOURS,
    signed: bool,
    options: ConsensusOptions,
) -> MatchedPair:
    """Describe and match the points of two views; see `candidates`."""
    size = _COARSER * max(spacing(source), spacing(target))
    size, data, model = reduced(source, target, size, points)
    described = [
        _described(view, size, reach, neighbours, signed, options.inliers) for view in (data, model)
    ]
    if signed:
        described = [
            replace(cloud, sphere=_sphere(view, cloud, size))
            for view, cloud in zip((source, target), described, strict=True)
        ]
    i, j = mutually_nearest(described[0].histograms, described[1].histograms, _MATCHES)
    variance = np.full(len(i), 2 * (_SAMPLING_SIGMA * size) ** 2)
    pairs = Pairs(described[0].points[i], described[1].points[j], variance)
    options = replace(options, distinct_m=_DISTINCT * size, distinct_rad=_DISTINCT_RAD)
    return MatchedPair(described[0], described[1], size, pairs, options)


@dataclass(frozen=True, eq=False)
class DescribedCloud:
    """Points (n, 3) of a view, their normals and histograms (n, 66), and its free space."""

    points: Float64
    normals: Float64
    histograms: Float64
    sphere: RangeSphere | None = None

    @cached_property
    def tree(self) -> KdTree:
        """kd-tree over the points."""
        return KdTree(self.points)

    def thinned(self, count: int) -> DescribedCloud:
        """Return about as many of the points."""
        chosen = np.arange(0, len(self.points), max(1, len(self.points) // count))
        points, normals, histograms = (
            self.points[chosen],
            self.normals[chosen],
            self.histograms[chosen],
        )
        return DescribedCloud(points, normals, histograms, self.sphere)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose T_target_source (4, 4), the fraction of points that fit, and its matches."""

    T_target_source: Float64
    inlier_ratio: float
    consensus: Consensus


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two views averaged to the same resolution (m), and all matches of their points."""

    source: DescribedCloud
    target: DescribedCloud
    size: float
    pairs: Pairs
    options: ConsensusOptions

    def evaluated(self, motions: Float64) -> tuple[Float64, Float64]:
        """Return the scores (k,) of motions (k, 4, 4), and the fractions of points that fit.

        The score increases with the points, surfaces and matches that fit, and decreases with
        violations of free space.
        """
        back = _fit(self.target, self.source, se3.inverse(motions), self.size)
        fits = 0.5 * (_fit(self.source, self.target, motions, self.size) + back)
        score = fits[0] - VIOLATION_WEIGHT * np.minimum(fits[1], MAX_VIOLATION)
        score += _SURFACE_WEIGHT * np.log1p(fits[2])
        return score + MATCH_WEIGHT * log_matches(self.matches_at(motions)), fits[0]

    def matches_at(self, motions: Float64) -> Float64:
        """Return the MSAC scores (k,) of the matches at motions (k, 4, 4)."""
        return match_scores(self.pairs, motions, self.options.sigmas)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Distinct consensus poses of the matches of two views, in order of their scores."""

    pair: MatchedPair
    poses: tuple[Candidate, ...]


def log_matches(score: ArrayLike) -> Float64:
    """Return the logs of MSAC scores of matches, of which some agree by chance."""
    return np.log(np.asarray(score, np.float64) + _CHANCE_MATCHES)


def _described(
    view: CloudFrame, size: float, reach: float, neighbours: int, signed: bool, min_points: int
) -> DescribedCloud:
    """Describe the points of a view that are on surfaces, by their neighbours and surroundings.

    Other points have no descriptor, and corrupt those of their neighbours.
    """
    points, normals = _on_surfaces(view, neighbours)
    if len(points) < min_points:
        raise RegistrationError(
            f"has {quantities.count(len(points), 'point')} on surfaces, too few to be matched",
            where=f"frame {view.index}",
        )
    near = fpfh(points, normals, reach * size, signed)
    surroundings = _on_surfaces(averaged(view, _SURROUNDINGS * size), neighbours)
    if len(surroundings[0]) < min_points:
        surroundings = points, normals
    far_reach = _SURROUNDINGS_REACH * _SURROUNDINGS * size
    far = fpfh(points, normals, far_reach, signed, surroundings)
    return DescribedCloud(points, normals, np.hstack([near, far]))


def _on_surfaces(view: CloudFrame, neighbours: int) -> tuple[Float64, Float64]:
    shape = surface_shape.shape_at(view, np.arange(len(view)), neighbours)
    valid = np.isfinite(shape.normals).all(1) & (shape.roughness < _MAX_ROUGHNESS)
    return view.points[valid].astype(np.float64), shape.normals[valid]


def _sphere(view: Frame, cloud: DescribedCloud, size: float) -> RangeSphere:
    """Return the free space of a view seen from its origin, m."""
    origin = np.asarray(view.origin, np.float64)
    ranges = np.linalg.norm(cloud.points - origin, axis=1)
    spacing_rad = size / _COARSER / max(float(np.median(ranges)), size)
    return RangeSphere.of(view, Viewpoint(origin, spacing_rad))


def fpfh(
    points: Float64,
    normals: Float64,
    reach: float,
    signed: bool,
    surroundings: tuple[Float64, Float64] | None = None,
) -> Float64:
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
    surroundings
        Points and normals (m, 3) that are the neighbours; the points themselves unless given.
    """
    n, offset = len(points), 0
    tree = KdTree(points if surroundings is None else surroundings[0])
    if surroundings is not None:
        points, normals = (
            np.vstack(both) for both in zip((points, normals), surroundings, strict=True)
        )
        offset = n
    first, neighbours, distances = tree.within(points, reach)
    neighbours += offset
    spfh, neighbour_mean = np.empty((len(points), 3, _BINS)), np.empty((n, 3 * _BINS))
    run_chunks(
        lambda a, b: kernels.histograms(
            points, normals, first, neighbours, distances, signed, spfh, a, b
        ),
        len(points),
    )
    spfh_flat = spfh.reshape(-1, 3 * _BINS)
    run_chunks(
        lambda a, b: kernels.weighted_means(
            spfh_flat, first, neighbours, distances, neighbour_mean, a, b
        ),
        n,
    )
    return spfh_flat[:n] + neighbour_mean


def mutually_nearest(a: Float64, b: Float64, count: int = 1) -> tuple[Int64, Int64]:
    """Return the positions in a (n, d) and b (m, d) of rows among the `count` nearest of each."""
    distance = _squared_distances(a, b)
    backward = _smallest(np.ascontiguousarray(distance.T), count)
    forward = _smallest(distance, count)
    mutual = (backward[forward] == np.arange(len(a))[:, None, None]).any(2)
    i, k = np.nonzero(mutual)
    return i.astype(np.int64), forward[i, k].astype(np.int64)


def most_similar(a: Float64, b: Float64, count: int) -> Int64:
    """Return the positions in b (m, d) of the rows nearest to each of a (n, d), (n, count)."""
    return _smallest(_squared_distances(a, b), count)


def _squared_distances(a: Float64, b: Float64) -> Float32:
    rows, columns = (np.asarray(x, np.float32) for x in (a, b))
    squared = np.asarray(rows @ (-2 * columns.T), np.float32)
    squared += (rows**2).sum(1)[:, None]
    squared += (columns**2).sum(1)
    return squared


def _smallest(distance: Float32, count: int) -> Int64:
    """Return the columns (n, count) of the smallest entries of each row (n, m), which are lost."""
    count = min(count, distance.shape[1])
    columns = np.empty((len(distance), count), np.int64)
    for k in range(count):
        columns[:, k] = distance.argmin(1)
        np.put_along_axis(distance, columns[:, k : k + 1], np.inf, 1)
    return columns


def fitting(
    view: DescribedCloud, other: DescribedCloud, T: Float64, reach_m: float
) -> tuple[Float64, Int64, Float64]:
    """Return a view's points (k, n, 3) moved by T (k, 4, 4), and what is near them in the other.

    That is the nearest point (k, n) of the other, and the fit (k, n): 1 - (distance / reach)^2
    where the normals agree, else 0.
    """
    points = se3.transform(T, view.points)
    normals = view.normals @ T[:, :3, :3].transpose(0, 2, 1)
    nearest, squared = other.tree.nearest(points.reshape(-1, 3), reach_m)
    nearest, squared = nearest.reshape(points.shape[:2]), squared.reshape(points.shape[:2])
    cosine = np.einsum("kni,kni->kn", normals, other.normals[nearest])
    same_normal = (cosine if other.sphere is not None else np.abs(cosine)) > _MIN_NORMAL_COSINE
    return points, nearest, np.where(same_normal, np.maximum(1 - squared / reach_m**2, 0), 0)


def _fit(view: DescribedCloud, other: DescribedCloud, T: Float64, size: float) -> Float64:
    """Return how well a view fits the other at poses T (k, 4, 4) that map it there, (3, k).

    The first row is the mean over its points of 1 - (distance / limit)^2 where the normals agree,
    the second the fraction of them in the other's free space, the third the number of distinct
    surfaces that fit: the sum of what the first is the mean of, by the shares of the points.
    """
    chosen = view.thinned(_FIT_POINTS)
    points, _, fits = fitting(chosen, other, T, _FIT_DISTANCE * size)
    violation = np.zeros(len(T))
    if other.sphere is not None:
        ranges = np.linalg.norm(points - other.sphere.origin, axis=2)
        front = other.sphere.distance_in_front(points.reshape(-1, 3)).reshape(ranges.shape)
        violation = (front > _IN_FRONT * size + _IN_FRONT_RANGE * ranges).mean(1)
    shares = distinct_surfaces.shares(chosen.points, chosen.normals, size)
    return np.stack([fits.mean(1), violation, fits @ shares])
